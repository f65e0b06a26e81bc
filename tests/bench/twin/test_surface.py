# SPDX-License-Identifier: MIT
"""Surfaces of parts: closed whatever the points, and near to the shapes that those are of."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from bench.twin.surface import MAX_FACES, Samples, closed_mesh, joined, seen_samples
from tests.helpers import twins

STEP = 0.05
"""Between samples, m."""


def box_samples(size: tuple[float, float, float]) -> Samples:
    return twins.box_samples(size, step=STEP)


def check_closed(mesh: trimesh.Trimesh) -> None:
    """As trimesh, which has no part in making it, sees it."""
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert len(mesh.faces) <= MAX_FACES
    assert np.isfinite(mesh.vertices).all()


def farthest(mesh: trimesh.Trimesh, points: np.ndarray) -> float:
    return float(np.abs(trimesh.proximity.closest_point(mesh, points)[1]).max())


def test_a_box_comes_back_as_a_solid_box():
    samples, true = box_samples((0.4, 0.5, 0.6)), trimesh.creation.box((0.4, 0.5, 0.6))
    mesh = closed_mesh(samples)
    check_closed(mesh)
    assert mesh.euler_number == 2  # one piece, no handle, no cavity
    assert mesh.volume == pytest.approx(true.volume, rel=0.06)
    assert farthest(true, mesh.vertices) < STEP / 4
    assert farthest(mesh, samples.points[::7]) < STEP / 2  # corners are rounded off


def test_a_plate_far_thinner_than_its_points_are_apart_has_no_holes():
    mesh = closed_mesh(box_samples((0.6, 0.4, 0.004)))
    check_closed(mesh)
    assert mesh.euler_number == 2
    assert np.sort(mesh.extents)[0] < STEP
    middle = np.array([[x, y, 0.0] for x in np.linspace(-0.24, 0.24, 9) for y in (-0.14, 0, 0.14)])
    assert mesh.contains(middle).all()


@pytest.mark.parametrize("count", [1000, pytest.param(4000, marks=pytest.mark.slow)])
def test_a_large_thin_plate_is_closed(count: int):
    """Its surface is large for its grid, by which `manifold3d.Manifold.level_set` crashed."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (count, 3)) * [0.9, 0.6, 0.0]
    points[:, 2] = rng.normal(0, 0.002, count)
    mesh = closed_mesh(seen_samples(points, np.array([0.0, 0.0, 5.0])))
    check_closed(mesh)
    assert mesh.extents == pytest.approx([0.9, 0.6, 0.0], abs=0.06)
    assert farthest(mesh, points[::7]) < 0.04
    middle = np.column_stack([points[::50, :2] * 0.9, np.zeros(count // 50)])
    assert mesh.contains(middle).mean() > 0.9


def test_the_sense_of_normals_does_not_matter():
    samples = box_samples((0.4, 0.5, 0.6))
    flip = np.random.default_rng(0).choice([-1.0, 1.0], (len(samples.points), 1))
    mesh = closed_mesh(Samples(points=samples.points, normals=samples.normals * flip))
    check_closed(mesh)
    assert mesh.volume == pytest.approx(0.4 * 0.5 * 0.6, rel=0.1)


def test_what_lies_inside_is_no_surface_and_a_stray_point_no_piece():
    outer, inner = box_samples((0.4, 0.5, 0.6)), box_samples((0.1, 0.1, 0.1))
    points = np.concatenate([outer.points, inner.points, [[0.9, 0.0, 0.0]]])
    normals = np.concatenate([outer.normals, inner.normals, [[1.0, 0.0, 0.0]]])
    mesh = closed_mesh(Samples(points=points, normals=normals))
    check_closed(mesh)
    assert mesh.body_count == 1
    assert mesh.volume == pytest.approx(0.4 * 0.5 * 0.6, rel=0.06)
    assert mesh.bounds[1, 0] < 0.25


def test_a_box_whose_back_nobody_saw_stays_open_there():
    samples = box_samples((0.4, 0.5, 0.6))
    seen = samples.points[:, 0] < 0.19
    mesh = closed_mesh(Samples(points=samples.points[seen], normals=samples.normals[seen]))
    check_closed(mesh)
    assert mesh.volume < 0.4 * 0.4 * 0.5 * 0.6
    assert not mesh.contains([[0.0, 0.0, 0.0]])[0]


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 3)),
        np.array([[0.0, 0, 0], [0.1, 0, 0]]),
        np.zeros((5, 3)),
        np.linspace([0.0, 0, 0], [0.3, 0, 0], 30),
        np.random.default_rng(3).normal(size=(7, 3)),
        np.random.default_rng(4).normal(size=(200, 3)) * 0.05 + 1.0,
    ],
    ids=["one", "two", "one five times", "a line", "seven", "a ball of noise"],
)
def test_any_points_have_a_closed_mesh_about_them(points: np.ndarray):
    mesh = closed_mesh(seen_samples(points, np.array([0.0, 0.0, -5.0])))
    check_closed(mesh)
    assert mesh.bounding_box.volume > 0
    twice = closed_mesh(seen_samples(points, np.array([0.0, 0.0, -5.0])))
    np.testing.assert_array_equal(twice.vertices, mesh.vertices)
    np.testing.assert_array_equal(twice.faces, mesh.faces)


def test_nothing_has_no_surface():
    with pytest.raises(ValueError, match="expected at least one point, found none"):
        closed_mesh(Samples(points=np.zeros((0, 3)), normals=np.zeros((0, 3))))


def test_normals_of_seen_points_look_at_the_camera():
    samples = box_samples((0.4, 0.5, 0.6))
    camera = np.array([-2.0, 0.5, 1.0])
    seen = ((camera - samples.points) * samples.normals).sum(-1) > 0
    # Away from the edges, where neighbours lie on one face.
    inner = (np.abs(samples.points) < np.array([0.2, 0.25, 0.3]) - 0.15).sum(-1) == 2
    found = seen_samples(samples.points[seen], camera)
    np.testing.assert_array_equal(found.points, samples.points[seen])
    cosine = (found.normals * samples.normals[seen]).sum(-1)
    assert cosine[inner[seen]].min() > 0.99


def test_where_nobody_saw_a_plate_a_dense_depth_image_tears_no_holes():
    """Most samples are then observed ones, whose spacing is none that the model's can be met by."""
    model = box_samples((0.6, 0.4, 0.02))
    x, y = np.meshgrid(np.linspace(-0.3, 0.2, 120), np.linspace(-0.2, 0.2, 96))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.01)])
    mesh = closed_mesh(joined(model, seen_samples(points, np.array([0.0, 0.0, 5.0]))))
    check_closed(mesh)
    assert mesh.euler_number == 2
    assert farthest(mesh, model.points) < STEP / 2


def test_observed_points_take_the_place_of_the_models():
    model = box_samples((0.4, 0.5, 0.6))
    top = model.points[:, 2] > 0.299
    up = model.normals[:, 2] > 0.5
    seen = Samples(points=model.points[up] + [0, 0, 0.01], normals=model.normals[up])
    both = joined(model, seen)
    tree = KDTree(np.hstack([both.points, both.normals]))
    own = tree.query(np.hstack([model.points, model.normals]))[0] < 1e-9
    assert not own[up].any()  # replaced
    assert own[~up & ~top].all()
    none = Samples(points=np.zeros((0, 3)), normals=np.zeros((0, 3)))
    assert joined(model, none) is model
    assert joined(none, seen) is seen
    stray = Samples(points=seen.points + np.array([0, 0, 0.5]), normals=seen.normals)
    assert joined(model, stray) is model
    rough = np.random.default_rng(0).normal(0, 0.03, seen.points.shape)
    noisy = seen_samples(seen.points + rough, np.array([0.0, 0.0, 5.0]))
    assert noisy.noise == pytest.approx(0.03, rel=0.3)
    assert joined(model, noisy) is model
