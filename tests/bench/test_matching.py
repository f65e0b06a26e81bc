# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bench.matching import apply_calibration, calibrate, fit_calibration
from tests.helpers import made


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
