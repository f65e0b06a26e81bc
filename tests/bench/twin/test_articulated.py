# SPDX-License-Identifier: MIT
"""Links and joints of a twin against boxes whose every number is known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from bench.twin.articulated import LEAST_GYRATION, LEAST_MASS, articulated, inertia, motion
from bench.twin.record import BACKGROUND, Shape
from scapo.export.urdf import DENSITY
from tests.helpers.twins import STEP, Made, cabinet


@pytest.fixture(scope="module")
def opened() -> Made:
    """A safe whose door is orange."""
    part = cabinet(0.9).twin.part
    color = np.where(part[:, None] == 1, [[250, 128, 0]], [[10, 20, 30]])
    return cabinet(0.9, color=color.astype(np.uint8))


@pytest.mark.parametrize(("name", "state"), [("safe", 0.9), ("drawer", 0.2)])
def test_parts_are_brought_to_state_0_in_the_roots_frame(name: str, state: float, opened: Made):
    made = opened if name == "safe" else cabinet(state, name)
    found = articulated(made.twin)
    assert [link.name for link in found.links] == list(made.twin.category.parts)
    for link, box in zip(found.links, made.boxes, strict=True):
        corners = np.array([link.surfaces[0].vertices.min(0), link.surfaces[0].vertices.max(0)])
        np.testing.assert_allclose(corners, box.bounds, atol=0.8 * STEP)
    joint = found.joints[0]
    np.testing.assert_allclose(joint.axis, made.axis, atol=1e-5)
    np.testing.assert_allclose(joint.pivot, made.pivot, atol=1e-5)
    assert found.state == {joint.name: pytest.approx(state)}
    np.testing.assert_allclose(found.camera_T_root, made.camera_T_object, atol=1e-6)


def test_motion_is_what_trimesh_says():
    pivot, axis = np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.6, 0.8])
    expected = trimesh.transformations.rotation_matrix(0.7, axis, pivot)
    np.testing.assert_allclose(motion(pivot, axis, 0.7, "revolute"), expected, atol=1e-12)
    expected = trimesh.transformations.translation_matrix(0.7 * axis)
    np.testing.assert_allclose(motion(pivot, axis, 0.7, "prismatic"), expected, atol=1e-12)


def test_inertia_of_a_box_is_that_of_the_textbook():
    size, at = np.array([0.4, 0.5, 0.6]), np.array([1.0, -2.0, 0.5])
    body = inertia(trimesh.creation.box(size).apply_translation(at))
    mass = DENSITY * size.prod()
    assert body.mass == pytest.approx(mass)
    np.testing.assert_allclose(body.centre, at, atol=1e-9)
    expected = mass / 12 * (np.sum(size**2) - size**2) + mass * LEAST_GYRATION
    np.testing.assert_allclose(body.moments, np.diag(expected), atol=1e-9 * mass)


def test_no_inertia_is_degenerate():
    body = inertia(trimesh.creation.box((0.2, 1e-5, 1e-5)))
    assert body.mass == LEAST_MASS
    moments = np.linalg.eigvalsh(body.moments)
    assert moments[0] > 0
    assert moments[2] <= moments[:2].sum() * (1 + 1e-9)  # as real bodies have


def test_what_was_not_seen_has_no_surface_unless_the_model_knows_it():
    nothing = np.full(len(cabinet().twin.part), BACKGROUND)
    door = cabinet().twin.shape
    assert door is not None
    own = door.part == 1
    known = Shape(points=door.points[own], normals=door.normals[own], part=door.part[own])
    body, door = articulated(cabinet(part=nothing, shape=known).twin).links
    assert body.surfaces == ()
    assert body.inertia is not None
    assert len(door.surfaces) == 1


def test_colours_are_those_that_were_observed(opened: Made):
    links = articulated(opened.twin).links
    np.testing.assert_allclose(links[1].surfaces[0].color, (250 / 255, 128 / 255, 0, 1), atol=1e-6)
    assert links[0].surfaces[0].color[2] == pytest.approx(30 / 255)


def test_parts_that_meet_at_the_hinge_keep_their_hulls(opened: Made):
    for link in articulated(opened.twin).links:
        assert link.collision is not None
        hull = trimesh.Trimesh(link.collision[0].vertices, link.collision[0].faces)
        assert hull.is_convex
        shown = trimesh.Trimesh(link.surfaces[0].vertices, link.surfaces[0].faces)
        assert hull.volume >= shown.volume * (1 - 1e-6)
