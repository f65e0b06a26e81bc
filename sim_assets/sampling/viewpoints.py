# SPDX-License-Identifier: MIT
"""Joint states and cameras of views, by the rules of a preset.

`sim-art`: states are uniform in the category's travel. The camera stands in its viewing window,
seen from the origin of the object frame; its distance is solved so that the box around the object's
image fills the drawn share of the image, and its gaze is turned so that this box lies at the drawn
place. Roll is uniform, since poses are arbitrary in SE(3). `sim-art-sensor`: the same at a drawn
distance.

`op-align` and `eap`: the published pictures look along -z at the object 1.8 ahead of it, turned -90
degrees about y and then by the view's rotation. The models' own frame is not described; that the
halves of their laptops are exchanged by (x, y, z) -> (z, -y, x) puts the hinge along y and one half
upright along z. Here their z is up and their front faces +x, towards the camera.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from scapo.categories import Window
from scapo.geometry.camera import Intrinsics
from scapo.geometry.matrices import moved
from sim_assets.models.joints import farthest
from sim_assets.objects import ArticulatedObject
from sim_assets.options import PresetName, Protocol
from sim_assets.sampling import presets
from sim_assets.sampling.presets import AngleGrid, AngleSequence, ViewGrid

TRAVEL = (0.15, 0.95)
"""States are drawn from this share of the travel."""
FILL = (0.5, 0.9)
"""The longer side of the object's image, as a share of the image's side."""
FILL_MARGIN = 0.006
"""Kept from both ends of FILL: whole pixels, STEPS and OUTLINE_DIRECTIONS cost less."""
FULL_FRAME = 0.95
"""Largest share of the picture's side that the object's image fills."""
JITTER = 0.05
"""Largest offset of the box's centre from the image's centre, as a share of the image's side."""
OUTLINE_DIRECTIONS = 400
"""In which the outermost points of each part are kept."""
STEPS = 12
"""Of the fixed-point iteration that frames the object; 1e-3 of the image is left at most."""
PUBLISHED_T_OBJECT = np.diag([-1.0, -1.0, 1.0])
"""From our object frame (front -x) to the one taken for theirs (front +x)."""
OPENCV_T_OPENGL = np.diag([1.0, -1.0, -1.0])
TURN_AWAY = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
"""-90 degrees about y."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One camera, and the states that are seen from it."""

    states: Float[np.ndarray, "K J"]
    """rad or m."""
    camera_T_object: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewOptions:
    """What the states and cameras of views depend on, besides the object."""

    preset: PresetName
    protocol: Protocol
    camera: Intrinsics
    states_per_view: int
    held_out: bool
    """A test split: eyeglasses then have a published grid of their own."""


def generator(*key: object) -> np.random.Generator:
    """A generator seeded by the SHA-256 of the key: the same numbers on every machine."""
    text = json.dumps(key, separators=(",", ":"))
    words = np.frombuffer(hashlib.sha256(text.encode()).digest(), "<u4")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words.tolist())))


class Outline:
    """The points of each part that lie on the outline of its image, or close to it."""

    def __init__(self, thing: ArticulatedObject) -> None:
        self.thing = thing
        self.parts = [
            outermost(hull_points(np.asarray(thing.part_mesh(part).vertices)))
            for part in range(len(thing.visuals))
        ]

    def posed(self, states: Float[np.ndarray, "K J"]) -> Float[np.ndarray, "V 3"]:
        """The outline points in the object frame at all of these states together."""
        found = [self.parts[0]]
        for state in states:
            poses = self.thing.pose(state)
            found += map(moved, self.parts[1:], poses[1:])
        return np.concatenate(found)


def hull_points(points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "_ 3"]:
    """The points on the convex hull; all distinct points where they lie in a plane."""
    ordered = points[np.lexsort(points.T[::-1])]
    distinct = ordered[np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(1)])]
    try:
        return distinct[ConvexHull(distinct).vertices]
    except (QhullError, ValueError):
        return distinct


def outermost(points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "_ 3"]:
    """Those that are farthest along one of many directions, spread evenly over the sphere.

    Rounded parts have hundreds of points on their hull. Between two directions a ball of radius r
    is cut by 0.006 r at most, where a shape of flat sides and corners loses nothing.
    """
    index = np.arange(OUTLINE_DIRECTIONS) + 0.5
    z = 1 - 2 * index / OUTLINE_DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * index  # a spiral with the golden angle
    level = np.sqrt(1 - z * z)
    directions = np.stack([level * np.cos(turn), level * np.sin(turn), z])
    return points[farthest(points, directions)]


def draw_preset_views(
    outline: Outline, rngs: Sequence[np.random.Generator], options: ViewOptions
) -> list[View]:
    """For each generator, states and a camera by the preset's rules.

    Args:
        outline: Of the object.
        rngs: One per view; a view is a function of its own alone.
        options: Preset, protocol, camera and number of states.
    """
    preset = presets.find_preset(options.preset)
    if preset.published is not None:
        return [_published(outline.thing, rng, options) for rng in rngs]
    if preset.distance:
        return _at_distance(outline, rngs, options)
    return draw_views(outline, rngs, options.camera, options.states_per_view)


def draw_views(
    outline: Outline, rngs: Sequence[np.random.Generator], camera: Intrinsics, states: int = 1
) -> list[View]:
    """For each generator, draw states and a camera that frames the object in all of them.

    Views are framed together, which is many times faster than one by one; each is a function of
    its own generator alone.
    """
    thing = outline.thing
    drawn, turns, fills, centres = [], [], [], []
    for rng in rngs:
        drawn.append(draw_states(thing, rng, states))
        direction = draw_direction(thing.category.window, rng)
        turns.append(look_along(-direction, rng.uniform(-np.pi, np.pi)))
        fills.append(rng.uniform(FILL[0] + FILL_MARGIN, FILL[1] - FILL_MARGIN))
        centres.append(rng.uniform(-1, 1, size=2) * min(JITTER, 0.4 * (1 - fills[-1])))
    points = np.stack([outline.posed(state) for state in drawn])
    poses = frame_objects(points, np.stack(turns), camera, np.array(fills), np.stack(centres))
    return [View(states=s, camera_T_object=p) for s, p in zip(drawn, poses, strict=True)]


def _at_distance(
    outline: Outline, rngs: Sequence[np.random.Generator], options: ViewOptions
) -> list[View]:
    """The category's window, at drawn distances from which the whole object is in the picture.

    Where even the largest distance is too near for that, the camera stands there.
    """
    thing = outline.thing
    drawn, turns, centres, places = [], [], [], []
    for rng in rngs:
        drawn.append(draw_states(thing, rng, options.states_per_view))
        gaze = -draw_direction(thing.category.window, rng)
        turns.append(look_along(gaze, rng.uniform(-np.pi, np.pi)))
        centres.append(rng.uniform(-1, 1, size=2) * min(JITTER, (1 - FULL_FRAME) / 2))
        places.append(rng.uniform())
    points = np.stack([outline.posed(states) for states in drawn])
    fill = np.full(len(points), FULL_FRAME)
    poses = frame_objects(points, np.stack(turns), options.camera, fill, np.stack(centres))
    nearest = np.sqrt((poses[:, :3, 3] ** 2).sum(-1))
    low, high = distances(thing)
    low = np.clip(nearest, low, high)
    poses[:, :3, 3] *= ((low + np.array(places) * (high - low)) / nearest)[:, None]
    return [View(states=s, camera_T_object=p) for s, p in zip(drawn, poses, strict=True)]


def draw_states(
    thing: ArticulatedObject, rng: np.random.Generator, count: int
) -> Float[np.ndarray, "{count} J"]:
    """Joint states, uniform in TRAVEL of what lies between the category's least and the stop."""
    lower = np.array([joint.lower for joint in thing.category.joints])
    share = rng.uniform(*TRAVEL, size=(count, len(lower)))
    return lower + share * (thing.upper - lower)


def distances(thing: ArticulatedObject) -> tuple[float, float]:
    """Least and largest distance of the camera from the object's origin in `sim-art-sensor`, m."""
    large = float(np.linalg.norm(thing.extents())) > presets.LARGE
    return presets.FAR if large else presets.NEAR


def draw_direction(window: Window, rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
    """Unit vector from the object to the camera, uniform on the window's piece of the sphere."""
    azimuth = math.radians(rng.uniform(*window.azimuth))
    low, high = (math.sin(math.radians(angle)) for angle in window.elevation)
    z = rng.uniform(low, high)
    level = math.sqrt(1 - z * z)
    return np.array([-level * math.cos(azimuth), -level * math.sin(azimuth), z])


def direction_angles(direction: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 2"]:
    """Azimuth and elevation in degrees (`Window`) of vectors from the object to the camera."""
    azimuth = np.arctan2(-direction[..., 1], -direction[..., 0])
    elevation = np.arctan2(direction[..., 2], np.hypot(direction[..., 0], direction[..., 1]))
    return np.degrees(np.stack([azimuth, elevation], -1))


def look_along(gaze: Float[np.ndarray, " 3"], roll: float) -> Float[np.ndarray, "3 3"]:
    """Rotation to a camera frame with z along `gaze`, x level, then rolled about z."""
    gx, gy, gz = gaze.tolist()
    length = math.hypot(gx, gy)
    # Straight down or up: x to the object's right.
    x = (gy / length, -gx / length, 0.0) if length > 1e-6 else (0.0, -1.0, 0.0)
    y = (-gz * x[1], gz * x[0], gx * x[1] - gy * x[0])  # gaze cross x
    c, s = math.cos(roll), math.sin(roll)
    first = [c * a + s * b for a, b in zip(x, y, strict=True)]
    second = [c * b - s * a for a, b in zip(x, y, strict=True)]
    return np.array([first, second, [gx, gy, gz]])


def frame_objects(
    points: Float[np.ndarray, "B V 3"],
    rotation: Float[np.ndarray, "B 3 3"],
    camera: Intrinsics,
    fill: Float[np.ndarray, " B"],
    centre: Float[np.ndarray, "B 2"],
) -> Float[np.ndarray, "B 4 4"]:
    """camera_T_object with the image of `points` in a box of share `fill`, offset by `centre`.

    The camera stands on the line through the object's origin along the third row of `rotation`
    and is turned towards the box. Element-wise arithmetic only: a matrix product's last digits
    depend on the machine and on how many views are framed together.

    Args:
        points: Object frame, m.
        rotation: Camera frame from object frame before the gaze is turned.
        camera: Intrinsics.
        fill: Longer side of the box as a share of the image's side (width or height).
        centre: Offset of the box's centre from the image's, as shares of the image's sides.
    """
    size = np.array([camera.width, camera.height])
    focal = np.array([camera.fx, camera.fy])
    middle = (0.5 + centre) * size - (camera.cx, camera.cy)
    aim = _with_one(middle / focal)  # the ray on which the box's centre shall lie
    radius = np.sqrt((points**2).sum(-1).max(-1))
    base = _product(rotation, points)
    distance, turn = 2.5 * radius, np.tile(np.eye(3), (len(points), 1, 1))
    for _ in range(STEPS):
        ahead = np.stack([base[..., 0], base[..., 1], base[..., 2] + distance[:, None]], -1)
        seen = _product(turn, ahead)
        behind = seen[..., 2].min(-1) < 0.02 * radius
        seen[behind, :, 2] = 1.0  # their step is to go back; what follows is not used
        low, high, depth = _image_box(seen)
        share = (high - low) * focal / size
        longer = share.argmax(-1)[:, None]
        excess = np.take_along_axis(share, longer, -1)[:, 0] / fill - 1
        step = np.take_along_axis(depth, longer, -1)[:, 0] * excess
        distance = np.where(behind, 1.5 * distance, distance + step)
        wanted = _turn(_with_one((low + high) / 2), aim)
        turn = np.where(behind[:, None, None], turn, _compose(wanted, turn))
    pose = np.tile(np.eye(4), (len(points), 1, 1))
    pose[:, :3, :3] = _compose(turn, rotation)
    pose[:, :3, 3] = turn[..., 2] * distance[:, None]
    return pose


def _image_box(
    seen: Float[np.ndarray, "B V 3"],
) -> tuple[Float[np.ndarray, "B 2"], Float[np.ndarray, "B 2"], Float[np.ndarray, "B 2"]]:
    """Least and greatest x/z and y/z, and the mean depth of the two points that span each."""
    flat = seen[..., :2] / seen[..., 2:]
    first, last = flat.argmin(1), flat.argmax(1)
    low = np.take_along_axis(flat, first[:, None], 1)[:, 0]
    high = np.take_along_axis(flat, last[:, None], 1)[:, 0]
    z = seen[..., 2]
    depth = np.take_along_axis(z, first, 1) + np.take_along_axis(z, last, 1)
    return low, high, depth / 2


def _product(
    matrix: Float[np.ndarray, "B 3 3"], points: Float[np.ndarray, "B V 3"]
) -> Float[np.ndarray, "B V 3"]:
    """Multiply each point by its matrix, element by element."""
    columns = [points[..., k, None] * matrix[:, None, :, k] for k in range(3)]
    return columns[0] + columns[1] + columns[2]


def _compose(
    a: Float[np.ndarray, "B 3 3"], b: Float[np.ndarray, "B 3 3"]
) -> Float[np.ndarray, "B 3 3"]:
    terms = [a[:, :, k, None] * b[:, None, k, :] for k in range(3)]
    return terms[0] + terms[1] + terms[2]


def _with_one(flat: Float[np.ndarray, "B 2"]) -> Float[np.ndarray, "B 3"]:
    return np.concatenate([flat, np.ones((len(flat), 1))], -1)


def _turn(
    source: Float[np.ndarray, "B 3"], target: Float[np.ndarray, "B 3"]
) -> Float[np.ndarray, "B 3 3"]:
    """The smallest rotation between two directions less than half a turn apart (Rodrigues)."""
    a = source / np.sqrt((source**2).sum(-1, keepdims=True))
    b = target / np.sqrt((target**2).sum(-1, keepdims=True))
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx  # a cross b
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    factor = 1 / (1 + (a * b).sum(-1))
    return np.eye(3) + skew + _compose(skew, skew) * factor[:, None, None]


def _published(thing: ArticulatedObject, rng: np.random.Generator, options: ViewOptions) -> View:
    """A sample number for each state and a view of the published grids."""
    thetas, grid = presets.windows(options.preset, thing.category.name, options.protocol)
    states = np.stack(
        [draw_state(thing, thetas, rng, options.held_out) for _ in range(options.states_per_view)]
    )
    turn = rotation(grid, rng)
    if options.protocol != "full":
        turn = turn @ TURN_AWAY
    pose = np.eye(4)
    pose[:3, :3] = OPENCV_T_OPENGL @ turn @ PUBLISHED_T_OBJECT
    pose[2, 3] = presets.PUBLISHED_DISTANCE * float(np.linalg.norm(thing.extents()))
    return View(states=states, camera_T_object=pose)


def draw_state(
    thing: ArticulatedObject,
    thetas: AngleSequence | AngleGrid | None,
    rng: np.random.Generator,
    held_out: bool,
) -> Float[np.ndarray, " J"]:
    """Joint states of one sample, rad or m.

    Of the published angles those in the object's travel are drawn from; where there is none, the
    nearest end of the travel is taken.
    """
    k = rng.uniform()
    if thetas is None:
        return draw_states(thing, rng, 1)[0]
    if isinstance(thetas, AngleGrid):
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
