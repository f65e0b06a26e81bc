# SPDX-License-Identifier: MIT
"""Dilation, erosion, wavy outlines and missing pieces of the mask."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt, generate_binary_structure

from sim_assets.sensors.mask import MaskErrors, grow_mask, mean_width, shrink, wrong_mask
from tests.helpers.depth_plates import camera, disc

CAMERA = camera(200, 600)
QUIET = MaskErrors(grow=(0, 0), waves=0, missed=0)


def test_growing_by_crosses_and_squares_in_turn():
    mask = np.random.default_rng(0).random((60, 70)) < 0.01
    expected = mask
    for step in range(5):
        expected = binary_dilation(expected, generate_binary_structure(2, 1 + step % 2))
        assert np.array_equal(grow_mask(mask, step + 1), expected)
    assert np.array_equal(grow_mask(mask, 0), mask)
    assert np.array_equal(shrink(~mask, 3), ~grow_mask(mask, 3))


@pytest.mark.parametrize("pixels", [-4, 3])
@pytest.mark.parametrize("focal", [600, 300])
def test_the_outline_grows_or_shrinks_by_that_many_pixels(pixels, focal):
    mask = disc(CAMERA, 0.3)
    model = MaskErrors(grow=(pixels, pixels), waves=0, missed=0)
    found = wrong_mask(mask, camera(200, focal), np.random.default_rng(0), model)
    radius = np.sqrt(found.sum() / np.pi) - np.sqrt(mask.sum() / np.pi)
    assert radius == pytest.approx(pixels * focal / 600, abs=0.75)


def test_waves_move_the_outline_by_their_deviation_and_nothing_else():
    mask = disc(CAMERA, 0.3)
    model = MaskErrors(grow=(0, 0), waves=2.0, missed=0)
    wrong = []
    distance = np.asarray(distance_transform_edt(mask)) + np.asarray(distance_transform_edt(~mask))
    for seed in range(20):
        found = wrong_mask(mask, CAMERA, np.random.default_rng(seed), model)
        assert found[distance > 12].tolist() == mask[distance > 12].tolist()
        wrong.append((found != mask).sum() / (2 * np.pi * 0.3 * 200))
    # E|N(0, 2)| = 1.6 pixels at the grid's nodes, less between them
    assert 0.8 < np.mean(wrong) < 1.7


def test_a_piece_is_missing_as_often_and_as_large_as_said():
    mask = disc(CAMERA, 0.3)
    model = MaskErrors(grow=(0, 0), waves=0, missed=0.4, size=(0.1, 0.2))
    lost = np.array(
        [
            (mask & ~wrong_mask(mask, CAMERA, np.random.default_rng(s), model)).sum()
            for s in range(100)
        ]
    )
    assert (lost > 0).mean() == pytest.approx(0.4, abs=0.12)
    area = mask.sum()
    assert lost.max() <= np.pi * 0.2**2 * area * 1.05
    assert lost.max() > np.pi * 0.1**2 * area


def test_outlines_of_narrow_objects_err_in_proportion_to_their_width():
    bar = np.zeros((200, 200), bool)
    bar[90:96, 20:180] = True
    assert mean_width(bar) == pytest.approx(6, rel=0.1)
    model = MaskErrors(grow=(10, 10), waves=0, missed=0)
    assert wrong_mask(bar, CAMERA, np.random.default_rng(0), model).any(1).sum() == 6 + 2 * 3
    bar[40:160] = True
    assert wrong_mask(bar, CAMERA, np.random.default_rng(0), model).any(1).sum() == 120 + 2 * 10


def test_without_errors_the_mask_is_itself_and_empty_masks_stay_empty():
    mask = disc(CAMERA)
    assert np.array_equal(wrong_mask(mask, CAMERA, np.random.default_rng(0), QUIET), mask)
    empty = np.zeros_like(mask)
    for seed in range(5):
        assert not wrong_mask(empty, CAMERA, np.random.default_rng(seed)).any()
