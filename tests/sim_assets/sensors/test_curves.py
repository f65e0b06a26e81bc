# SPDX-License-Identifier: MIT
"""The picture of noise against the published curves shows what the formulas say."""

from __future__ import annotations

import numpy as np
import pytest

from sim_assets.sensors.curves import depth_error, draw, outline_error, plate


def test_plates_meet_the_axis_where_they_should():
    depth, camera = plate(1.5, np.radians(60))
    assert depth[0, 59:61].mean() == pytest.approx(1.5, rel=1e-4)
    x = (np.array([0, 119]) + 0.5 - camera.cx) / camera.fx
    points = np.stack([x * depth[0, [0, 119]], depth[0, [0, 119]]], -1)
    slope = (points[1, 1] - points[0, 1]) / (points[1, 0] - points[0, 0])
    assert np.degrees(np.arctan(slope)) == pytest.approx(60, abs=1e-3)


@pytest.mark.parametrize(
    ("model", "z", "degrees", "millimetres"),
    [
        # By hand: 1.2 + 1.9 (z - 0.4)^2 + 0.1 (theta / (90 - theta))^2 / sqrt(z)
        ("kinect", 1.0, 0, 1.884),
        ("kinect", 3.0, 45, 14.102),
        # z^2 / 0.3513 steps of 1/3, and the shift of 1/2 pixel times the slope
        ("disparity", 1.0, 0, 0.949),
        ("disparity", 2.0, 60, 4.816),
    ],
)
def test_measured_errors(model, z, degrees, millimetres):
    mean, deviation = depth_error(model, z, np.radians(degrees), np.random.default_rng(0))
    assert 1000 * deviation == pytest.approx(millimetres, rel=0.05)
    assert abs(mean) < 0.1 * deviation


@pytest.mark.parametrize(("model", "pixels"), [("kinect", 0.8), ("disparity", 0.5)])
def test_measured_outlines(model, pixels):
    assert outline_error(model, 0.0, np.random.default_rng(0)) == pytest.approx(pixels, rel=0.06)


def test_the_picture_is_written_whole(tmp_path):
    draw(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
