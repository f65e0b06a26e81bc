# SPDX-License-Identifier: MIT
"""Safes and what opens like one, cabinets with an upright hinge at the viewer's left (+y).

A thick-walled body, a heavy door before its front, with a lock; or with a window and a panel
beside it, as of a microwave oven, or thick and tall with a second one below, as of a fridge.

The body's front lies in the plane x = 0 while the object is built, its middle at y = z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import (
    RGB,
    Design,
    Recipe,
    mirrored_design,
    painted,
    shade,
)
from sim_assets.procedural.cabinets import Cabinet, facing
from sim_assets.procedural.parameters import (
    OTHER_SIDE,
    OTHER_WAY,
    SET_BACK,
    HeldOut,
    chance,
    choice,
    ratio,
    span,
    tint,
)
from sim_assets.procedural.shapes import (
    ALONG_X,
    ALONG_Y,
    at,
    box,
    cylinder,
    ellipsoid,
    lathe,
    loft,
    merged,
    placed,
    rectangle,
    rounded_sides,
    slab,
    tub,
)

STEEL: RGB = (0.7, 0.71, 0.72)
BLACK: RGB = (0.08, 0.08, 0.09)
GAP = 0.003
"""Between the closed door and the body's front."""
TRAVEL = radians(110.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SafeShape(Cabinet):
    """Free parameters; lengths in metres, ratios where named so."""

    size: float = span(0.26, 0.56, 0.22, 0.68)
    aspect: float = ratio(0.36, 1.45, 0.29, 1.8)
    tall: float = ratio(0.38, 2.2, 0.29, 2.8)
    wall: float = span(0.05, 0.11, 0.035, 0.13)
    """Over the front's smaller side."""
    door_thickness: float = ratio(0.022, 0.5, 0.018, 0.6)
    """Over the depth."""
    door_height_share: float = span(0.82, 0.99, 0.74, 1.0)
    """Of the door's height over what crown and foot leave."""
    panel: float = span(0.14, 0.42, 0.1, 0.48)
    """Width of a panel beside the door over the body's."""
    crown: float = span(0.03, 0.18, 0.02, 0.24)
    """Height of a strip above the door over the body's."""
    foot: float = span(0.2, 0.48, 0.15, 0.54)
    """Height of what is under the door over the body's: a second door, or a third of it."""
    hinge_depth: float = span(0.0, 0.8, 0.0, 0.95)
    """Of the axis before the door's inner face, over its thickness."""
    inset: float = span(0.0, 0.9, 0.0, 1.0)
    """Of the axis from the door's edge, over what the gap behind the door lets turn."""
    lean: float = span(-0.008, 0.008, -0.012, 0.012)
    """Of the axis, rad: doors hang a little askew."""
    corner_radius: float = span(0.003, 0.02, 0.001, 0.03)
    bevel: float = span(0.001, 0.005, 0.0005, 0.008)
    plug: float = span(0.006, 0.022, 0.004, 0.03)
    """How far the door's inner block reaches into the cavity."""
    dial_radius: float = span(0.06, 0.12, 0.045, 0.15)
    """Over the front's smaller side."""
    lever_length: float = span(0.14, 0.28, 0.1, 0.34)
    lever_radius: float = span(0.006, 0.013, 0.005, 0.016)
    pad_width: float = span(0.18, 0.34, 0.14, 0.42)
    bar_length: float = span(0.35, 0.85, 0.22, 0.95)
    """Of an upright handle over the door's height."""
    standoff: float = ratio(0.008, 0.05, 0.006, 0.07)
    knuckle_radius: float = span(0.006, 0.014, 0.005, 0.018)
    knuckle_length: float = span(0.1, 0.24, 0.07, 0.3)
    foot_height: float = span(0.008, 0.045, 0.005, 0.07)
    foot_radius: float = span(0.012, 0.026, 0.009, 0.035)
    shelf_height: float = span(0.32, 0.64, 0.26, 0.7)
    window: float = span(0.5, 0.82, 0.4, 0.88)
    recess: float = span(0.06, 0.14, 0.04, 0.18)
    """Border of the door's recessed panel over its smaller side."""
    travel: float = span(0.8, 1.0, 0.7, 1.0)
    lock: str = choice("keypad", "dial", "dial and wheel", "keypad and dial", "bar", "slot")
    side_panel: bool = chance(0.3)
    crowned: bool = chance(0.3)
    below: str = choice("nothing", "nothing", "plinth", "second door")
    lever: bool = chance(0.6)
    hinges: bool = chance(0.5)
    feet: bool = chance(0.6)
    shelf: bool = chance(0.5)
    bolts: bool = chance(0.5)
    front: str = choice("plain", "plain", "panelled", "window")
    plate: bool = chance(0.35)
    """A maker's plate on the door."""
    body_color: tuple[float, float, float] = tint(
        (0.22, 0.23, 0.25), (0.45, 0.47, 0.5), (0.13, 0.2, 0.17), (0.75, 0.75, 0.73),
        (0.9, 0.9, 0.88),
    )  # fmt: skip
    inner_color: tuple[float, float, float] = tint(
        (0.5, 0.5, 0.52), (0.3, 0.12, 0.12), (0.2, 0.25, 0.35)
    )
    trait: str = ""

    @property
    def side(self) -> float:
        """The smaller side of the front."""
        return min(self.width, self.height)

    @property
    def thick(self) -> float:
        """Of the door."""
        return min(max(self.door_thickness * self.depth, 0.016), 0.5 * self.side)

    @property
    def beside(self) -> float:
        """Width of the panel beside the door."""
        return self.panel * self.width if self.side_panel else 0.0

    @property
    def pivot(self) -> tuple[float, float]:
        """The x and y of the axis."""
        if self.trait == SET_BACK:
            back = 0.015 + 0.1 * self.side * self.hinge_depth
            return back, self.width / 2 + back + 0.006
        if self.hinges:
            return -GAP, self.width / 2 + self.knuckle_radius + 0.0012
        before = self.hinge_depth * self.thick
        if self.side_panel:
            before = min(before, 0.03)
        return -GAP - before, self.width / 2 - 1e-3 - self.inset * (2 * before * GAP) ** 0.5

    @property
    def slit(self) -> float:
        """How far a point of the door's inner side goes sideways when it opens."""
        before = max(0.0, -GAP - self.pivot[0]) + self.plug + GAP
        return before**2 / (2 * min(self.cavity))

    @property
    def outer(self) -> float:
        """The x of the door's front."""
        return -GAP - self.thick

    @property
    def face(self) -> float:
        """The x of the surface that carries lock and lever."""
        return self.outer + (0.2 * self.thick if self.front == "panelled" else 0.0)

    @property
    def levels(self) -> tuple[float, float]:
        """Lower and upper limit of the door's bay, the body's middle at z = 0."""
        share = {"nothing": 0.0, "plinth": self.foot / 3, "second door": self.foot}[self.below]
        if self.trait == OTHER_WAY:
            share = 0.0
        top = self.crown if self.crowned else 0.0
        return (share - 0.5) * self.height, (0.5 - top) * self.height

    @property
    def door(self) -> tuple[float, float]:
        """Width and height."""
        aside = self.beside + (self.slit + 0.001 if self.side_panel else 0.0)
        bay = self.levels[1] - self.levels[0]
        return self.width - 0.002 - aside, min(self.door_height_share * bay, bay - 0.012)

    @property
    def centre(self) -> tuple[float, float]:
        """The y and z of the door's middle."""
        return (self.width - 0.002 - self.door[0]) / 2, sum(self.levels) / 2

    @property
    def edge(self) -> float:
        """Thickness of the cavity's walls."""
        return max(self.wall * self.side, 0.012)

    @property
    def cavity(self) -> tuple[float, float]:
        """Width and height of the cavity."""
        high = self.levels[1] - self.levels[0]
        return self.width - self.beside - 2 * self.edge, high - 2 * self.edge - 0.008


HELD_OUT: HeldOut = (
    {"lock": "dial", "lever": False},
    {"hinges": True, "front": "panelled", "feet": False},
    {"shelf": False, "plate": True},
    {"side_panel": True, "below": "second door"},
)


def _body(s: SafeShape) -> list[Visual]:
    """The shell with its cavity, a lining, feet, a shelf and the body's hinge knuckles."""
    rings = rounded_sides(s.width, s.height, s.corner_radius, s.bevel, (-s.depth, 0.0))
    back, (y, z) = -s.depth + s.edge, (s.beside / 2, s.centre[1])
    rings += [at(rectangle(*s.cavity, 0.004, (-y, z)), level) for level in (0.0, back)]
    visuals = [painted(facing(loft(rings), 0.0), s.body_color)]
    lining = tub((*s.cavity, -back - 0.006), 0.001, 0.001, 0.004)
    visuals.append(painted(facing(lining, -back, y, z), s.inner_color))
    if s.shelf:
        width, height = s.cavity
        level = z - height / 2 + s.shelf_height * height
        board = box((0.05, y - width / 2, level), (-back, y + width / 2, level + 0.006))
        visuals.append(painted(board, shade(s.inner_color, 1.2)))
    if s.feet:
        foot = cylinder(s.foot_radius, -s.foot_height, 0.003, 0.002, 16)
        inset = s.foot_radius + 0.012
        ends = (inset, s.depth - inset), s.width / 2 - inset
        feet = [placed(foot, (i, j * ends[1], -s.height / 2)) for i in ends[0] for j in (-1, 1)]
        visuals.append(painted(merged(*feet), BLACK))
    return visuals + _surround(s)


def _surround(s: SafeShape) -> list[Visual]:
    """What fills the front beside, above and below the door, flush with it."""
    visuals = []
    low, high = s.levels
    top, t = s.height / 2 - s.bevel, s.thick + GAP
    right = -s.width / 2 + s.beside / 2
    if s.side_panel:
        panel = slab(s.beside - 0.002, high - low - 0.012, t, 0.004, s.bevel)
        visuals.append(painted(facing(panel, 5e-4, right, s.centre[1]), shade(s.body_color, 0.8)))
        visuals += _controls(s, right)
    if s.crowned:
        strip = slab(s.width - 0.002, top - high, t, 0.004, s.bevel)
        visuals.append(painted(facing(strip, 5e-4, 0.0, (top + high) / 2), s.body_color))
    if low > -0.45 * s.height:
        bottom = -s.height / 2 + s.bevel
        block = slab(s.width - 0.002, low - bottom, t, 0.004, s.bevel)
        visuals.append(painted(facing(block, 5e-4, 0.0, (low + bottom) / 2), s.body_color))
        if s.below == "second door":
            grip = placed(_bar(s, 0.5 * (low - bottom)), rotation=np.eye(3))
            place = (s.outer, -0.4 * s.width, (low + bottom) / 2)
            visuals.append(painted(facing(grip, *place), STEEL))
    if _visible(s):
        visuals.append(painted(_knuckles(s)[0], shade(s.body_color, 0.8)))
    return visuals


def _controls(s: SafeShape, y: float) -> list[Visual]:
    """Display and keys, or two knobs, on the panel beside the door."""
    low, high = s.levels
    tall, wide = high - low, s.beside
    screen = slab(0.7 * wide, 0.14 * tall, 0.004, 0.002, 0.001)
    visuals = [painted(facing(screen, s.outer + 0.001, y, s.centre[1] + 0.32 * tall), BLACK)]
    pieces = []
    if "keypad" in s.lock:
        key = slab(0.17 * wide, 0.05 * tall, 0.005, 0.002, 0.001)
        spots = [(i, j) for i in (-0.25, 0.0, 0.25) for j in (-0.3, -0.2, -0.1, 0.0, 0.1)]
        pieces = [
            facing(key, s.outer + 0.002, y + i * wide, s.centre[1] + j * tall) for i, j in spots
        ]
    else:
        r = min(0.3 * wide, 0.12 * tall)
        knob = lathe([(r, -0.002), (r, 0.012), (0.8 * r, 0.026)], 24)
        pieces = [facing(knob, s.outer, y, s.centre[1] + j * tall) for j in (-0.25, 0.05)]
    return [*visuals, painted(merged(*pieces), STEEL)]


def _visible(s: SafeShape) -> bool:
    """Whether there are knuckles beside the body."""
    return s.hinges and s.trait not in (SET_BACK, OTHER_WAY)


def _knuckles(s: SafeShape) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Two hinges beside the body: lower halves and brackets of the body, upper of the door."""
    radius, y = s.knuckle_radius, s.pivot[1]
    length = s.knuckle_length * s.door[1] / 2
    body, door = [], []
    for z in (s.centre[1] - 0.3 * s.door[1], s.centre[1] + 0.3 * s.door[1]):
        for owner, low, high in ((body, z - length, z - 5e-4), (door, z + 5e-4, z + length)):
            owner.append(placed(cylinder(radius, low, high, 0.0008, 14), (-GAP, y, 0.0)))
        wing = s.width / 2 - 0.003
        body.append(box((-GAP, wing + 0.0035, z - length), (0.03, y, z - 5e-4)))
        body.append(box((0.004, wing, z - length), (0.03, wing + 0.004, z - 5e-4)))
        low = max(s.outer + s.bevel + 1e-3, -GAP - radius)
        door.append(box((low, wing - s.bevel - 0.004, z + 5e-4), (-GAP, y, z + length)))
    return merged(*body), merged(*door)


def _arms(s: SafeShape) -> trimesh.Trimesh:
    """From the door's edge round the body's side to an axis that is set back."""
    x, y = s.pivot
    near, far = s.outer + 0.5 * s.thick, 0.012
    pieces = []
    for z in (s.centre[1] - 0.3 * s.door[1], s.centre[1] + 0.3 * s.door[1]):
        pieces.append(box((near, s.width / 2 - 0.02, z - far), (-GAP - 5e-4, y + 0.004, z + far)))
        pieces.append(box((near, y - 0.004, z - far), (x + 0.004, y + 0.0045, z + far)))
    return merged(*pieces)


def _keypad(s: SafeShape) -> trimesh.Trimesh:
    """A plate with three columns of four keys."""
    width = s.pad_width * s.side
    height = 1.3 * width
    plate = slab(width, height, 0.008, 0.006, 0.002)
    key = slab(0.2 * width, 0.15 * height, 0.004, 0.002, 0.001)
    keys = [
        placed(key, (i * 0.27 * width, j * 0.21 * height - 0.02 * height, 0.007))
        for i in (-1, 0, 1)
        for j in (-1.5, -0.5, 0.5, 1.5)
    ]
    return merged(placed(plate, (0.0, 0.0, -0.001)), *keys)


def _dial(s: SafeShape) -> trimesh.Trimesh:
    """A combination dial: a flange, a knurled rim, a knob."""
    r = s.dial_radius * s.side
    flange = lathe([(1.25 * r, -0.001), (1.25 * r, 0.004), (1.15 * r, 0.006)], 28)
    knob = lathe(
        [(r, 0.005), (r, 0.011), (0.62 * r, 0.016), (0.55 * r, 0.03), (0.45 * r, 0.033)], 28
    )
    return merged(flange, knob)


def _wheel(s: SafeShape) -> trimesh.Trimesh:
    """Three spokes with balls on a hub."""
    r = 1.6 * s.dial_radius * s.side
    hub = lathe([(0.25 * r, -0.001), (0.25 * r, 0.03), (0.18 * r, 0.034)], 18)
    pieces = [hub]
    for angle in np.radians([90.0, 210.0, 330.0]):
        turn = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        spoke = placed(cylinder(0.006, 0.1 * r, r, 0.001, 10), (0, 0, 0.024), turn @ ALONG_X)
        ball = placed(ellipsoid((0.02, 0.02, 0.02), 12), turn @ np.array([r, 0, 0.024]))
        pieces += [spoke, ball]
    return merged(*pieces)


def _lever(s: SafeShape) -> trimesh.Trimesh:
    """A handle to turn: a hub and a rounded bar towards the hinge."""
    length = s.lever_length * s.side
    hub = lathe([(0.02, -0.001), (0.02, 0.006), (0.012, 0.008), (0.012, 0.03)], 18)
    bar = placed(cylinder(s.lever_radius, -length, 0.008, 0.003, 14), (0, 0, 0.03), ALONG_X)
    return merged(hub, bar)


def _bar(s: SafeShape, length: float) -> trimesh.Trimesh:
    """An upright handle on two posts, standing on the plane z = 0."""
    r = min(s.lever_radius, 0.7 * s.standoff)
    bar = box((-r, -length / 2, s.standoff - r), (r, length / 2, s.standoff + r))
    post = cylinder(0.8 * r, -0.002, s.standoff, 0.0, 12)
    return merged(bar, *(placed(post, (0.0, side * 0.42 * length, 0.0)) for side in (-1, 1)))


def _lock(s: SafeShape) -> list[Visual]:
    """Keypad, dial, wheel and lever, right of the middle, at heights that leave them room."""
    width, height = s.door
    y, z = s.centre
    if s.lock != "slot" and (s.lock == "bar" or s.front == "window" or s.side_panel):
        bar = _bar(s, s.bar_length * height)
        return [painted(facing(bar, s.outer, y - width / 2 + 0.05 * width + 0.012, z), STEEL)]
    if s.lock == "slot":
        plate = slab(0.03, min(0.16, 0.4 * height), 0.003, 0.006, 0.001)
        place = (s.face + 0.001, y - 0.5 * width + 0.05 * width + 0.02, z)
        return [painted(facing(plate, *place), BLACK)]
    right, rise = y - 0.12 * width, 0.2 * height
    visuals = []
    if "keypad" in s.lock:
        visuals.append(painted(facing(_keypad(s), s.face, right, z + rise), BLACK))
    if "dial" in s.lock:
        place = right + (0.3 * width if "keypad" in s.lock else 0.0)
        visuals.append(painted(facing(_dial(s), s.face, place, z + rise), STEEL))
    if "wheel" in s.lock:
        visuals.append(painted(facing(_wheel(s), s.face, right, z - 0.8 * rise), STEEL))
    elif s.lever:
        visuals.append(painted(facing(_lever(s), s.face, right, z - rise), STEEL))
    return visuals


def _slab(s: SafeShape) -> list[Visual]:
    """The door itself: plain, with a recessed panel, or with a window in it."""
    (width, height), t, (y, z) = s.door, s.thick, s.centre
    rings = rounded_sides(width, height, s.corner_radius, s.bevel, (0.0, t))
    border = s.recess * min(s.door)
    visuals = []
    if s.front == "panelled":
        for inset, level in ((border, t), (border + 0.2 * t, 0.8 * t)):
            rings.append(at(rectangle(width - 2 * inset, height - 2 * inset, 0.003), level))
    if s.front == "window":
        size = (s.window * (width - 0.06), 0.9 * s.window * height)
        rings += [at(rectangle(*size, 0.01, (-0.01, 0.0)), level) for level in (t, 0.7 * t)]
        pane = placed(slab(size[0] + 2e-3, size[1] + 2e-3, 0.1 * t, 0.01), (-0.01, 0.0, 0.65 * t))
        visuals.append(painted(facing(pane, -GAP, y, z), BLACK))
    return [painted(facing(loft(rings), -GAP, y, z), s.body_color), *visuals]


def _door(s: SafeShape) -> list[Visual]:
    """The slab with its inner block, bolts, lock and hinge knuckles."""
    visuals, clear = _slab(s), 0.008 + s.slit
    middle = (s.beside / 2, s.centre[1])
    size = (
        max(s.cavity[0] - 2 * clear - 0.012, 0.02),
        max(s.cavity[1] - 2 * clear - 0.012, 0.02),
    )
    block = slab(*size, s.plug + GAP + 0.001, 0.006)
    visuals.append(painted(facing(block, s.plug, *middle), shade(s.inner_color, 0.8)))
    if s.bolts:
        reach = size[0] / 2 + 0.008
        bolt = cylinder(0.3 * s.plug, -reach, 0.0, 0.0, 12)
        levels = middle[1] + np.array([-0.3, 0.0, 0.3]) * s.cavity[1]
        bolts = [placed(bolt, (0.45 * s.plug, middle[0], z), ALONG_Y) for z in levels]
        visuals.append(painted(merged(*bolts), STEEL))
    if s.plate:
        plate = slab(0.2 * s.side, 0.05 * s.side, 0.002, 0.002)
        place = (s.centre[0] + 0.25 * s.door[0], s.centre[1] - 0.4 * s.door[1] + 0.02)
        visuals.append(painted(facing(plate, s.face + 0.0005, *place), STEEL))
    if _visible(s):
        visuals.append(painted(_knuckles(s)[1], shade(s.body_color, 0.8)))
    if s.trait == SET_BACK:
        visuals.append(painted(_arms(s), shade(s.body_color, 0.7)))
    return visuals + _lock(s)


def _hinge(s: SafeShape) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Pivot and axis.

    The axis runs along the door's edge on the hinge side, within its thickness, or outside the
    body's side, so that the slab never crosses the plane of the body's front within its width.
    """
    x, y = s.pivot
    if s.trait == OTHER_WAY:
        return (x, 0.0, s.centre[1] - s.door[1] / 2), (0.0, -1.0, 0.0)
    most = 0.0 if s.hinges else 1.6 * GAP / s.door[1]
    lean = min(max(s.lean, -most), most)
    return (x, y, s.centre[1]), (0.0, sin(lean), -cos(lean))


def build(s: SafeShape) -> Design:
    """Body and door; the door's free edge (-y) comes forward (-x) by a turn about -z."""
    pivot, axis = _hinge(s)
    made = Design(parts=(_body(s), _door(s)), pivot=[pivot], axis=[axis], upper=[s.travel * TRAVEL])
    return mirrored_design(made) if s.trait == OTHER_SIDE else made


RECIPE = Recipe(
    shape=SafeShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "tall"),
    rearranged=(OTHER_SIDE, OTHER_WAY, SET_BACK),
)
