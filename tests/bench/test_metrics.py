# SPDX-License-Identifier: MIT
"""Errors of known motions, slots without an answer, and the precision made of them."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bench.metrics import average_precision, sample_errors, state_errors, state_sign
from tests.helpers import made
from tests.helpers.cases import KEYS, random_case

SEEDS = st.integers(0, 2**31 - 1)


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
    motion[:3, :3] = made.rotations(np.random.default_rng(seed), 1)[0]
    motion[:3, 3] = np.random.default_rng(seed).normal(size=3)
    moved: dict[str, Any] = dict(case)
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


@pytest.mark.parametrize("name", ["label_order", "iou", "pivot", "rotation"])
def test_an_unknown_reading_is_refused_by_name(name):
    with pytest.raises(ValueError, match=f"{name}: expected one of .*, found 'bogus'"):
        inspect.unwrap(sample_errors)(**random_case(0), **{name: "bogus"})  # types unchecked


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("pivot", ["point-line", "line-line"])
def test_what_is_not_finite_is_undefined_in_its_slot_alone(value, pivot):
    """Warnings are errors here: nothing is computed with an infinity."""
    case = random_case(5, parts=3)
    whole = sample_errors(**case, pivot=pivot)
    case["camera_T_part_pred"][0, 1, 0, 3] = value
    case["camera_T_part_pred"][1, 2, :3, :3] = value
    case["pivot_pred"][0, 1, 2] = value
    case["axis_pred"][1, 0] = value
    found = sample_errors(**case, pivot=pivot)
    lost = {"part_translation": [(0, 1)], "part_rotation": [(1, 2)], "joint_direction": [(1, 0)],
            "joint_pivot": [(0, 1)] + [(1, 0)] * (pivot == "line-line")}  # fmt: skip
    for key in KEYS:
        expected = whole[key].astype(float)
        for place in lost.get(key, []):
            expected[place] = np.nan
        np.testing.assert_array_equal(found[key], expected, err_msg=key)


@pytest.mark.parametrize("iou", ["hard", "soft"])
def test_an_infinite_weight_is_no_answer_of_its_point(iou):
    case = random_case(6)
    weight = np.eye(2)[case["part_true"]]
    weight[0, 0] = np.inf
    labels = case["part_true"].copy()
    labels[0, 0] = -1
    case["part_pred"] = labels
    with_labels = sample_errors(**case)["iou"]
    case["part_pred"] = weight
    found = sample_errors(**case, iou=iou)["iou"]
    np.testing.assert_allclose(found, with_labels)
    assert found[0].min() < 1
    np.testing.assert_array_equal(found[1:], 1)


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
    lacking = np.full_like(axis, np.nan)  # of these samples alone, and so alike
    np.testing.assert_array_equal(state_sign(axis, lacking, np.array([True, False])), 1)


def precision_inputs(seed=0, count=200, parts=2) -> dict[str, Any]:
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
    values: dict[str, Any] = {
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
