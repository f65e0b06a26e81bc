# SPDX-License-Identifier: MIT
"""Two-sided surfaces: closed shells stay and look outward, all else is seen from both sides."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sim_assets.models.meshes import solid
from sim_assets.models.sides import number_rows, two_sided, used_vertices


def front_faces(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, target: np.ndarray
) -> float:
    """Depth of the first face that looks towards the viewer along the ray, inf if none."""
    direction = (target - origin) / np.linalg.norm(target - origin)
    best = np.inf
    for a, b, c in vertices[faces]:
        normal = np.cross(b - a, c - a)
        slope = normal @ direction
        if slope >= 0:
            continue
        depth = normal @ (a - origin) / slope
        point = origin + depth * direction
        inside = [
            np.cross(q - p, point - p) @ normal >= -1e-12 for p, q in ((a, b), (b, c), (c, a))
        ]
        if depth > 0 and all(inside):
            best = min(best, depth)
    return best


def any_face(vertices: np.ndarray, faces: np.ndarray, *ray: np.ndarray) -> float:
    both = np.concatenate([faces, faces[:, ::-1]])
    return front_faces(vertices, both, *ray)


@pytest.mark.parametrize("seed", range(6))
def test_culling_changes_nothing(seed: int):
    """Of a box with some faces turned or missing, a culled picture is the full picture."""
    rng = np.random.default_rng(seed)
    box = trimesh.creation.box((1.0, 0.7, 0.4))
    faces = box.faces[rng.permutation(12)[: 12 - seed]].copy()
    turned = rng.random(len(faces)) < 0.4
    faces[turned] = faces[turned][:, ::-1]
    vertices = np.asarray(box.vertices)
    result = two_sided(vertices, faces)
    for _ in range(40):
        origin = rng.normal(size=3)
        origin *= 2 / np.linalg.norm(origin)
        ray = origin, rng.uniform(-0.3, 0.3, 3)
        assert front_faces(vertices, result, *ray) == pytest.approx(any_face(vertices, faces, *ray))


def test_closed_shells_are_kept_and_turned_outward():
    box = trimesh.creation.box((1, 1, 1))
    far = trimesh.creation.icosphere(subdivisions=1).apply_translation((5, 0, 0))
    vertices = np.concatenate([box.vertices, far.vertices])
    faces = np.concatenate([box.faces[:, ::-1], far.faces + 8])
    result = two_sided(vertices, faces)
    assert len(result) == len(faces)
    mesh = trimesh.Trimesh(vertices, result, process=False)
    assert mesh.volume == pytest.approx(box.volume + far.volume)


@pytest.mark.parametrize("inverted", [False, True])
def test_shells_that_touch_along_an_edge_are_told_apart(inverted: bool):
    one = trimesh.creation.box((1, 1, 1))
    two = one.copy().apply_translation((1, 1, 0))
    faces = np.concatenate([one.faces, (two.faces[:, ::-1] if inverted else two.faces) + 8])
    vertices = np.concatenate([one.vertices, two.vertices])
    result = two_sided(vertices, faces)
    assert len(result) == 24
    assert trimesh.Trimesh(vertices, result, process=False).volume == pytest.approx(2)


def test_unmerged_vertices_count_as_one():
    box = trimesh.creation.box((1, 1, 1))
    soup = box.triangles.reshape(-1, 3)
    assert len(two_sided(soup, np.arange(36).reshape(12, 3))) == 12


def test_faces_there_twice_get_no_third():
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    one = np.array([[0, 1, 2], [0, 2, 3]])
    both = np.concatenate([one, one[:, ::-1]])
    assert len(two_sided(quad, one)) == 4
    assert len(two_sided(quad, both)) == 4


def test_faces_without_area_go():
    line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]], float)
    assert len(two_sided(line, np.array([[0, 1, 2], [0, 1, 3], [1, 1, 3]]))) == 2


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        ("box", (1.0, 2.0, 3.0), 6.0),
        ("sphere", (0.5,), 4 / 3 * np.pi * 0.125),
        ("cylinder", (0.5, 2.0), np.pi * 0.5),
        ("capsule", (0.5, 2.0), np.pi * 0.5 + 4 / 3 * np.pi * 0.125),
    ],
)
def test_solids_are_closed_centred_and_fine(kind: str, size: tuple[float, ...], volume: float):
    mesh = solid(kind, size)  # pyright: ignore[reportArgumentType]
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=1e-3)
    np.testing.assert_allclose(mesh.bounds.mean(0), 0, atol=1e-9)
    if kind == "cylinder":
        np.testing.assert_allclose(mesh.extents, (1, 1, 2), rtol=1e-4)
    if kind == "capsule":
        np.testing.assert_allclose(mesh.extents, (1, 1, 3), rtol=1e-4)


@pytest.mark.parametrize("high", [3, 1 << 20, 1 << 40])
def test_rows_are_numbered_as_numpy_does(high: int):
    """Small numbers are packed into one, large ones sorted by column."""
    rng = np.random.default_rng(high)
    for count in (0, 1, 2, 500):
        rows = rng.integers(-high, high, (count, 3))
        rows[: count // 2] = rows[count - count // 2 :]
        expected = np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
        assert np.array_equal(number_rows(rows), expected)
        assert np.array_equal(used_vertices(abs(rows) % 1000), np.unique(abs(rows) % 1000))
