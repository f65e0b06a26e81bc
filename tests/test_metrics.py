# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bench.metrics import average_precision, sample_errors, state_errors, state_sign

SEEDS = st.integers(0, 2**31 - 1)
KEYS = ("iou", "joint_direction", "joint_pivot", "part_rotation", "part_translation")


def random_case(seed, batch=5, parts=2, points=40):
    """Random truth and an unrelated random prediction."""
    generator = np.random.default_rng(seed)

    def poses():
        out = np.tile(np.eye(4), (batch, parts, 1, 1))
        flat = Rotation.random(batch * parts, random_state=int(generator.integers(2**31)))
        out[..., :3, :3] = flat.as_matrix().reshape(batch, parts, 3, 3)
        out[..., :3, 3] = generator.normal(size=(batch, parts, 3))
        return out

    part = generator.integers(0, parts, size=(batch, points))
    noisy = np.where(generator.random(part.shape) < 0.2,
                     generator.integers(0, parts, size=part.shape), part)  # fmt: skip
    return {
        "part_true": part,
        "camera_T_part_true": poses(),
        "pivot_true": generator.normal(size=(batch, parts - 1, 3)),
        "axis_true": generator.normal(size=(batch, parts - 1, 3)),
        "part_pred": noisy,
        "camera_T_part_pred": poses(),
        "pivot_pred": generator.normal(size=(batch, parts - 1, 3)),
        "axis_pred": generator.normal(size=(batch, parts - 1, 3)),
    }


def reference(case):
    """One sample and slot at a time, by scipy and other formulas; identity order."""
    batch, parts = case["camera_T_part_true"].shape[:2]
    out = {key: np.zeros((batch, parts - ("joint" in key))) for key in KEYS}
    for b in range(batch):
        for p in range(parts):
            here, there = case["part_true"][b] == p, case["part_pred"][b] == p
            both, either = (here & there).sum(), (here | there).sum()
            out["iou"][b, p] = both / either
            true, pred = (case[f"camera_T_part_{k}"][b, p] for k in ("true", "pred"))
            turn = Rotation.from_matrix(true[:3, :3].T @ pred[:3, :3])
            out["part_rotation"][b, p] = np.degrees(turn.magnitude())
            out["part_translation"][b, p] = np.sqrt(((true - pred)[:3, 3] ** 2).sum())
        for j in range(parts - 1):
            d, e = case["axis_true"][b, j], case["axis_pred"][b, j]
            cosine = abs(d @ e) / np.sqrt(d @ d) / np.sqrt(e @ e)
            out["joint_direction"][b, j] = np.degrees(np.arccos(min(1, cosine)))
            r = case["pivot_pred"][b, j] - case["pivot_true"][b, j]
            d = d / np.sqrt(d @ d)
            out["joint_pivot"][b, j] = np.sqrt(max(0, r @ r - (r @ d) ** 2))
    return out


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([2, 3]))
def test_equals_an_independent_implementation(seed, parts):
    case = random_case(seed, parts=parts)
    found = sample_errors(**case)
    kept = (found["order"] == np.arange(parts)).all(1)
    for key, expected in reference(case).items():
        np.testing.assert_allclose(found[key][kept], expected[kept], atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([2, 3]))
def test_swapped_part_names_change_nothing(seed, parts):
    """Predicted slots renamed by the allowed swap: the same errors, in the swapped slots."""
    case = random_case(seed, parts=parts)
    plain = sample_errors(**case)
    swap = np.array([1, 0] if parts == 2 else [0, 2, 1])
    joints = swap[1:] - 1 if parts == 3 else np.array([0])
    renamed = case | {
        "part_pred": swap[case["part_pred"]],
        "camera_T_part_pred": case["camera_T_part_pred"][:, swap],
        "pivot_pred": case["pivot_pred"][:, joints],
        "axis_pred": case["axis_pred"][:, joints],
    }
    again = sample_errors(**renamed)
    tie = (plain["order"] == again["order"]).all(1)  # equal accuracy: identity both times
    for key in KEYS:
        columns = joints if "joint" in key else swap
        np.testing.assert_allclose(again[key][~tie][:, columns], plain[key][~tie], atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_a_rigid_motion_of_camera_and_truth_changes_nothing(seed):
    case = random_case(seed, parts=3)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    motion[:3, 3] = np.random.default_rng(seed).normal(size=3)
    moved = dict(case)
    for kind in ("true", "pred"):
        moved[f"camera_T_part_{kind}"] = motion @ case[f"camera_T_part_{kind}"]
        moved[f"pivot_{kind}"] = case[f"pivot_{kind}"] @ motion[:3, :3].T + motion[:3, 3]
        moved[f"axis_{kind}"] = case[f"axis_{kind}"] @ motion[:3, :3].T
    before, after = sample_errors(**case), sample_errors(**moved)
    for key in KEYS:
        np.testing.assert_allclose(after[key], before[key], atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0.01, 100))
def test_scale_only_scales_lengths(seed, factor):
    case = random_case(seed)
    scaled = dict(case)
    for kind in ("true", "pred"):
        scaled[f"camera_T_part_{kind}"] = case[f"camera_T_part_{kind}"].copy()
        scaled[f"camera_T_part_{kind}"][..., :3, 3] *= factor
        scaled[f"pivot_{kind}"] = case[f"pivot_{kind}"] * factor
    before, after = sample_errors(**case), sample_errors(**scaled)
    for key in KEYS:
        length = factor if key in ("joint_pivot", "part_translation") else 1
        np.testing.assert_allclose(after[key], before[key] * length, rtol=1e-9, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([2, 3]))
def test_the_truth_is_perfect(seed, parts):
    case = random_case(seed, parts=parts)
    for name in ("camera_T_part", "pivot", "axis", "part"):
        case[f"{name}_pred"] = case[f"{name}_true"]
    found = sample_errors(**case)
    np.testing.assert_array_equal(found["iou"], 1)
    for key in KEYS[1:]:
        np.testing.assert_allclose(found[key], 0, atol=1e-6)


def test_truth_is_not_changed_in_place():
    case = random_case(3)
    kept = {key: value.copy() for key, value in case.items()}
    case["part_pred"] = 1 - case["part_true"]
    sample_errors(**case, symmetry=np.diag([1, -1, -1]))
    for key in ("part_true", "camera_T_part_true", "pivot_true", "axis_true"):
        np.testing.assert_array_equal(case[key], kept[key])


def test_symmetry_turns_swapped_samples_only():
    case = random_case(4, batch=4)
    turn = np.diag([1.0, -1.0, -1.0])
    case["part_pred"] = case["part_true"].copy()
    case["part_pred"][:2] = 1 - case["part_true"][:2]
    case["camera_T_part_pred"] = case["camera_T_part_true"].copy()
    case["camera_T_part_pred"][:2] = case["camera_T_part_true"][:2, ::-1]
    case["camera_T_part_pred"][:2, :, :3, :3] = (
        case["camera_T_part_true"][:2, ::-1, :3, :3] @ turn
    )  # fmt: skip
    found = sample_errors(**case, symmetry=turn)
    np.testing.assert_allclose(found["part_rotation"], 0, atol=1e-6)
    np.testing.assert_array_equal(found["order"], [[1, 0], [1, 0], [0, 1], [0, 1]])
    without = sample_errors(**case)
    np.testing.assert_allclose(without["part_rotation"][:2], 180, atol=1e-5)


def test_what_cannot_be_computed_is_nan():
    case = random_case(5, batch=6)
    case["part_true"][0] = 0
    case["part_pred"][0] = 0  # part 1 neither there nor predicted
    case["axis_pred"][1] = 0
    case["axis_true"][2] = 0
    case["camera_T_part_pred"][3] = np.nan
    case["pivot_pred"][4] = np.nan
    case["part_true"][5] = -1
    found = sample_errors(**case)
    assert found["iou"][0, 0] == 1
    assert np.isnan(found["iou"][0, 1])
    assert np.isnan(found["joint_direction"][1, 0])
    assert np.isfinite(found["joint_pivot"][1, 0])  # needs the true axis alone
    assert np.isnan(found["joint_direction"][2, 0])
    assert np.isnan(found["joint_pivot"][2, 0])
    assert np.isnan(found["part_rotation"][3]).all()
    assert np.isnan(found["part_translation"][3]).all()
    assert np.isnan(found["joint_pivot"][4, 0])
    assert np.isnan(found["iou"][5]).all()
    bare = {"camera_T_part_pred": None, "pivot_pred": None, "axis_pred": None}
    nothing = sample_errors(**(case | bare))
    for key in KEYS[1:]:
        assert np.isnan(nothing[key]).all()
        assert nothing[key].shape == found[key].shape


def test_a_reflection_and_a_singular_matrix_have_no_angle():
    case = random_case(6, batch=2)
    case["camera_T_part_pred"][0, 0, :3, :3] = np.diag([1, 1, -1])
    case["camera_T_part_pred"][1, 0, :3, :3] = np.diag([1, 1, 0])
    found = sample_errors(**case)["part_rotation"]
    assert np.isnan(found[:, 0]).all()
    assert np.isfinite(found[:, 1]).all()


def test_ties_keep_the_identity():
    case = random_case(7, batch=1, points=4)
    case["part_true"] = np.array([[0, 0, 1, 1]])
    case["part_pred"] = np.array([[0, 1, 0, 1]])
    np.testing.assert_array_equal(sample_errors(**case)["order"], [[0, 1]])


def test_dataset_order_is_one_for_all():
    case = random_case(8, batch=3)
    case["part_pred"] = case["part_true"].copy()
    case["part_pred"][:2] = 1 - case["part_true"][:2]
    order = sample_errors(**case, label_order="dataset")["order"]
    np.testing.assert_array_equal(order, [[1, 0]] * 3)
    iou = sample_errors(**case, label_order="dataset")["iou"]
    np.testing.assert_array_equal(iou, [[1, 1], [1, 1], [0, 0]])


def test_hungarian_may_move_the_base():
    from scipy.optimize import linear_sum_assignment

    case = random_case(9, batch=8, parts=3)
    generator = np.random.default_rng(0)
    case["part_pred"] = generator.permutation(3)[case["part_true"]]
    weight = generator.dirichlet(np.ones(3), size=case["part_true"].shape)
    found = sample_errors(**(case | {"part_pred": weight}), label_order="hungarian", iou="soft")
    for b in range(8):
        one_hot = np.eye(3)[case["part_true"][b]]
        shared = one_hot.T @ weight[b]
        iou = shared / (one_hot.sum(0)[:, None] + weight[b].sum(0)[None] - shared)
        rows, columns = linear_sum_assignment(-iou)
        np.testing.assert_array_equal(found["order"][b][columns], rows)
        np.testing.assert_allclose(found["iou"][b][columns], iou[rows, columns])


def test_joint_between_parts_that_share_none_is_nan():
    case = random_case(10, batch=1, parts=3)
    case["part_pred"] = np.array([1, 0, 2])[case["part_true"]]  # slot 0 is true part 1
    found = sample_errors(**case, label_order="hungarian")
    np.testing.assert_array_equal(found["order"], [[1, 0, 2]])
    assert np.isfinite(found["joint_direction"][0, 0])  # base and part 1
    assert np.isnan(found["joint_direction"][0, 1])  # part 1 and part 2: no joint


def test_ignored_points_count_nowhere():
    case = random_case(11)
    plain = sample_errors(**case)
    extra = np.full((5, 7), -1)
    more = case | {
        "part_true": np.concatenate([case["part_true"], extra], 1),
        "part_pred": np.concatenate([case["part_pred"], extra + 2], 1),
    }
    for key, value in sample_errors(**more).items():
        np.testing.assert_array_equal(value, plain[key])


def test_weights_and_labels_agree():
    case = random_case(12, parts=3)
    weight = np.eye(3)[case["part_pred"]] * 0.9 + 0.1 / 3
    hard = sample_errors(**case)
    same = sample_errors(**(case | {"part_pred": weight.astype(np.float16)}))
    for key, value in hard.items():
        np.testing.assert_array_equal(same[key], value)
    soft = sample_errors(**case, iou="soft")
    np.testing.assert_allclose(soft["iou"], hard["iou"])


def test_line_to_line_and_folded():
    case = random_case(13, batch=1)
    case |= {
        "pivot_true": np.array([[[0.0, 0, 0]]]), "axis_true": np.array([[[0.0, 0, 2]]]),
        "pivot_pred": np.array([[[0.3, 0.4, 9]]]), "axis_pred": np.array([[[0.0, 3, 0]]]),
    }  # fmt: skip
    assert sample_errors(**case)["joint_pivot"][0, 0] == pytest.approx(0.5)
    assert sample_errors(**case, pivot="line-line")["joint_pivot"][0, 0] == pytest.approx(0.3)
    parallel = case | {"axis_pred": np.array([[[0.0, 0, -5]]])}
    found = sample_errors(**parallel, pivot="line-line")["joint_pivot"][0, 0]
    assert found == pytest.approx(0.5)
    case["camera_T_part_pred"] = case["camera_T_part_true"].copy()
    turn = Rotation.from_rotvec([0, 0, np.radians(170)]).as_matrix()
    case["camera_T_part_pred"][..., :3, :3] = case["camera_T_part_true"][..., :3, :3] @ turn
    case["part_pred"] = case["part_true"]
    assert sample_errors(**case)["part_rotation"] == pytest.approx(170)
    assert sample_errors(**case, rotation="folded")["part_rotation"] == pytest.approx(10)


def test_tiny_angles_are_exact():
    """1e-6 degrees, which the arc cosine of a number near 1 cannot tell from 0."""
    case = random_case(14, batch=1)
    turn = Rotation.from_rotvec([np.radians(1e-6), 0, 0]).as_matrix()
    case["part_pred"] = case["part_true"]
    case["camera_T_part_pred"] = case["camera_T_part_true"].copy()
    case["camera_T_part_pred"][..., :3, :3] = case["camera_T_part_true"][..., :3, :3] @ turn
    found = sample_errors(**case)["part_rotation"]
    np.testing.assert_allclose(found, 1e-6, rtol=1e-5)


def precision_inputs(seed=0, count=200, parts=2):
    generator = np.random.default_rng(seed)
    return {
        "iou": generator.uniform(0.4, 1, size=(count, parts)),
        "part_rotation": generator.gamma(2, 4, size=(count, parts)),
        "part_translation": generator.gamma(2, 0.03, size=(count, parts)),
        "joint_direction": generator.gamma(2, 3, size=(count, parts - 1)),
        "joint_pivot": generator.gamma(2, 0.03, size=(count, parts - 1)),
    }


@pytest.mark.parametrize("rule", ["mean", "min", "per-part"])
def test_precision_counts_samples_one_by_one(rule):
    values = precision_inputs(parts=3)
    found = average_precision(**values, rule=rule)
    join = {"mean": np.mean, "min": np.max, "per-part": list}[rule]
    for k in (5, 10, 15):
        for name, angle, length in (("joint", "joint_direction", "joint_pivot"),
                                    ("part", "part_rotation", "part_translation")):  # fmt: skip
            passed = [a < k and t < k / 100
                      for a_row, t_row in zip(values[angle], values[length], strict=True)
                      for a, t in zip(np.atleast_1d(join(a_row)), np.atleast_1d(join(t_row)),
                                      strict=True)]  # fmt: skip
            assert found[f"{name}_{k}"] == pytest.approx(sum(passed) / len(passed))
    assert found["seg_75"] <= found["seg_50"]
    assert found["part_5"] <= found["part_10"] <= found["part_15"]


def test_precision_is_strict_and_undefined_fails():
    values = {
        "iou": np.array([[0.75, 0.75], [0.76, np.nan], [np.nan, np.nan]]),
        "part_rotation": np.array([[5.0, 5.0], [4.9, np.nan], [4.9, 4.9]]),
        "part_translation": np.array([[0.01] * 2] * 3),
        "joint_direction": np.array([[1.0], [1.0], [np.nan]]),
        "joint_pivot": np.array([[0.05], [0.0499], [0.0]]),
    }
    found = average_precision(**values)
    assert found["seg_75"] == pytest.approx(1 / 3)
    assert found["part_5"] == pytest.approx(1 / 3)
    assert found["joint_5"] == pytest.approx(1 / 3)
    assert average_precision(**values, rule="per-part")["part_5"] == pytest.approx(3 / 6)
    with pytest.raises(ValueError, match="rule: expected mean, min or per-part, found 'max'"):
        average_precision(**values, rule="max")


def test_precision_of_fixtures(shared_dir):
    archive = np.load(shared_dir / "fixtures" / "metric_fixtures.npz")
    for case in {key.split("/")[0] for key in archive.files if key.startswith("ap_")}:
        given_ = {
            name: archive[f"{case}/in/{name}"]
            for name in ("iou", "rot_err_deg", "trans_err_dm", "dir_err_deg", "pivot_err_dm")
        }
        for rule in ("mean", "min", "per_part"):
            found = average_precision(
                iou=given_["iou"], part_rotation=given_["rot_err_deg"],
                part_translation=given_["trans_err_dm"] / 10,
                joint_direction=given_["dir_err_deg"], joint_pivot=given_["pivot_err_dm"] / 10,
                rule=rule,
            )  # fmt: skip
            for name, value in found.items():
                assert value == pytest.approx(float(archive[f"{case}/out/{rule}_{name}"]))


def test_states_go_around_the_circle_and_follow_the_axis():
    true = np.array([[0.1, 0.2]])
    pred = np.array([[2 * np.pi + 0.3, -0.1]])
    error = state_errors(state_true=true, state_pred=pred, revolute=np.array([True, False]),
                         offset=np.array([0.0, 0.5]), sign=np.array([[1.0, -1.0]]))  # fmt: skip
    np.testing.assert_allclose(error, [[0.2, 0.4]])
    axis = np.array([[[0.0, 0, 1]], [[0.0, 0, 1]]])
    sign = state_sign(axis, -axis, np.array([False, True]))
    np.testing.assert_array_equal(sign, [[-1], [1]])
    np.testing.assert_array_equal(state_sign(axis, None, np.array([True, False])), 1)
