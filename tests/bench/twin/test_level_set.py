# SPDX-License-Identifier: MIT
"""Level sets: closed whatever the values, and where the function is 0."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from bench.twin.level_set import level_set


def test_a_ball_has_its_radius_and_volume():
    centre = np.array([9.5, 10.2, 10.5])
    nodes = np.indices((20, 21, 22)).reshape(3, -1).T
    vertices, faces = level_set((7 - np.linalg.norm(nodes - centre, axis=1)).reshape(20, 21, 22))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 7**3, rel=0.015)
    np.testing.assert_allclose(np.linalg.norm(vertices - centre, axis=1), 7, atol=0.06)


def test_a_half_space_is_cut_where_its_plane_is():
    nodes = np.indices((6, 5, 4)).reshape(3, -1).T
    normal = np.array([0.6, 0.0, 0.8])
    vertices, faces = level_set((2.2 - nodes @ normal).reshape(6, 5, 4))
    np.testing.assert_allclose(vertices @ normal, 2.2, atol=1e-9)  # linear: no error at all
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    np.testing.assert_allclose(mesh.face_normals[mesh.area_faces > 1e-9] @ normal, 1, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_any_values_have_a_closed_surface(seed: int):
    values = np.random.default_rng(seed).integers(-2, 3, (8, 9, 7)).astype(float)  # also zeros
    vertices, faces = level_set(np.pad(values, 1, constant_values=-1.0))
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ways = {tuple(pair) for pair in pairs.tolist()}
    assert len(ways) == len(pairs)  # no edge twice in one sense,
    assert ways == {(b, a) for a, b in ways}  # and each once in the other
    assert trimesh.Trimesh(vertices, faces, process=False).volume > 0


def test_nothing_inside_has_no_surface():
    vertices, faces = level_set(np.full((4, 4, 4), -1.0))
    assert vertices.shape == faces.shape == (0, 3)
