# SPDX-License-Identifier: MIT
"""Framing, windows and seeds of views."""

from __future__ import annotations

import numpy as np
import pytest

from scapo.categories import CATEGORIES, category
from scapo.geometry.camera import Intrinsics, project
from sim_assets.procedural import RECIPES, generate
from sim_assets.sampling.viewpoints import (
    FILL,
    JITTER,
    TRAVEL,
    Outline,
    direction_angles,
    draw_direction,
    draw_views,
    frame_objects,
    generator,
    hull_points,
    look_along,
)
from tests.helpers.boxes import laptop

CAMERA = Intrinsics.from_fov(np.radians(60), 256, 256)


def image_box(thing, view) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around the image of all vertices, in pixels."""
    corners = []
    for state in view.states:
        for part, pose in enumerate(thing.pose(state)):
            camera_T_part = view.camera_T_object @ pose
            points = np.asarray(thing.part_mesh(part).vertices)
            corners.append(project(points @ camera_T_part[:3, :3].T + camera_T_part[:3, 3], CAMERA))
    flat = np.concatenate(corners)
    return flat.min(0), flat.max(0)


@pytest.mark.parametrize("name", RECIPES)
def test_views_follow_the_contract(name):
    thing = generate(name, "train", 9, 0)
    window = thing.category.window
    views = draw_views(Outline(thing), [generator(name, i) for i in range(60)], CAMERA)
    for view in views:
        low, high = image_box(thing, view)
        longer = (high - low).max() / 256
        assert FILL[0] <= longer <= FILL[1]
        assert (np.abs((low + high) / 2 / 256 - 0.5) <= JITTER + 2e-3).all()
        assert (low >= 0).all()
        assert (high <= 256).all()
        share = view.states[0] / thing.upper
        assert (share >= TRAVEL[0]).all()
        assert (share <= TRAVEL[1]).all()
        rotation = view.camera_T_object[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        eye = -rotation.T @ view.camera_T_object[:3, 3]
        azimuth, elevation = direction_angles(eye)
        assert window.azimuth[0] - 1e-9 <= azimuth <= window.azimuth[1] + 1e-9
        assert window.elevation[0] - 1e-9 <= elevation <= window.elevation[1] + 1e-9
    fills = [np.ptp(np.stack(image_box(thing, view)), axis=0).max() / 256 for view in views]
    assert np.ptp(fills) > 0.3  # the range is used


def test_a_view_depends_on_its_own_generator_alone():
    outline = Outline(laptop())
    together = draw_views(outline, [generator("v", i) for i in range(9)], CAMERA)
    for i, view in enumerate(together):
        (alone,) = draw_views(outline, [generator("v", i)], CAMERA)
        assert np.array_equal(alone.camera_T_object, view.camera_T_object)
        assert np.array_equal(alone.states, view.states)


def test_one_camera_frames_all_states_of_a_view():
    thing = laptop()
    (view,) = draw_views(Outline(thing), [generator("k")], CAMERA, states=5)
    assert view.states.shape == (5, 1)
    assert np.ptp(view.states) > 0.1
    low, high = image_box(thing, view)
    assert FILL[0] <= (high - low).max() / 256 <= FILL[1]


def test_framing_solves_fill_and_centre(monkeypatch):
    monkeypatch.setattr("sim_assets.sampling.viewpoints.STEPS", 40)
    rng = generator("framing")
    points = rng.normal(size=(6, 50, 3)) * (0.3, 0.2, 0.1)
    turns = np.stack([look_along(d / np.linalg.norm(d), 0.3) for d in rng.normal(size=(6, 3))])
    fill, centre = rng.uniform(0.5, 0.9, 6), rng.uniform(-0.05, 0.05, (6, 2))
    poses = frame_objects(points, turns, CAMERA, fill, centre)
    for k in range(6):
        flat = project(points[k] @ poses[k, :3, :3].T + poses[k, :3, 3], CAMERA) / 256
        assert np.ptp(flat, axis=0).max() == pytest.approx(fill[k], abs=1e-9)
        np.testing.assert_allclose((flat.min(0) + flat.max(0)) / 2 - 0.5, centre[k], atol=1e-9)
        # The camera stays on the line through the origin along the gaze that was asked for.
        eye = -poses[k, :3, :3].T @ poses[k, :3, 3]
        np.testing.assert_allclose(eye / np.linalg.norm(eye), -turns[k, 2], atol=1e-12)


def test_directions_fill_the_window_evenly():
    window = category("laptop").window
    rng = generator("window")
    directions = np.stack([draw_direction(window, rng) for _ in range(4000)])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    azimuth, elevation = direction_angles(directions).T
    assert azimuth.min() < window.azimuth[0] + 2
    assert azimuth.max() > window.azimuth[1] - 2
    # Equal areas of the sphere: the height is uniform.
    height = np.sin(np.radians(elevation))
    low, high = np.sin(np.radians(window.elevation))
    counts, _ = np.histogram(height, bins=8, range=(low, high))
    assert counts.sum() == 4000
    assert (np.abs(counts - 500) < 5 * np.sqrt(500)).all()


@pytest.mark.parametrize(
    ("direction", "angles"),
    [((-1, 0, 0), (0, 0)), ((0, -1, 0), (90, 0)), ((0, 1, 0), (-90, 0)), ((-1, 0, 1), (0, 45))],
)
def test_azimuth_is_zero_in_front_and_counter_clockwise_from_above(direction, angles):
    np.testing.assert_allclose(direction_angles(np.array(direction, float)), angles, atol=1e-12)


def test_looking_along_a_direction():
    gaze = np.array([1.0, 0.0, 0.0])  # at the front of an object
    np.testing.assert_allclose(look_along(gaze, 0.0), [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    down = look_along(np.array([0.0, 0.0, -1.0]), 0.7)
    np.testing.assert_allclose(down @ down.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(down) == pytest.approx(1)


def test_seeds_are_the_same_everywhere():
    """Frozen numbers: a change would change every data set."""
    key = ("procedural", "laptop", "train", 1, 0)
    draws = generator(*key, 0).uniform(size=3)
    frozen = [0.20048899964972233, 0.2380110015203024, 0.04093523800845822]
    np.testing.assert_array_equal(draws, frozen)
    assert not np.allclose(draws, generator(*key, 1).uniform(size=3))


def test_hull_points_of_solids_sheets_and_lines():
    rng = generator("hull")
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    inside = rng.uniform(0.1, 0.9, (50, 3))
    found = hull_points(np.concatenate([cube, inside, cube]))
    assert sorted(map(tuple, found)) == sorted(map(tuple, cube))
    sheet = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 0]], float)
    assert len(hull_points(sheet)) == 4
    assert len(hull_points(np.array([[0.0, 0, 0], [1, 1, 1]]))) == 2


def test_every_category_has_a_window_that_makes_sense():
    for spec in CATEGORIES.values():
        assert spec.window.azimuth[0] < spec.window.azimuth[1]
        assert -90 <= spec.window.elevation[0] < spec.window.elevation[1] <= 90
