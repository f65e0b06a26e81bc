# SPDX-License-Identifier: MIT
"""Where the cameras of the presets stand, and which states they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scapo.categories import category
from scapo.geometry.camera import Intrinsics, project
from sim_assets.objects import ArticulatedObject
from sim_assets.options import Preset, Protocol
from sim_assets.procedural import generate
from sim_assets.sampling import presets
from sim_assets.sampling.presets import ThetaGrid, ViewGrid
from sim_assets.sampling.viewpoints import (
    Outline,
    View,
    Wanted,
    direction_angles,
    draw_preset_views,
    draw_state,
    draw_views,
    generator,
    rotation,
)
from tests.helpers.boxes import laptop


def wanted(preset: Preset, protocol: Protocol = "isolated", **changes) -> Wanted:
    made = Wanted(
        preset=preset,
        protocol=protocol,
        camera=presets.camera(preset, None),
        states_per_view=1,
        held_out=False,
    )
    return replace(made, **changes)


def draw(thing: ArticulatedObject, count: int, how: Wanted) -> list[View]:
    rngs = [generator("preset", how.preset, i) for i in range(count)]
    return draw_preset_views(Outline(thing), rngs, how)


def named(name: str, thing: ArticulatedObject, upper: float = 130) -> ArticulatedObject:
    """The same boxes as another category."""
    return replace(thing, category=category(name), upper=np.radians([upper]))


def test_sim_art_is_what_it_was():
    thing, how = laptop(), wanted("sim-art", "joint", states_per_view=2)
    found = draw(thing, 3, how)
    rngs = [generator("preset", "sim-art", i) for i in range(3)]
    for a, b in zip(found, draw_views(Outline(thing), rngs, how.camera, 2), strict=True):
        assert np.array_equal(a.states, b.states)
        assert np.array_equal(a.camera_T_object, b.camera_T_object)


@pytest.mark.parametrize("name", ["laptop", "basket", "drawer", "scissors", "suitcase"])
def test_sensor_cameras_stand_at_the_distances_of_the_contract_and_see_the_whole_object(name):
    thing, how = generate(name, "train", 1, 0), wanted("sim-art-sensor", "joint")
    large = np.linalg.norm(thing.extents()) > 0.6
    low, high = (1.0, 1.6) if large else (0.5, 0.9)
    views = draw(thing, 60, how)
    away = np.array([np.linalg.norm(view.camera_T_object[:3, 3]) for view in views])
    assert low - 1e-9 <= away.min() <= away.max() <= high + 1e-9
    assert away.max() > high - 0.15 * (high - low)
    if name == "scissors":  # small: never too near
        assert np.ptp(away) > 0.9 * (high - low)
    outline, camera, whole = Outline(thing), how.camera, 0
    for view in views:
        rotation_ = view.camera_T_object[:3, :3]
        assert np.allclose(rotation_ @ rotation_.T, np.eye(3))
        points = outline.posed(view.states) @ rotation_.T + view.camera_T_object[:3, 3]
        assert points[:, 2].min() > 0
        u, v = project(points, camera).T
        inside = u.min() >= 0 and v.min() >= 0 and u.max() <= 640 and v.max() <= 480
        whole += inside
        if not inside:  # only where the largest distance is too near
            assert np.linalg.norm(view.camera_T_object[:3, 3]) == pytest.approx(high)
        share = view.states[0] / thing.upper
        assert (share >= 0.15).all()
        assert (share <= 0.95).all()
        window = thing.category.window
        eye = -rotation_.T @ view.camera_T_object[:3, 3]
        azimuth, elevation = direction_angles(eye)
        assert window.azimuth[0] - 1e-6 <= azimuth <= window.azimuth[1] + 1e-6
        assert window.elevation[0] - 1e-6 <= elevation <= window.elevation[1] + 1e-6
    assert whole > 50


def on_grid(turn: np.ndarray, grid: ViewGrid) -> np.ndarray:
    """Positions on the grid of the three angles of a rotation, found by scipy."""
    angles = Rotation.from_matrix(turn).as_euler(grid.order.upper(), degrees=True)
    return (angles - grid.start) / grid.step


@pytest.mark.parametrize(("name", "order"), [("oven", "yxz"), ("laptop", "zyx")])
def test_published_cameras(name, order):
    """1.8 diagonals ahead; the rotation after the turn of -90 degrees about y is on the grid."""
    thing = named(name, laptop())
    _, grid = presets.windows("op-align", name, "isolated")
    assert grid is not None
    assert grid.order == order
    turn_away = Rotation.from_euler("y", -90, degrees=True).as_matrix()
    flip, front = np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1])
    seen = []
    for view in draw(thing, 50, wanted("op-align")):
        pose = view.camera_T_object
        diagonal = np.linalg.norm(thing.extents())
        assert pose[:3, 3] == pytest.approx([0, 0, 1.8 * diagonal])
        at = on_grid(flip @ pose[:3, :3] @ front.T @ turn_away.T, grid)
        if abs(at[1] * grid.step + grid.start) < 89:  # else the angles are not unique
            assert np.abs(at - np.rint(at)).max() < 1e-6
            assert at.min() > -1e-6
            assert at.max() < 99 + 1e-6
            seen.append(at)
    assert np.ptp(np.stack(seen), axis=0).min() > 60


def test_the_unturned_published_view_shows_the_front():
    grid = ViewGrid(order="yxz", start=0.0, step=1.0, count=1)
    assert np.allclose(rotation(grid, np.random.default_rng(0)), np.eye(3))
    thing = named("oven", laptop())
    views = draw(thing, 200, wanted("op-align"))
    eyes = np.stack([-v.camera_T_object[:3, :3].T @ v.camera_T_object[:3, 3] for v in views])
    assert (eyes[:, 0] < 1e-9).all()  # never from behind: the front faces -x


def test_complete_clouds_of_eap_are_turned_uniformly():
    thing = named("oven", laptop())
    views = draw(thing, 400, wanted("eap", "full"))
    turns = np.stack([view.camera_T_object[:3, :3] for view in views])
    assert np.linalg.det(turns) == pytest.approx(1)
    assert np.abs(turns.mean(0)).max() < 0.1
    # trace of a uniform rotation: mean 0, variance 1
    trace = np.trace(turns @ turns[::-1].transpose(0, 2, 1), axis1=1, axis2=2)
    assert trace.mean() == pytest.approx(0, abs=0.15)
    assert trace.var() == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("name", "protocol", "upper", "low", "high"),
    [
        ("laptop", "isolated", 130, 45.0, 119.25),
        ("laptop", "full", 140, 45.0, 134.1),
        ("safe", "isolated", 110, 0.0, 74.25),
        ("oven", "isolated", 130, 45.0, 114.3),
        ("oven", "isolated", 90, 45.0, 89.8),  # the published angles that this door reaches
        ("oven", "isolated", 30, 30.0, 30.0),  # none of them: the nearest end of its travel
        ("washer", "full", 135, 45.0, 134.1),
    ],
)
def test_published_states(name, protocol, upper, low, high):
    thing = named(name, laptop(), upper)
    window, _ = presets.windows("op-align", name, protocol)
    rngs = [np.random.default_rng(i) for i in range(600)]
    states = np.degrees([draw_state(thing, window, rng, False)[0] for rng in rngs])
    assert states.min() == pytest.approx(low, abs=1e-9)
    assert states.max() == pytest.approx(high, abs=1e-9)
    if upper > 45:
        assert len(np.unique(states.round(6))) > 60


def test_published_states_of_eyeglasses_are_a_grid_of_their_own_in_tests():
    thing = generate("eyeglasses", "train", 1, 0)
    thing = replace(thing, upper=np.radians([85.0, 85.0]))
    window = ThetaGrid(train=8.1, test=6.3)
    for held_out, step in ((False, 8.1), (True, 6.3)):
        rngs = [np.random.default_rng(i) for i in range(500)]
        steps = np.degrees([draw_state(thing, window, rng, held_out) for rng in rngs]) / step
        assert np.abs(steps - np.rint(steps)).max() < 1e-9
        assert len(np.unique(np.rint(steps), axis=0)) > 90
        assert steps.max() == pytest.approx(9)


def test_other_categories_move_through_their_travel():
    thing = generate("drawer", "train", 1, 0)
    states = np.array([view.states[0, 0] for view in draw(thing, 100, wanted("op-align"))])
    assert 0.15 <= (states / thing.upper[0]).min() < 0.2
    assert 0.9 < (states / thing.upper[0]).max() <= 0.95


def test_states_per_view_share_a_camera():
    (view,) = draw(named("oven", laptop()), 1, wanted("op-align", states_per_view=4))
    assert view.states.shape == (4, 1)
    assert len(np.unique(view.states)) > 1
    assert isinstance(wanted("eap").camera, Intrinsics)
