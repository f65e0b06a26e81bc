# SPDX-License-Identifier: MIT
"""The Kinect model against the published formulas and figures, by statistics on flat plates."""

from __future__ import annotations

import numpy as np
import pytest

from sim_assets.sensors.kinect import Kinect, axial_sigma, kinect, lateral_sigma
from tests.helpers.depth_plates import angles, camera, disc, parts_of, plate

CAMERA = camera(200)
QUIET = Kinect(axial=0, axial_square=0, axial_angle=0, lateral=0, lateral_angle=0)


@pytest.mark.parametrize(
    ("z", "degrees", "millimetres"),
    [
        # Nguyen et al. 2012, Eq. 3 worked out by hand; their figure of the axial noise shows about
        # 1.2 mm at the nearest distance, 2 mm at 1 m, 6 mm at 2 m and 14 mm at 3 m.
        (0.4, 0, 1.2),
        (1.0, 0, 1.884),
        (2.0, 0, 6.064),
        (3.0, 0, 14.044),
        # The hyperbolic term: (60 / 30)^2 = 4 and (75 / 15)^2 = 25 times 0.1 mm at 1 m.
        (1.0, 60, 2.284),
        (1.0, 75, 4.384),
        (4.0, 60, 26.024),
    ],
)
def test_axial_formula(z, degrees, millimetres):
    found = axial_sigma(np.array([z]), np.radians(np.array([float(degrees)])))
    assert found[0] * 1000 == pytest.approx(millimetres, abs=5e-4)


@pytest.mark.parametrize(("degrees", "pixels"), [(0, 0.8), (45, 0.835), (60, 0.87), (80, 1.08)])
def test_lateral_formula(degrees, pixels):
    assert lateral_sigma(np.radians(np.array([float(degrees)])))[0] == pytest.approx(pixels)


def test_both_formulas_stay_finite_at_a_right_angle():
    angle = np.array([np.pi / 2])
    assert np.isfinite(axial_sigma(np.ones(1), angle)).all()
    assert lateral_sigma(angle)[0] < 2


@pytest.mark.parametrize("z", [0.5, 1.0, 2.5])
@pytest.mark.parametrize("degrees", [0, 30, 60, 75])
def test_depth_error_on_a_plate_has_the_published_deviation(z, degrees):
    depth = plate(CAMERA, z, degrees)
    noisy, part = kinect(depth, parts_of(depth), CAMERA, np.random.default_rng(3))
    error = (noisy - depth) / axial_sigma(depth, angles(CAMERA, degrees))
    middle = error[80:120, 80:120]
    assert middle.std() == pytest.approx(1, abs=0.06)
    assert abs(middle.mean()) < 0.1
    assert (part == 0).all()


@pytest.mark.parametrize(("focal", "sigma"), [(585.0, 0.8), (1170.0, 1.6)])
def test_outlines_are_blurred_by_the_lateral_deviation(focal, sigma):
    """Right of an edge a pixel sees the near surface if its draw is further left than the edge."""
    seen_by = camera(200, focal)
    depth = np.full((200, 200), 1.5, np.float32)
    depth[:, :100] = 1.0
    part = np.where(depth < 1.2, 0, 255).astype(np.uint8)
    noisy, label = kinect(depth, part, seen_by, np.random.default_rng(4))
    wrong = (label != part).sum(1).mean()  # on both sides together: E|s| = sigma sqrt(2 / pi)
    assert wrong == pytest.approx(sigma * np.sqrt(2 / np.pi), rel=0.12)
    assert np.abs(noisy[label == 0] - 1.0).max() < 0.02
    assert np.abs(noisy[label == 255] - 1.5).max() < 0.03


def test_without_noise_nothing_changes():
    depth = plate(CAMERA, 1.0, 40) * disc(CAMERA)
    part = parts_of(depth)
    same, label = kinect(depth, part, CAMERA, np.random.default_rng(0), QUIET)
    assert np.array_equal(same, depth)
    assert np.array_equal(label, part)


def test_lateral_noise_alone_keeps_points_on_a_plane():
    depth = plate(CAMERA, 1.0, 70)
    only = Kinect(axial=0, axial_square=0, axial_angle=0, lateral=2.0)
    moved, _ = kinect(depth, parts_of(depth), CAMERA, np.random.default_rng(0), only)
    assert np.abs(moved - depth).max() < 1e-3


def test_the_same_generator_gives_the_same_picture():
    depth = plate(CAMERA, 1.0, 40) * disc(CAMERA)
    made = [kinect(depth, parts_of(depth), CAMERA, np.random.default_rng(s)) for s in (1, 1, 2)]
    assert np.array_equal(made[0][0], made[1][0])
    assert not np.array_equal(made[0][0], made[2][0])
