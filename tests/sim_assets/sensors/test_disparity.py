# SPDX-License-Identifier: MIT
"""The disparity model against the published formulas, one pixel at a time, and measured Kinects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sim_assets.sensors.disparity import (
    PUBLISHED,
    REDWOOD,
    Disparity,
    depth_sigma,
    depth_step,
    disparity,
)
from tests.helpers.depth_plates import camera, disc, parts_of, plate

CAMERA = camera(200)
QUIET = Disparity(sigma=0, shift=0, rounded=False)


def test_the_depth_step_is_the_one_measured_on_kinects():
    """Khoshelham and Oude Elberink 2012: 2.85e-5 z^2 cm, which they give as 7 cm at 5 m; their
    random error, half of it, is about 4 cm there."""
    z = np.array([0.5, 1.0, 2.0, 5.0])
    assert depth_step(z) * 100 == pytest.approx(2.85e-5 * (z * 100) ** 2, rel=2e-3)
    assert depth_step(np.array([5.0]))[0] == pytest.approx(0.07, abs=0.002)
    assert 0.6 < depth_sigma(z)[0] / (1.425e-5 * (z[0] * 100) ** 2 / 100) < 0.7
    assert REDWOOD.scale == pytest.approx(281.04)


def test_without_shift_each_pixel_follows_the_formula():
    """Barron and Malik 2013 in centimetres; the released Redwood simulator in metres."""
    depth = plate(CAMERA, 1.7, 50)
    for name, model in (("barron", PUBLISHED), ("redwood", REDWOOD)):
        still = Disparity(scale=model.scale, sigma=model.sigma, shift=0)
        found, _ = disparity(depth, parts_of(depth), CAMERA, np.random.default_rng(5), still)
        rng = np.random.default_rng(5)
        drawn = [rng.standard_normal(depth.shape, np.float32) for _ in range(3)][2]
        for v, u in ((0, 0), (17, 60), (120, 133), (199, 199)):
            z, n = float(depth[v, u]), float(drawn[v, u])
            if name == "barron":
                expected = 35130 / round(35130 / (100 * z) + n / 6) / 100
            else:
                expected = 35.130 * 8 / round((35.130 / z + 0.027778 * n) * 8)
            assert found[v, u] == pytest.approx(expected, rel=1e-5)


def test_disparities_are_whole_steps():
    depth = plate(CAMERA, 0.8, 60)
    found, _ = disparity(depth, parts_of(depth), CAMERA, np.random.default_rng(1))
    steps = PUBLISHED.scale / found.astype(np.float64)
    assert np.abs(steps - np.rint(steps)).max() < 1e-3


@pytest.mark.parametrize("z", [0.5, 1.0, 3.0])
def test_the_deviation_on_a_plate(z):
    """Tilted a little, so that all places between two steps occur."""
    depth = plate(CAMERA, z, 12)
    still = Disparity(shift=0)
    found, _ = disparity(depth, parts_of(depth), CAMERA, np.random.default_rng(2), still)
    error = (found - depth) / depth_sigma(depth)
    assert error.std() == pytest.approx(1, abs=0.05)
    assert abs(error.mean()) < 0.1


def test_shifts_interpolate_depth_and_take_the_nearest_part():
    depth = np.random.default_rng(0).uniform(1, 2, (40, 50)).astype(np.float32)
    part = np.random.default_rng(1).integers(0, 3, depth.shape).astype(np.uint8)
    seen_by = replace(camera(50), height=40)
    model = Disparity(sigma=0, shift=0.7, rounded=False)
    found, label = disparity(depth, part, seen_by, np.random.default_rng(2), model)
    rng = np.random.default_rng(2)
    du, dv = (0.7 * rng.standard_normal(depth.shape, np.float32) for _ in range(2))
    v, u = np.mgrid[:40, :50]
    u, v = np.clip(u + du, 0, 49), np.clip(v + dv, 0, 39)
    expected = map_coordinates(depth, [v, u], order=1)
    assert np.abs(found - expected).max() < 1e-5
    assert (label == part[np.rint(v).astype(int), np.rint(u).astype(int)]).mean() > 0.999


def test_the_shift_scales_with_the_focal_length():
    spread = []
    for focal in (585.0, 1170.0):
        depth = plate(camera(200, focal), 1.0, 60, 0.0)
        model = Disparity(sigma=0, rounded=False)
        found, _ = disparity(
            depth, parts_of(depth), camera(200, focal), np.random.default_rng(3), model
        )
        spread.append((found - depth)[60:140, 60:140].std())
    # sigma_x = z / 2 / 585 m in both, times the slope of 60 degrees
    assert spread == pytest.approx([np.tan(np.radians(60)) / 2 / 585] * 2, rel=0.05)


def test_nothing_stays_nothing_and_without_noise_nothing_changes():
    depth = plate(CAMERA, 1.0, 40) * disc(CAMERA)
    part = parts_of(depth)
    same, label = disparity(depth, part, CAMERA, np.random.default_rng(0), QUIET)
    assert np.array_equal(same, depth)
    assert np.array_equal(label, part)
    found, label = disparity(depth, part, CAMERA, np.random.default_rng(0))
    assert ((found > 0) == (label == 0)).all()
    assert (found[:20] == 0).all()


def test_the_same_generator_gives_the_same_picture():
    depth = plate(CAMERA, 1.0, 40)
    made = [disparity(depth, parts_of(depth), CAMERA, np.random.default_rng(s)) for s in (1, 1, 2)]
    assert np.array_equal(made[0][0], made[1][0])
    assert not np.array_equal(made[0][0], made[2][0])
