# SPDX-License-Identifier: MIT
from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench import compat
from bench.compat.chain import dir_to_dir_rotation, exp_so3
from bench.compat.eap import eap_iou
from bench.compat.readings import SYMMETRY
from bench.matching import project_rotations
from bench.metrics import sample_errors
from tests.helpers import made

ANGLES, LENGTHS = 0.05, 1e-5
TOLERANCE = defaultdict(lambda: LENGTHS, dir_err_deg=ANGLES, rot_err_deg=ANGLES)


@pytest.fixture(scope="session")
def cases(shared_dir):
    archive = np.load(shared_dir / "fixtures" / "metric_fixtures.npz")
    out = {}
    for key in archive.files:
        case, group, name = key.split("/")
        out.setdefault(case, {}).setdefault(group, {})[name] = archive[key]
    return out


def scalars(record):
    return {name: v.item() if v.shape == () else v for name, v in record.items()}


def matrix(rows):
    return None if rows is None else np.array(rows)


def component_cases(cases):
    return {name: case for name, case in cases.items() if name.startswith(("p2_", "p3_"))}


def compare(found, expected, where):
    for name, value in expected.items():
        known = np.isfinite(value)  # the reference is NaN on a perfect pivot
        assert np.isfinite(np.asarray(found[name], float)).all(), (where, name)
        np.testing.assert_allclose(
            np.asarray(found[name], float)[known], value[known], rtol=0, atol=TOLERANCE[name],
            err_msg=f"{where}/{name}",
        )  # fmt: skip


def test_components(cases):
    assert len(component_cases(cases)) >= 13
    for name, case in component_cases(cases).items():
        compare(compat.opalign(scalars(case["in"])), case["out"], name)


def test_components_by_the_public_metrics(cases):
    """`sample_errors` on the same inputs: labels from 0, -1 ignored, the symmetry as a matrix."""
    for name, case in component_cases(cases).items():
        given = scalars(case["in"])
        shift = 1 if given["background"] else 0
        pose = np.tile(np.eye(4), (*given["pred_trans"].shape[:2], 1, 1))
        pose[..., :3, :3], pose[..., :3, 3] = given["pred_rot"], given["pred_trans"]
        found = sample_errors(
            part_true=given["gt_seg"] - shift,
            camera_T_part_true=given["gt_pose"],
            pivot_true=given["gt_joint"][..., :3],
            axis_true=given["gt_joint"][..., 3:],
            part_pred=np.swapaxes(given["pred_seg"], 1, 2),
            camera_T_part_pred=pose,
            pivot_pred=given["pred_pivot"],
            axis_pred=given["pred_dir"],
            symmetry=matrix(SYMMETRY.get(given["shape_type"])),
        )
        unit = given["expand"][:, None] if given["use_expand"] else 1
        named = {
            "iou": found["iou"],
            "pivot_err": found["joint_pivot"] / unit,
            "dir_err_deg": found["joint_direction"],
            "rot_err_deg": found["part_rotation"],
            "trans_err": found["part_translation"] / unit,
        }
        compare(named, {key: case["out"][key] for key in named}, name)


@pytest.mark.parametrize(("group", "geometry"), [("out", "compat"), ("out_se3", "se3")])
def test_pipelines(cases, group, geometry):
    pipes = {name: case for name, case in cases.items() if name.startswith("pipe_")}
    assert len(pipes) >= 3
    for name, case in pipes.items():
        found = compat.opalign(scalars(case["in"]), geometry=geometry)
        compare(found, case[group], f"{name}/{group}")


def test_helpers(cases):
    geom = cases["geom"]
    np.testing.assert_allclose(exp_so3(geom["in"]["rotvec"]), geom["out"]["exp_so3"], atol=1e-6)
    found = dir_to_dir_rotation(geom["in"]["dir_src"], geom["in"]["dir_dst"])
    np.testing.assert_allclose(found, geom["out"]["dir_to_dir_rotation"], atol=1e-6)
    mean = project_rotations(geom["in"]["rotation_sets"].sum(1).astype(float))
    np.testing.assert_allclose(mean, geom["out"]["chordal_mean"], atol=1e-6)


def test_eap(cases):
    found = compat.eap_iou(**cases["eap_iou"]["in"])
    for name, value in cases["eap_iou"]["out"].items():
        np.testing.assert_allclose(found[name], value, atol=1e-6)
    found = compat.eap_rotation(**cases["eap_rot"]["in"])
    for name, value in cases["eap_rot"]["out"].items():
        np.testing.assert_allclose(found[name], value, atol=ANGLES)


def perfect_record(seed, parts, kind):
    """Network outputs whose truth follows from proper rigid geometry, part by part (scipy)."""
    generator = np.random.default_rng(seed)
    count, joints = 48, parts - 1
    turn = made.rotations(generator, count)
    record = {
        "R_select": turn,
        "T_select": generator.normal(scale=0.1, size=(count, 3)),
        "pred_seg": np.zeros((count, parts, 64)),
        "gt_joint": np.zeros((count, joints, 6)),
        "joint_type": kind, "shape_type": "none", "n_train": 40, "ransac_seed": 7,
    }  # fmt: skip
    for name in ("S", "I"):
        axis = np.array([[0, 0, 1.0], [0, 1.0, 0]])[:joints]
        axis = axis + generator.normal(scale=0.1, size=(count, joints, 3))
        record[f"{name}_drct"] = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        record[f"{name}_joint"] = generator.normal(scale=0.2, size=(count, joints, 3))
        record[f"{name}_angl"] = generator.uniform(-0.6, 0.6, size=(count, joints, 2))
    canon = made.rotations(generator, parts)
    shift = generator.normal(scale=0.1, size=(parts, 3))
    pose = np.tile(np.eye(4), (count, parts, 1, 1))
    for part in range(parts):
        joint, side = max(part - 1, 0), int(part > 0)
        for b in range(count):
            d_i, d_s = (record[f"{n}_drct"][b, joint] for n in "IS")
            cross = np.cross(d_i, d_s)
            angle = np.arctan2(np.linalg.norm(cross), d_i @ d_s)
            move = Rotation.from_rotvec(cross / np.linalg.norm(cross) * angle).as_matrix()
            change = record["S_angl"][b, joint, side] - record["I_angl"][b, joint, side]
            p_i, p_s = (record[f"{n}_joint"][b, joint] for n in "IS")
            if kind == "r":
                move = Rotation.from_rotvec(d_s * change).as_matrix() @ move
                t = move @ (shift[part] - p_i) + p_s
            else:
                t = move @ (shift[part] - p_i) + p_s + d_s * change
            pose[b, part, :3, :3] = turn[b] @ move @ canon[part]
            pose[b, part, :3, 3] = turn[b] @ (t + record["T_select"][b])
    label = generator.integers(0, parts, size=(count, 64))
    record["pred_seg"] = np.moveaxis(np.eye(parts)[label], -1, 1)
    return record | {"gt_pose": pose, "gt_seg": label}


def test_a_perfect_revolute_predictor():
    record = perfect_record(0, 2, "r")
    found = compat.opalign(record, geometry="se3")
    np.testing.assert_allclose(found["rot_err_deg"], 0, atol=1e-3)
    np.testing.assert_allclose(found["trans_err"], 0, atol=1e-5)
    released = compat.opalign(record)
    assert released["trans_err"].mean() > 0.05  # translations are not rotated
    np.testing.assert_allclose(released["rot_err_deg"], 0, atol=1e-3)


def test_a_perfect_prismatic_predictor_is_turned_by_the_released_code():
    record = perfect_record(1, 2, "p")
    found = compat.opalign(record, geometry="se3")
    np.testing.assert_allclose(found["rot_err_deg"], 0, atol=1e-3)
    np.testing.assert_allclose(found["trans_err"], 0, atol=1e-5)
    assert compat.opalign(record)["rot_err_deg"].mean() > 5


def test_the_released_code_evaluates_the_base_as_third_part():
    record = perfect_record(2, 3, "r")
    found = compat.opalign(record, geometry="se3")
    np.testing.assert_allclose(found["rot_err_deg"][:, 1:], 0, atol=1e-3)
    np.testing.assert_allclose(found["trans_err"][:, 1:], 0, atol=1e-5)
    released = compat.opalign(record)
    np.testing.assert_allclose(released["rot_err_deg"][:, 1], 0, atol=1e-3)
    assert released["rot_err_deg"][:, 2].mean() > 5


def test_many_slots_are_matched_too():
    """Past seven slots the orders are no longer listed one by one."""
    generator = np.random.default_rng(0)
    true = np.zeros((2, 9, 50))
    true[:, :3] = np.moveaxis(np.eye(3)[generator.integers(0, 3, size=(2, 50))], -1, 1)
    places = generator.permutation(9)
    found = eap_iou(true[:, places], true)
    np.testing.assert_array_equal(found["mean_iou"], 1)
    np.testing.assert_array_equal(places[found["match_pred"][:, :3]], [[0, 1, 2]] * 2)
    few = eap_iou(true[:, :3], true[:, :3] * 0)
    assert np.isnan(few["mean_iou"]).all()


def test_a_record_must_be_whole():
    record = perfect_record(3, 2, "r")
    del record["S_angl"]
    with pytest.raises(ValueError, match=r"record: expected R_select, .*, found no S_angl"):
        compat.opalign(record)


def test_eap_calibration_finds_the_frame_of_most():
    generator = np.random.default_rng(0)
    turn = Rotation.from_matrix(made.rotations(generator, 1)[0])
    noise = Rotation.from_rotvec(generator.normal(scale=0.05, size=(40, 3)))
    shifts = np.array([0.1, 0.2, 0.3]) + generator.normal(scale=0.005, size=(40, 3))
    shifts[:10] += 1
    found = compat.eap_calibration((turn * noise).as_matrix(), shifts)
    assert np.degrees((turn.inv() * Rotation.from_matrix(found["rot"])).magnitude()) < 2
    assert found["rot_score"] == 1
    np.testing.assert_allclose(found["trans"], [0.1, 0.2, 0.3], atol=0.01)
    assert found["trans_score"] == pytest.approx(0.75)
    assert set(compat.eap_calibration(translations=shifts)) == {"trans", "trans_score"}
