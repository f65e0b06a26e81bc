# SPDX-License-Identifier: MIT
"""Strata, the oracle ladder and the two reference answers."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench import __main__ as program
from bench.analysis.explain import LADDER_COLUMNS, STRATA_COLUMNS, Ladder, measure
from bench.analysis.ladder import RUNGS, Rung, ladder_markdown, limits
from bench.analysis.reference import write_reference
from bench.analysis.strata import factors, stratify
from bench.figures.explain import helps_most, plot_ladder, plot_strata
from bench.requests import Request, Settings
from bench.scoring.evaluate import evaluate
from bench.scoring.score_files import read_scores
from bench.scoring.truth import blocks
from bench.statistics import Interval
from scapo.store import StoreError, open_split, read
from scapo.store.predictions import write_predictions
from tests.helpers import made
from tests.helpers.scoring import root

CATEGORIES = ("laptop", "eyeglasses", "drawer")


@pytest.fixture(scope="module", params=CATEGORIES)
def split(request, tmp_path_factory):
    return made.make_data(tmp_path_factory.mktemp("data"), request.param, count=12, points=40)


def ladder(split, arrays, folder):
    """(rung, metric, unit) -> mean."""
    write_predictions(folder / "p.safetensors", made.header_of(split), arrays)
    found = measure(Request(predictions=folder / "p.safetensors", data=root(split), out=folder))
    return {(rung, *key): value.mean
            for rung, values in found.ladder.items() for key, value in values.items()}  # fmt: skip


def state_of(split):
    turns = split.manifest.joints[0].kind == "revolute"
    return ("joint_state", "deg") if turns else ("joint_state", "r4")


def moved_whole(split, motion):
    """The truth with everything carried along by a motion of the camera frame."""
    arrays = made.truth_as_prediction(split)
    turn, shift = motion[:3, :3], motion[:3, 3]
    arrays["camera_T_part"] = (motion @ arrays["camera_T_part"]).astype(np.float32)
    arrays["joint_pivot"] = (arrays["joint_pivot"] @ turn.T + shift).astype(np.float32)
    arrays["joint_axis"] = (arrays["joint_axis"] @ turn.T).astype(np.float32)
    return arrays


def test_a_wrong_pose_alone_is_cured_by_the_pose(split, tmp_path):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.3, 0.2, -0.1]).as_matrix()
    motion[:3, 3] = [0.1, 0, 0.05]
    found = ladder(split, moved_whole(split, motion), tmp_path)
    for rung in ("predicted", "recomposed", "parts", "joint", "state"):
        assert found[rung, "part_rotation", "deg"] > 10
        assert found[rung, "joint_pivot", "r4"] > 0.05
    for metric, unit in (("joint_direction", "deg"), ("joint_pivot", "r4"),
                         ("part_rotation", "deg"), ("part_translation", "r4"),
                         state_of(split)):  # fmt: skip
        assert found["pose", metric, unit] == pytest.approx(0, abs=1e-4)


def test_a_wrong_state_alone_is_cured_by_the_state(split, tmp_path):
    arrays = made.truth_as_prediction(split)
    arrays["joint_state"] = arrays["joint_state"] * np.float32(0.5)
    found = ladder(split, arrays, tmp_path)
    metric, unit = state_of(split)
    assert found["predicted", metric, unit] > 0.01
    assert found["predicted", "part_translation", "r4"] == pytest.approx(0, abs=1e-5)
    # The file's poses do not follow from its state: put together anew, they are wrong.
    assert found["recomposed", "part_translation", "r4"] > 0.01
    assert found["state", "part_translation", "r4"] == pytest.approx(0, abs=1e-4)
    assert found["state", "part_rotation", "deg"] == pytest.approx(0, abs=1e-4)
    assert found["joint", "part_translation", "r4"] > 0.01


def test_a_wrong_joint_alone_is_cured_by_the_joint(split, tmp_path):
    arrays = made.truth_as_prediction(split)
    turn = Rotation.from_rotvec([0.2, 0.1, 0.3]).as_matrix().astype(np.float32)
    arrays["joint_axis"] = arrays["joint_axis"] @ turn
    arrays["joint_pivot"] = arrays["joint_pivot"] + np.float32(0.1)
    found = ladder(split, arrays, tmp_path)
    for rung in ("predicted", "recomposed", "pose", "state", "parts"):
        assert found[rung, "joint_direction", "deg"] > 5
    assert found["recomposed", "part_translation", "r4"] > 0.01
    assert found["joint", "joint_direction", "deg"] == pytest.approx(0, abs=1e-4)
    assert found["joint", "joint_pivot", "r4"] == pytest.approx(0, abs=1e-4)
    assert found["joint", "part_translation", "r4"] == pytest.approx(0, abs=1e-4)


def test_wrong_parts_alone_are_cured_by_the_parts(split, tmp_path):
    arrays = made.truth_as_prediction(split)
    parts = len(split.manifest.parts)
    generator = np.random.default_rng(0)
    wrong = generator.random(arrays["part"].shape) < 0.2
    arrays["part"] = np.where(wrong, 0, arrays["part"]).astype(np.uint8)
    if parts == 3:  # names of the temples exchanged: the order follows from poses
        arrays["part"][:3] = np.array([0, 2, 1], np.uint8)[arrays["part"][:3]]
    found = ladder(split, arrays, tmp_path)
    assert found["predicted", "iou", "1"] < 0.95
    for metric in ("part_rotation", "joint_direction"):
        assert found["parts", metric, "deg"] == pytest.approx(0, abs=1e-4)
    for rung in ("parts", "all"):
        assert found[rung, "iou", "1"] == 1


def test_all_is_perfect_and_predicted_is_what_evaluate_says(split, tmp_path):
    arrays = moved_whole(split, np.diag([1.0, -1, -1, 1]))
    arrays["joint_state"] = arrays["joint_state"] * np.float32(0.7)
    found = ladder(split, arrays, tmp_path)
    request = Request(predictions=tmp_path / "p.safetensors", data=root(split),
                      out=tmp_path / "s.csv.gz")  # fmt: skip
    report = evaluate(request)
    for (rung, metric, unit), mean in found.items():
        if rung == "all":
            assert mean == pytest.approx(1 if metric == "iou" else 0, abs=1e-5)
        if rung == "predicted":
            expected = report["summary"][f"{metric}_{unit}"]["mean"]
            assert mean == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_labels_alone_leave_dashes(split, tmp_path):
    found = ladder(split, {"part": made.truth_as_prediction(split)["part"]}, tmp_path)
    assert found["predicted", "iou", "1"] == 1
    assert np.isnan(found["predicted", "part_rotation", "deg"])
    assert {rung for rung, _, _ in found} == set(RUNGS)


def test_missing_slots_are_in_no_rung_that_would_need_them(split, tmp_path):
    arrays = made.truth_as_prediction(split, weights=True)
    arrays["part_weight"] = np.full_like(arrays["part_weight"], np.nan)
    arrays["camera_T_part"][:, 1] = np.nan
    arrays["joint_state"][:, 0] = np.nan
    found = ladder(split, arrays, tmp_path)
    assert np.isnan(found["predicted", "iou", "1"])
    assert found["predicted", "part_rotation", "deg"] == pytest.approx(0, abs=0.1)  # the base's
    states = [value for (rung, metric, _), value in found.items()
              if (rung, metric) == ("predicted", "joint_state")]  # fmt: skip
    single = arrays["joint_state"].shape[1] == 1
    assert all(np.isnan(value) if single else value < 1e-4 for value in states)


@pytest.mark.parametrize("missing", ["joint_state", "joint_axis"])
def test_a_child_that_cannot_be_put_together_stays_as_predicted(split, tmp_path, missing):
    """Else its error would fall out of the mean, as though the true joint cured it."""
    arrays = made.truth_as_prediction(split)
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix()
    arrays["camera_T_part"][:, 1:, :3, :3] = arrays["camera_T_part"][:, 1:, :3, :3] @ turn
    del arrays[missing]
    found = ladder(split, arrays, tmp_path)
    expected = found["predicted", "part_rotation", "deg"]
    assert expected > 20
    rungs = ["recomposed", "joint"] if missing == "joint_state" else ["recomposed", "state"]
    for rung in rungs:
        assert found[rung, "part_rotation", "deg"] == pytest.approx(expected)


def test_factors_say_where_the_camera_is(tmp_path):
    """Cameras placed by hand about an object at the origin."""
    arrays = made.sample_arrays("laptop", 4, 30)
    azimuth, elevation = np.radians([0, 90, -30, 180]), np.radians([0, 30, 45, -20])
    for i, (a, e) in enumerate(zip(azimuth, elevation, strict=True)):
        away = np.array([-np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)])
        forward = -away
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])  # x right, y down, z forward
        arrays["camera_T_part"][i, 0] = np.eye(4)
        arrays["camera_T_part"][i, 0, :3, :3] = turn
        arrays["camera_T_part"][i, 0, :3, 3] = -turn @ away
    arrays["joint_state"][:, 0] = np.radians([0, 27, 67.5, 135])
    split = made.write_split(tmp_path, "laptop", "test", arrays)
    (truth,) = blocks(split)
    found = factors(truth, split.manifest)
    np.testing.assert_allclose(found["azimuth"] % 360, np.degrees(azimuth) % 360, atol=1e-4)
    np.testing.assert_allclose(found["elevation"], np.degrees(elevation), atol=1e-4)
    np.testing.assert_allclose(found["state"], [0, 0.2, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(found["visible"], arrays["visible"][:, 1], atol=1e-6)
    points = arrays["points"].astype(float)
    radius = np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).mean(1)
    np.testing.assert_allclose(found["size"], 4 * radius, rtol=1e-5)


def test_strata_hold_every_sample_once():
    generator = np.random.default_rng(0)
    values = {"state": generator.uniform(-0.1, 1.2, 200), "visible": generator.random(200),
              "azimuth": generator.uniform(-180, 180, 200), "size": np.ones(200)}  # fmt: skip
    errors = {("part_rotation", "deg"): values["state"][:, None] * 10}
    strata = list(stratify(errors, values, np.arange(200) % 20))
    for factor in values:
        found = [s for s in strata if s.factor == factor]
        assert sum(s.samples for s in found) == 200
        total = sum(s.value.mean * s.samples for s in found)
        assert total / 200 == pytest.approx(10 * values["state"].mean())
    states = [s.value.mean for s in strata if s.factor == "state"]
    assert states == sorted(states)
    sizes = [s.samples for s in strata if s.factor == "visible"]
    assert min(sizes) == max(sizes) == 40


def test_samples_of_which_a_factor_is_not_known_are_in_none_of_its_bins():
    values = {"state": np.array([0.1, np.nan, 0.9]), "visible": np.array([np.nan, 0.2, 0.3]),
              "size": np.full(3, np.nan)}  # fmt: skip
    strata = list(stratify({("iou", "1"): np.ones((3, 2))}, values, np.arange(3)))
    bins = [(s.factor, s.lower, s.samples) for s in strata]
    assert bins[:2] == [("state", 0, 1), ("state", pytest.approx(0.8), 1)]
    assert sum(s.samples for s in strata if s.factor == "visible") == 2
    assert all(np.isfinite([s.lower, s.upper]).all() for s in strata)
    assert "size" not in {s.factor for s in strata}


def test_a_state_is_a_share_of_the_travel_whatever_its_lower_limit(tmp_path):
    arrays = made.sample_arrays("laptop", 3, 40)
    arrays["joint_state"][:, 0] = [-0.5, 0.25, 1]
    split = made.write_split(tmp_path, "laptop", "test", arrays)
    (truth,) = blocks(split)
    joint = replace(split.manifest.joints[0], lower=-0.5, upper=1.0)
    found = factors(truth, replace(split.manifest, joints=(joint,)))
    np.testing.assert_allclose(found["state"], [0, 0.5, 1], atol=1e-6)


def test_references_bracket_a_method(split, tmp_path):
    scores = {}
    for kind in ("constant", "oracle-pose"):
        path = tmp_path / f"{kind}.safetensors"
        write_reference(kind, root(split), split.manifest.category, path)
        evaluate(Request(predictions=path, data=root(split), out=tmp_path / f"{kind}.csv.gz",
                         settings=Settings(label_order="dataset")))  # fmt: skip
        (scores[kind],) = read_scores(tmp_path / f"{kind}.csv.gz")
    for found in scores.values():
        assert all(np.isfinite(v).all() for v in found.errors.values())
        assert found.report.supervision == ("joint", "pose", "segmentation")
    oracle, constant = (scores[k].errors for k in ("oracle-pose", "constant"))
    assert oracle["iou", "1"].mean() > constant["iou", "1"].mean()
    if split.manifest.joints[0].kind == "prismatic":  # no swap: the true base pose, exactly
        np.testing.assert_allclose(oracle["part_rotation", "deg"], 0, atol=1e-4)
        np.testing.assert_allclose(oracle["part_translation", "r4"][:, 0], 0, atol=1e-6)


def test_a_constant_answer_is_constant(split, tmp_path):
    path = tmp_path / "c.safetensors"
    program.main(["reference", "constant", "--data", str(root(split)), "--category",
                  split.manifest.category, "--out", str(path)])  # fmt: skip
    arrays, header = read(path)
    assert header["method"] == "constant"
    assert len(np.unique(arrays["part"])) == 1
    for name in ("joint_axis",):
        assert np.ptp(arrays[name], axis=0).max() == 0
    assert np.ptp(arrays["camera_T_part"][..., :3, :3], axis=0).max() == 0
    centre = split.arrays("points")["points"].mean(1)
    apart = arrays["joint_pivot"] - centre[:, None]
    direction = apart / np.linalg.norm(apart, axis=-1, keepdims=True)
    np.testing.assert_allclose(direction, direction[:1].repeat(12, 0), atol=1e-4)


@pytest.mark.parametrize("kind", ["constant", "oracle-pose"])
@pytest.mark.parametrize("unknown", [[0, 4], list(range(9))], ids=["some", "all"])
def test_states_that_are_not_known_are_left_out_of_the_mean(kind, unknown, tmp_path):
    arrays = made.sample_arrays("eyeglasses", 9, 30)
    arrays["joint_state"][unknown, 1] = np.nan
    made.write_split(tmp_path, "eyeglasses", "train", arrays)
    made.write_split(tmp_path, "eyeglasses", "val", made.sample_arrays("eyeglasses", 4, 30))
    write_reference(kind, tmp_path, "eyeglasses", tmp_path / "c.safetensors", split="val")
    state = read(tmp_path / "c.safetensors")[0]["joint_state"]
    known = np.delete(arrays["joint_state"][:, 1], unknown)
    second = known.sum() / len(known) if len(known) else np.nan
    wanted = [arrays["joint_state"][:, 0].sum() / 9, second]
    np.testing.assert_allclose(state, np.tile(wanted, (4, 1)), rtol=1e-5)


def test_the_mean_joint_is_the_joint_where_all_agree(tmp_path):
    """One object: in its own frame the axis and its line are the same in every view."""
    for name, size, seed in (("train", 9, 1), ("test", 5, 1)):
        arrays = made.sample_arrays("laptop", size, 30, instances=1, seed=seed)
        made.write_split(tmp_path, "laptop", name, arrays)
    write_reference("oracle-pose", tmp_path, "laptop", tmp_path / "o.safetensors")
    report = evaluate(Request(predictions=tmp_path / "o.safetensors", data=tmp_path,
                              out=tmp_path / "o.csv.gz",
                              settings=Settings(label_order="dataset")))  # fmt: skip
    assert report["summary"]["joint_direction_deg"]["mean"] == pytest.approx(0, abs=0.01)
    assert report["summary"]["joint_pivot_r4"]["mean"] == pytest.approx(0, abs=0.03)


def test_plots_of_what_cannot_be_computed(split, tmp_path):
    path = tmp_path / "p.safetensors"
    labels = {"part": made.truth_as_prediction(split)["part"]}
    write_predictions(path, made.header_of(split), labels)
    found = measure(Request(predictions=path, data=root(split), out=tmp_path))
    few = [stratum for stratum in found.strata if stratum.factor == "state"]
    for data in (plot_ladder(found.ladder, "labels alone"), plot_strata(few, "labels alone")):
        assert data.startswith(b"\x89PNG")


def test_the_files(tmp_path):
    split = made.make_data(tmp_path / "data", "laptop", count=12)
    path = made.write_truth(tmp_path / "p.safetensors", split)
    out = tmp_path / "out"
    program.main(["explain", "--predictions", str(path), "--data", str(tmp_path / "data"),
                  "--out", str(out)])  # fmt: skip
    for name, columns in (("ladder", LADDER_COLUMNS), ("strata", STRATA_COLUMNS)):
        with (out / f"{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert tuple(rows[0]) == columns
        assert len(rows) > 30
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "ladder.md").read_text().startswith("### made laptop test")


def test_the_summary_names_what_limits_a_wrong_pose(split, tmp_path):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.3, 0.2, -0.1]).as_matrix()
    path = tmp_path / "p.safetensors"
    write_predictions(path, made.header_of(split), moved_whole(split, motion))
    found = measure(Request(predictions=path, data=root(split), out=tmp_path))
    text = ladder_markdown(found.ladder, found.medians, found.title, {"seed": "1", "code": ""})
    angle = np.degrees(np.linalg.norm([0.3, 0.2, -0.1]))
    (row,) = [line for line in text.splitlines() if line.startswith("| as predicted")]
    assert f"{angle:.1f} / {angle:.1f}" in row
    (row,) = [line for line in text.splitlines() if line.startswith("| **true base pose**")]
    assert "0.0 / 0.0" in row
    assert f"- R {angle:.1f}: pose (0.0, cures 100 %)" in text
    assert "seed: 1" in text
    assert "code:" not in text
    columns = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert len(columns) == 1
    values: dict[Rung, Interval] = {
        rung: item["part_rotation", "deg"] for rung, item in found.ladder.items()
    }
    assert helps_most(values, higher=False) == "pose"
    perfect: Ladder = dict.fromkeys(RUNGS, found.ladder["all"])
    assert "- S 100.0: no single piece cures a fifth of it" in limits(perfect)
    best: dict[Rung, Interval] = {rung: item["iou", "1"] for rung, item in perfect.items()}
    assert helps_most(best, higher=True) is None


def test_the_command_refuses_what_it_cannot_read(split, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        program.main(["explain", "--predictions", str(tmp_path / "no"), "--data", str(root(split)),
                      "--out", str(tmp_path)])  # fmt: skip
    assert ended.value.code == 1
    assert "expected a file, found none" in capsys.readouterr().err
    with pytest.raises(StoreError, match="found none"):
        write_reference("constant", tmp_path, "laptop", tmp_path / "x.safetensors")
    assert open_split(root(split), split.manifest.category, "train").manifest.count == 10
