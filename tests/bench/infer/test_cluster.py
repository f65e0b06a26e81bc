# SPDX-License-Identifier: MIT
"""Without a mask the nearest thing on the floor is found, whatever stands behind it."""

from __future__ import annotations

import numpy as np
import pytest

from bench.infer.cluster import nearest_object
from scapo.geometry.camera import Intrinsics

CAMERA = Intrinsics(fx=120, fy=120, cx=80, cy=60, width=160, height=120)


def scene(*spheres: tuple[float, float, float, float], floor: bool, wall: bool):
    """Depths of spheres (x, y, z, radius) on a floor 0.5 m below the camera, a wall 3 m away."""
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    ray = np.stack([(u - 80) / 120, (v - 60) / 120, np.ones_like(u)], -1)
    depth, label = np.full((120, 160), np.inf), np.full((120, 160), -1)
    if floor:
        with np.errstate(divide="ignore"):
            depth = np.where(ray[..., 1] > 0.1, 0.5 / ray[..., 1], depth)
    if wall:
        depth = np.minimum(depth, 3.0)
    for k, (x, y, z, radius) in enumerate(spheres):
        centre = np.array([x, y, z])
        a, b = (ray**2).sum(-1), ray @ centre
        root = b**2 - a * (centre @ centre - radius**2)
        t = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        label = np.where(t < depth, k, label)
        depth = np.minimum(t, depth)
    return np.where(np.isfinite(depth), depth, 0.0), label


@pytest.mark.parametrize("floor", [True, False])
@pytest.mark.parametrize("wall", [True, False])
def test_the_nearest_thing_is_found(floor, wall):
    depth, label = scene((0.3, 0.2, 2.2, 0.3), (-0.2, 0.25, 1.5, 0.25), floor=floor, wall=wall)
    shown, (words,) = nearest_object(depth, CAMERA)
    wanted = label == 1
    assert (shown & wanted).sum() / (shown | wanted).sum() > 0.93
    assert words.startswith(f"no --mask: {floor + wall} plane(s)")


def test_a_flat_thing_is_no_wall():
    depth = np.zeros((120, 160))
    depth[30:90, 40:110] = 1.2
    shown, _ = nearest_object(depth, CAMERA)
    assert (shown == (depth > 0)).all()


def test_where_there_is_only_a_wall_all_is_taken():
    shown, (words,) = nearest_object(np.full((120, 160), 2.0), CAMERA)
    assert shown.all()
    assert "1 piece(s)" in words


def boxed(depth: np.ndarray, rows: slice, columns: slice, at: float) -> None:
    depth[rows, columns] = np.where(
        depth[rows, columns] > 0, np.minimum(depth[rows, columns], at), at
    )


@pytest.mark.parametrize("floor", [True, False])
def test_an_object_is_taken_whole_with_its_open_door_and_what_is_apart_from_it(floor):
    """A body 0.4 m wide, a door 0.15 m before it, a bar beside it; far behind it another thing."""
    depth, _ = scene(floor=floor, wall=floor)
    before = depth.copy()
    boxed(depth, slice(10, 30), slice(120, 150), 2.6)
    for rows, columns, at in (
        (slice(40, 80), slice(50, 98), 1.0),
        (slice(45, 75), slice(60, 80), 0.85),
        (slice(40, 80), slice(101, 103), 1.0),
    ):
        boxed(depth, rows, columns, at)
    wanted = (depth != before) & (depth < 2)
    shown, _ = nearest_object(depth, CAMERA)
    assert (shown & wanted).sum() / (shown | wanted).sum() > 0.9
