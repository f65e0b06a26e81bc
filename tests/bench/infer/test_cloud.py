# SPDX-License-Identifier: MIT
"""What is left of a cloud, what is said of it, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.infer.cloud import KEPT_POINTS, InputError, check_count, check_sensor, made_fit

RNG = np.random.default_rng(0)
OBJECT = RNG.uniform(-0.3, 0.3, (500, 3)) + np.array([0, 0, 1.5])


def test_points_that_are_none_are_left_out_with_their_colours():
    points = OBJECT.copy()
    points[3], points[7, 1], points[9, 2] = 0, np.nan, np.inf
    color = np.arange(500 * 3).reshape(500, 3).astype(np.uint8)
    cloud = made_fit("a", points, color, None)
    kept = np.delete(np.arange(500), [3, 7, 9])
    np.testing.assert_allclose(cloud.points, points[kept], rtol=1e-6)
    assert cloud.color is not None
    assert (cloud.color == color[kept]).all()
    assert cloud.warnings == ("3 of 500 points left out: not finite, or at 0 0 0",)


def test_more_points_than_are_needed_are_drawn():
    many = RNG.uniform(0.5, 1.5, (KEPT_POINTS + 1000, 3)).astype(np.float32)
    cloud = made_fit("a", many, None, None)
    assert len(cloud.points) == KEPT_POINTS
    assert len(np.unique(cloud.points, axis=0)) > KEPT_POINTS - 100
    assert "200,000 of 201,000 points drawn" in cloud.warnings[0]


def test_millimetres_are_refused_with_the_flag_that_mends_it():
    with pytest.raises(InputError, match=r"a\.ply: .* found one of \d+.* m; .* --scale 0.001"):
        made_fit("a.ply", 1000 * OBJECT, None, None)
    cloud = made_fit("a.ply", 1000 * OBJECT, None, 0.001)
    np.testing.assert_allclose(cloud.points, OBJECT, rtol=1e-5)
    with pytest.raises(InputError, match="another --scale"):
        made_fit("a.ply", OBJECT, None, 1000.0)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (OBJECT[:3], "expected at least 64 finite points, found 3$"),
        (np.zeros((0, 3)), "found 0$"),
        (np.full((100, 3), np.nan), "found 0 and 100 that are NaN"),
        (np.ones((100, 3)), "expected a surface"),
        (np.outer(np.linspace(0.1, 1, 200), [1.0, 0, 0]), "expected a surface"),
        (np.full((100, 3), 1e300) * RNG.normal(size=(100, 3)), "found 0 and 100 that are"),
    ],
)
def test_what_is_no_object_is_refused(points, message):
    with pytest.raises(InputError, match=message):
        made_fit("a", points, None, None)


def test_a_camera_inside_the_cloud_is_said():
    cloud = made_fit("a", OBJECT, None, None)
    assert check_sensor(cloud).warnings == ()
    centred = made_fit("a", OBJECT - OBJECT.mean(0), None, None)
    assert "--sensor" in check_sensor(centred).warnings[0]
    assert check_sensor(replace(centred, sensor=np.array([0, 0, -2.0]))).warnings == ()


def test_what_would_not_fit_is_refused_before_it_is_read():
    with pytest.raises(InputError, match="at most 50,000,000 points, found 999,999,999,999"):
        check_count("a", 999_999_999_999)
