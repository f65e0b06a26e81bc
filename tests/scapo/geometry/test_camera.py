# SPDX-License-Identifier: MIT
"""The pinhole camera: projection against the textbook matrix, and back again."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scapo.geometry.camera import Intrinsics, back_project, project
from tests.helpers.strategies import seeds

CAMERA = Intrinsics(fx=600.0, fy=580.0, cx=310.0, cy=250.0, width=640, height=480)
quick = settings(max_examples=15, deadline=None)


def cloud(seed: int, count: int = 50) -> np.ndarray:
    """Points in front of the camera."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.5, -0.5, 0.3], [0.5, 0.5, 2.0], (count, 3))


@quick
@given(seed=seeds)
def test_project_is_the_camera_matrix(seed: int) -> None:
    points = cloud(seed)
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    homogeneous = points @ matrix.T
    expected = homogeneous[:, :2] / homogeneous[:, 2:]
    np.testing.assert_allclose(project(points, CAMERA), expected)


def test_axes_are_those_of_opencv() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [0.1, 0.1, 2.0]])
    expected = [[310, 250], [370, 250], [310, 308], [340, 279]]
    np.testing.assert_allclose(project(points, CAMERA), expected)


@quick
@given(seed=seeds, dtype=st.sampled_from([np.float32, np.float64]))
def test_back_projected_pixels_project_to_their_centres(seed: int, dtype: type) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 2.0, (480, 640)).astype(dtype)
    mask = rng.uniform(size=(480, 640)) < 0.001
    points = back_project(depth, mask, CAMERA)
    v, u = np.nonzero(mask)
    np.testing.assert_allclose(project(points, CAMERA), np.stack([u, v], -1) + 0.5, atol=1e-9)
    np.testing.assert_array_equal(points[:, 2], depth[mask])


def test_points_seen_in_a_depth_image_come_back() -> None:
    """A plane drawn pixel by pixel from its equation n . x = d."""
    normal, distance = np.array([0.2, -0.1, 0.9]), 0.8
    v, u = np.mgrid[0:480, 0:640] + 0.5
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    depth = distance / (rays @ normal)
    points = back_project(depth, np.ones((480, 640), bool), CAMERA)
    np.testing.assert_allclose(points @ normal, np.full(480 * 640, distance))
    np.testing.assert_allclose(points, (rays * depth[..., None]).reshape(-1, 3))


def test_pixels_come_row_by_row_and_an_empty_mask_gives_none() -> None:
    depth = np.arange(1.0, 7.0).reshape(2, 3)
    mask = np.array([[True, False, True], [False, True, False]])
    camera = Intrinsics(fx=1.0, fy=1.0, cx=1.5, cy=1.0, width=3, height=2)
    expected = [[-1.0, -0.5, 1.0], [3.0, -1.5, 3.0], [0.0, 2.5, 5.0]]
    np.testing.assert_allclose(back_project(depth, mask, camera), expected)
    assert back_project(depth, np.zeros_like(mask), camera).shape == (0, 3)


@pytest.mark.parametrize("degrees", [10.0, 60.0, 120.0])
def test_the_field_of_view_spans_the_height(degrees: float) -> None:
    fov = math.radians(degrees)
    camera = Intrinsics.from_fov(fov, 640, 480)
    edge = np.array([[0, -math.tan(fov / 2), 1.0], [0, math.tan(fov / 2), 1.0], [0, 0, 1.0]])
    expected = [[320, 0], [320, 480], [320, 240]]
    np.testing.assert_allclose(project(edge, camera), expected, atol=1e-9)
    assert camera.fx == camera.fy
    assert camera.row() == (camera.fx, camera.fy, 320.0, 240.0, 640.0, 480.0)


@pytest.mark.parametrize(
    ("fov", "width", "height"),
    [(0.0, 4, 4), (-1.0, 4, 4), (math.pi, 4, 4), (math.nan, 4, 4), (1.0, 0, 4), (1.0, 4, -4)],
)
def test_impossible_cameras_are_refused(fov: float, width: int, height: int) -> None:
    with pytest.raises(ValueError, match=rf"camera: expected .*found {fov} and {width} x {height}"):
        Intrinsics.from_fov(fov, width, height)
