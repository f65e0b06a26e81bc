# SPDX-License-Identifier: MIT
"""Which part is compared with which, and the frames fitted on training predictions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bench import metrics
from bench.matching import apply_calibration, calibrate, fit_calibration
from scapo.geometry.part_order import part_orders
from tests.helpers import made
from tests.helpers.cases import KEYS, random_case


def poses(generator, *shape, spread=1.0):
    out = np.tile(np.eye(4), (*shape, 1, 1))
    turns = made.rotations(generator, int(np.prod(shape)))
    out[..., :3, :3] = turns.reshape(*shape, 3, 3)
    out[..., :3, 3] = generator.normal(scale=spread, size=(*shape, 3))
    return out


def own_frames(seed, count=60, parts=3):
    """True poses, hidden offsets in r4 and predictions in the method's own frames."""
    generator = np.random.default_rng(seed)
    true, offsets = poses(generator, count, parts), poses(generator, parts, spread=0.2)
    scale = generator.uniform(0.2, 2, size=count)
    metric = np.broadcast_to(offsets, (count, parts, 4, 4)).copy()
    metric[..., :3, 3] *= scale[:, None, None]
    return generator, true, true @ np.linalg.inv(metric), offsets, scale


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_recovers_hidden_frames_despite_outliers(seed):
    generator, true, pred, offsets, scale = own_frames(seed)
    pred[:24] = poses(generator, 24, 3)
    found = fit_calibration(pred, true, scale=scale, seed=1)
    np.testing.assert_allclose(found, offsets, atol=1e-9)
    back = apply_calibration(pred, found, scale=scale)
    np.testing.assert_allclose(back[24:], true[24:], atol=1e-8)


def test_one_of_two_frequent_frames_is_taken_whole():
    """45 % of the samples agree on another frame: rotation and translation are not mixed."""
    generator, true, pred, offsets, scale = own_frames(5, count=100, parts=1)
    flip = poses(generator, 1)[0]
    pred[:45] = pred[:45] @ flip
    found = fit_calibration(pred, true, scale=scale)
    np.testing.assert_allclose(found, offsets, atol=1e-8)


def test_noise_is_averaged_and_inliers_are_counted():
    generator, true, pred, offsets, scale = own_frames(6, count=400, parts=1)
    noise = Rotation.from_rotvec(np.radians(generator.normal(scale=2, size=(400, 3))))
    pred[:, 0, :3, :3] = pred[:, 0, :3, :3] @ noise.as_matrix()
    pred[:100] = poses(generator, 100, 1)
    fitted = calibrate(pred, true, scale=scale)
    error = Rotation.from_matrix(fitted.offsets[0, :3, :3].T @ offsets[0, :3, :3]).magnitude()
    assert np.degrees(error) < 0.4
    assert fitted.rotation_inliers[0] == pytest.approx(0.75, abs=0.02)
    assert fitted.answered[0] == 400


def test_without_scale_and_the_same_for_the_same_seed():
    generator, true, pred, _, _ = own_frames(7)
    del generator
    ones = np.ones(len(true))
    a, b = fit_calibration(pred, true, seed=3), fit_calibration(pred, true, scale=ones, seed=3)
    np.testing.assert_array_equal(a, b)


def test_a_part_without_an_answer_has_no_offset():
    _, true, pred, offsets, scale = own_frames(8)
    pred[:, 1] = np.nan
    pred[3, 0] = np.nan
    found = fit_calibration(pred, true, scale=scale)
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[[0, 2]], offsets[[0, 2]], atol=1e-9)


def test_two_samples_are_enough():
    _, true, pred, offsets, scale = own_frames(9, count=2)
    np.testing.assert_allclose(fit_calibration(pred, true, scale=scale), offsets, atol=1e-9)


def sample_errors(**given: Any) -> dict[str, np.ndarray]:
    return metrics.sample_errors(**given)


@pytest.mark.parametrize(
    ("parts", "orders"), [(1, [[0]]), (2, [[0, 1], [1, 0]]), (3, [[0, 1, 2], [0, 2, 1]])]
)
def test_orders_by_rule(parts, orders):
    np.testing.assert_array_equal(part_orders(parts), orders)


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
    bare: dict[str, Any] = {"camera_T_part_pred": None, "pivot_pred": None, "axis_pred": None}
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
