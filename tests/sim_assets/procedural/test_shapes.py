# SPDX-License-Identifier: MIT
"""Primitives of procedural shapes against their volumes and extents by formula."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
import trimesh

from sim_assets.procedural import shapes
from sim_assets.procedural import shapes as solids


def closed(mesh: trimesh.Trimesh) -> bool:
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


def test_box_volume():
    mesh = solids.box((-1, 0, 2), (1, 3, 2.5))
    assert closed(mesh)
    assert mesh.volume == pytest.approx(3.0)
    np.testing.assert_allclose(mesh.bounds, [[-1, 0, 2], [1, 3, 2.5]])


def test_tub_holds_what_its_inside_measures():
    outer, wall, floor = (0.4, 0.3, 0.2), 0.01, 0.02
    mesh = solids.tub(outer, wall, floor, 1e-4)
    solid = 0.4 * 0.3 * 0.2 - 0.38 * 0.28 * 0.18
    assert closed(mesh)
    assert mesh.volume == pytest.approx(solid, rel=1e-3)


def test_lathe_and_sweep_make_a_torus():
    count, big, small = 96, 0.5, 0.1
    angle = 2 * pi * np.arange(count) / count
    path = big * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    section = shapes.superellipse(2 * small, 2 * small, 2.0, count)
    mesh = shapes.sweep(path, section, (0, 0, 1), closed=True)
    assert closed(mesh)
    assert mesh.volume == pytest.approx(2 * pi**2 * big * small**2, rel=5e-3)
    cylinder = solids.cylinder(0.2, -0.1, 0.3, count=96)
    assert closed(cylinder)
    assert cylinder.volume == pytest.approx(pi * 0.04 * 0.4, rel=2e-3)


def test_ellipsoid_volume():
    mesh = solids.ellipsoid((0.2, 0.4, 0.6), 48)
    assert closed(mesh)
    assert mesh.volume == pytest.approx(pi / 6 * 0.2 * 0.4 * 0.6, rel=1e-2)


@pytest.mark.parametrize("bevel", [0.0, 0.004, 0.5])
def test_slab_is_closed_and_fills_its_box(bevel: float):
    mesh = solids.slab(0.3, 0.2, 0.02, 0.03, bevel)
    assert closed(mesh)
    np.testing.assert_allclose(mesh.bounds, [[-0.15, -0.1, 0], [0.15, 0.1, 0.02]], atol=1e-9)


def test_open_sweep_keeps_its_profile_upright():
    path = np.array([[0, 0, 0], [1, 0, 0], [2, 0.0, 0]], float)
    mesh = shapes.sweep(path, shapes.rectangle(0.2, 0.4, 1e-4), (0, 0, 1))
    assert closed(mesh)
    np.testing.assert_allclose(mesh.extents, [2, 0.2, 0.4], atol=1e-9)


def test_placing_and_mirroring_keep_surfaces_outwards():
    mesh = solids.slab(0.3, 0.2, 0.02, 0.03, 0.002)
    assert closed(shapes.mirrored(mesh, 1))
    for frame in (shapes.FRONT, shapes.ALONG_X, shapes.ALONG_Y, shapes.DOWN):
        np.testing.assert_allclose(np.linalg.det(frame), 1.0)
        assert closed(shapes.placed(mesh, (1, 2, 3), frame))
    right, up, ahead = shapes.FRONT.T
    assert (right.tolist(), up.tolist(), ahead.tolist()) == ([0, -1, 0], [0, 0, 1], [-1, 0, 0])
    both = shapes.merged(mesh, shapes.placed(mesh, (1, 0, 0)))
    assert both.volume == pytest.approx(2 * mesh.volume)


def test_loops():
    loop = shapes.resampled(shapes.rectangle(2.0, 1.0, 0.2), 64)
    steps = np.linalg.norm(np.diff(np.concatenate([loop, loop[:1]]), axis=0), axis=1)
    assert steps.max() < 1.01 * np.median(steps)
    path = shapes.bezier((0, 0, 0), (1, 0, 0), (1, 1, 0), 5)
    np.testing.assert_allclose(path[2], [0.75, 0.25, 0])
