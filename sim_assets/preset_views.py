# SPDX-License-Identifier: MIT
"""States and cameras of a preset: the category's window, drawn distances, or published grids.

The published pictures (PROTOCOL 2.5) look along -z at the object 1.8 ahead of it, turned -90
degrees about y and then by the view's rotation. The models' own frame is not described; that the
halves of their laptops are exchanged by (x, y, z) -> (z, -y, x) (PROTOCOL 1.2) puts the hinge
along y and one half upright along z. Here their z is up and their front faces +x, towards the
camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scapo.camera import Intrinsics
from sim_assets import presets
from sim_assets.articulated import ArticulatedObject
from sim_assets.options import Preset, Protocol
from sim_assets.presets import ThetaGrid, Thetas, ViewGrid
from sim_assets.views import (
    JITTER,
    TRAVEL,
    Outline,
    View,
    draw_direction,
    draw_views,
    frame_objects,
    look_along,
)

PUBLISHED_T_OBJECT = np.diag([-1.0, -1.0, 1.0])
"""From our object frame (front -x) to the one taken for theirs (front +x)."""
OPENCV_T_OPENGL = np.diag([1.0, -1.0, -1.0])
TURN_AWAY = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
"""-90 degrees about y."""
FULL_FRAME = 0.95
"""Largest share of the picture's side that the object's image fills."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """What views depend on."""

    preset: Preset
    protocol: Protocol
    camera: Intrinsics
    states_per_view: int
    held_out: bool
    """A test split: eyeglasses then have a published grid of their own."""


def draw_preset_views(
    outline: Outline, rngs: Sequence[np.random.Generator], wanted: Wanted
) -> list[View]:
    """For each generator, states and a camera by the preset's rules.

    Args:
        outline: Of the object.
        rngs: One per view; a view is a function of its own alone.
        wanted: Preset, protocol, camera and number of states.
    """
    rules = presets.rules(wanted.preset)
    if rules.published is not None:
        return [_published(outline.thing, rng, wanted) for rng in rngs]
    if rules.distance:
        return _at_distance(outline, rngs, wanted)
    return draw_views(outline, rngs, wanted.camera, wanted.states_per_view)


def _at_distance(
    outline: Outline, rngs: Sequence[np.random.Generator], wanted: Wanted
) -> list[View]:
    """The category's window, at drawn distances from which the whole object is in the picture.

    Where even the largest distance is too near for that, the camera stands there.
    """
    thing = outline.thing
    drawn, turns, centres, places = [], [], [], []
    for rng in rngs:
        size = (wanted.states_per_view, len(thing.upper))
        drawn.append(rng.uniform(*TRAVEL, size=size) * thing.upper)
        gaze = -draw_direction(thing.category.window, rng)
        turns.append(look_along(gaze, rng.uniform(-np.pi, np.pi)))
        centres.append(rng.uniform(-1, 1, size=2) * min(JITTER, (1 - FULL_FRAME) / 2))
        places.append(rng.uniform())
    points = np.stack([outline.posed(states) for states in drawn])
    fill = np.full(len(points), FULL_FRAME)
    poses = frame_objects(points, np.stack(turns), wanted.camera, fill, np.stack(centres))
    nearest = np.sqrt((poses[:, :3, 3] ** 2).sum(-1))
    low, high = distances(thing)
    low = np.clip(nearest, low, high)
    poses[:, :3, 3] *= ((low + np.array(places) * (high - low)) / nearest)[:, None]
    return [View(states=s, camera_T_object=p) for s, p in zip(drawn, poses, strict=True)]


def distances(thing: ArticulatedObject) -> tuple[float, float]:
    """Least and largest distance of the camera from the object's origin in `sim-art-sensor`, m."""
    large = float(np.linalg.norm(thing.extents())) > presets.LARGE
    return presets.FAR if large else presets.NEAR


def _published(thing: ArticulatedObject, rng: np.random.Generator, wanted: Wanted) -> View:
    """A sample number for each state and a view of the published grids."""
    thetas, grid = presets.windows(wanted.preset, thing.category.name, wanted.protocol)
    states = np.stack(
        [draw_state(thing, thetas, rng, wanted.held_out) for _ in range(wanted.states_per_view)]
    )
    turn = rotation(grid, rng)
    if wanted.protocol != "full":
        turn = turn @ TURN_AWAY
    pose = np.eye(4)
    pose[:3, :3] = OPENCV_T_OPENGL @ turn @ PUBLISHED_T_OBJECT
    pose[2, 3] = presets.PUBLISHED_DISTANCE * float(np.linalg.norm(thing.extents()))
    return View(states=states, camera_T_object=pose)


def draw_state(
    thing: ArticulatedObject,
    thetas: Thetas | ThetaGrid | None,
    rng: np.random.Generator,
    held_out: bool,
) -> Float[np.ndarray, " J"]:
    """Joint states of one sample, rad or m.

    Of the published angles those in the object's travel are drawn from; where there is none, the
    nearest end of the travel is taken.
    """
    k = rng.uniform()
    if thetas is None:
        return rng.uniform(*TRAVEL, size=len(thing.upper)) * thing.upper
    if isinstance(thetas, ThetaGrid):
        number = int(k * 100)
        step = thetas.test if held_out else thetas.train
        degrees = step * np.array([number // 10, number % 10])[: len(thing.upper)]
        return np.minimum(np.radians(degrees), thing.upper)
    states = np.radians(thetas.zero + thetas.degrees())
    allowed = states[(states >= 0) & (states <= thing.upper[0])]
    if not len(allowed):
        allowed = np.clip(states, 0, thing.upper[0])
    return allowed[[int(k * len(allowed))]]


def rotation(grid: ViewGrid | None, rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Of a view: three angles of the grid, or uniform over all rotations."""
    if grid is None:
        x, y, z, w = _unit(rng.standard_normal(4))
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
    angles = np.radians(grid.degrees()[rng.integers(grid.count, size=3)])
    turn = np.eye(3)
    for axis, angle in zip(grid.order, angles, strict=True):
        turn = turn @ _about(axis, angle)
    return turn


def _unit(vector: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 4"]:
    return vector / np.sqrt((vector**2).sum())


def _about(axis: str, angle: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    turn = np.eye(3)
    turn[j, j], turn[j, k], turn[k, j], turn[k, k] = c, -s, s, c
    return turn
