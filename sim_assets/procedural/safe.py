# SPDX-License-Identifier: MIT
"""Safes: a thick-walled body, a heavy door before its front, hinged at the viewer's left (+y).

The body's front lies in the plane x = 0 while the object is built, its middle at y = z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.parameters import HeldOut, chance, choice, span, tint
from sim_assets.procedural.shapes import (
    ALONG_X,
    ALONG_Y,
    FRONT,
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
class SafeShape:
    """Free parameters; lengths in metres, ratios where named so."""

    width: float = span(0.32, 0.50, 0.25, 0.62)
    height: float = span(0.24, 0.52, 0.18, 0.70)
    depth: float = span(0.28, 0.44, 0.22, 0.55)
    wall: float = span(0.02, 0.045, 0.012, 0.06)
    door_thickness: float = span(0.022, 0.05, 0.015, 0.065)
    door_ratio: float = span(0.93, 0.99, 0.88, 1.0)
    """Of the door's height over the body's."""
    corner_radius: float = span(0.003, 0.016, 0.001, 0.025)
    bevel: float = span(0.001, 0.005, 0.0005, 0.008)
    plug: float = span(0.008, 0.02, 0.005, 0.028)
    """How far the door's inner block reaches into the cavity."""
    dial_radius: float = span(0.07, 0.12, 0.05, 0.15)
    """Over the body's smaller side."""
    lever_length: float = span(0.16, 0.26, 0.12, 0.32)
    lever_radius: float = span(0.007, 0.012, 0.005, 0.015)
    pad_width: float = span(0.2, 0.32, 0.15, 0.4)
    knuckle_radius: float = span(0.007, 0.013, 0.005, 0.017)
    knuckle_length: float = span(0.12, 0.22, 0.08, 0.28)
    foot_height: float = span(0.008, 0.025, 0.005, 0.04)
    shelf_height: float = span(0.35, 0.6, 0.3, 0.68)
    recess: float = span(0.06, 0.13, 0.04, 0.18)
    """Border of the door's recessed panel over its smaller side."""
    travel: float = span(0.85, 1.0, 0.75, 1.0)
    lock: str = choice("keypad", "dial", "dial and wheel", "keypad and dial")
    lever: bool = chance(0.6)
    hinges: bool = chance(0.65)
    feet: bool = chance(0.6)
    shelf: bool = chance(0.5)
    bolts: bool = chance(0.6)
    panelled: bool = chance(0.4)
    plate: bool = chance(0.35)
    """A maker's plate on the door."""
    body_color: tuple[float, float, float] = tint(
        (0.22, 0.23, 0.25), (0.45, 0.47, 0.5), (0.13, 0.2, 0.17), (0.75, 0.75, 0.73)
    )
    inner_color: tuple[float, float, float] = tint(
        (0.5, 0.5, 0.52), (0.3, 0.12, 0.12), (0.2, 0.25, 0.35)
    )

    @property
    def side(self) -> float:
        """The smaller side of the front."""
        return min(self.width, self.height)

    @property
    def offset(self) -> float:
        """Of the hinge's axis beyond the door's edge: outside the body where it is visible."""
        return self.knuckle_radius + 0.0012 if self.hinges else 0.0

    @property
    def outer(self) -> float:
        """The x of the door's front."""
        return -GAP - self.door_thickness

    @property
    def face(self) -> float:
        """The x of the surface that carries lock and lever."""
        return self.outer + (0.2 * self.door_thickness if self.panelled else 0.0)

    @property
    def door_height(self) -> float:
        """Along z."""
        return self.door_ratio * self.height

    @property
    def cavity(self) -> tuple[float, float]:
        """Width and height of the cavity."""
        return self.width - 2 * self.wall, self.height - 2 * self.wall


HELD_OUT: HeldOut = (
    {"lock": "dial", "lever": False},
    {"hinges": True, "panelled": True, "feet": False},
    {"shelf": False, "plate": True},
)


def _facing(mesh: trimesh.Trimesh, x: float, y: float = 0.0, z: float = 0.0) -> trimesh.Trimesh:
    """A thing built as seen from the front, put with its z = 0 at (x, y, z)."""
    return placed(mesh, (x, y, z), FRONT)


def _body(s: SafeShape) -> list[Visual]:
    """The shell with its cavity, a lining, feet, a shelf and the body's hinge knuckles."""
    rings = rounded_sides(s.width, s.height, s.corner_radius, s.bevel, (-s.depth, 0.0))
    back = -s.depth + s.wall
    rings += [at(rectangle(*s.cavity, 0.004), z) for z in (0.0, back)]
    visuals = [painted(_facing(loft(rings), 0.0), s.body_color)]
    lining = tub((*s.cavity, -back - 0.006), 0.001, 0.001, 0.004)
    visuals.append(painted(_facing(lining, s.depth - s.wall), s.inner_color))
    if s.shelf:
        width, height = s.cavity
        z = -height / 2 + s.shelf_height * height
        board = box((0.05, -width / 2, z), (s.depth - s.wall, width / 2, z + 0.006))
        visuals.append(painted(board, shade(s.inner_color, 1.2)))
    if s.feet:
        foot = cylinder(0.018, -s.foot_height, 0.003, 0.002, 16)
        x, y = (0.04, s.depth - 0.04), s.width / 2 - 0.04
        feet = [placed(foot, (i, j * y, -s.height / 2)) for i in x for j in (-1, 1)]
        visuals.append(painted(merged(*feet), BLACK))
    if s.hinges:
        visuals.append(painted(_knuckles(s)[0], shade(s.body_color, 0.8)))
    return visuals


def _knuckles(s: SafeShape) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Two hinges beside the body: lower halves and brackets of the body, upper of the door."""
    radius, y = s.knuckle_radius, s.width / 2 + s.offset
    length = s.knuckle_length * s.height / 2
    body, door = [], []
    for z in (-0.3 * s.height, 0.3 * s.height):
        for owner, low, high in ((body, z - length, z - 5e-4), (door, z + 5e-4, z + length)):
            owner.append(placed(cylinder(radius, low, high, 0.0008, 14), (-GAP, y, 0.0)))
        wing = s.width / 2 - 0.003
        body.append(box((-GAP, wing + 0.0035, z - length), (0.03, y, z - 5e-4)))
        body.append(box((0.004, wing, z - length), (0.03, wing + 0.004, z - 5e-4)))
        low = max(s.outer + s.bevel + 1e-3, -GAP - radius)
        door.append(box((low, wing - s.bevel - 0.004, z + 5e-4), (-GAP, y, z + length)))
    return merged(*body), merged(*door)


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


def _lock(s: SafeShape) -> list[Visual]:
    """Keypad, dial, wheel and lever, right of the middle, at heights that leave them room."""
    right = -0.12 * s.width
    rise = 0.2 * s.door_height
    visuals = []
    if "keypad" in s.lock:
        visuals.append(painted(_facing(_keypad(s), s.face, right, rise), BLACK))
    if "dial" in s.lock:
        y = right + (0.3 * s.width if "keypad" in s.lock else 0.0)
        visuals.append(painted(_facing(_dial(s), s.face, y, rise), STEEL))
    if "wheel" in s.lock:
        visuals.append(painted(_facing(_wheel(s), s.face, right, -0.8 * rise), STEEL))
    elif s.lever:
        visuals.append(painted(_facing(_lever(s), s.face, right, -rise), STEEL))
    return visuals


def _door(s: SafeShape) -> list[Visual]:
    """The slab with its inner block, bolts, lock and hinge knuckles."""
    width, height, t = s.width - 0.002, s.door_height, s.door_thickness
    rings = rounded_sides(width, height, s.corner_radius, s.bevel, (0.0, t))
    if s.panelled:
        border = s.recess * s.side
        for inset, z in ((border, t), (border + 0.2 * t, 0.8 * t)):
            rings.append(at(rectangle(width - 2 * inset, height - 2 * inset, 0.003), z))
    visuals = [painted(_facing(loft(rings), -GAP), s.body_color)]
    clear = 0.014
    block = slab(s.cavity[0] - 2 * clear, s.cavity[1] - 2 * clear, s.plug + GAP + 0.001, 0.006)
    visuals.append(painted(_facing(block, s.plug), shade(s.inner_color, 0.8)))
    if s.bolts:
        reach = s.cavity[0] / 2 - 0.006
        bolt = cylinder(0.3 * s.plug, -reach, 0.0, 0.0, 12)
        levels = np.array([-0.3, 0.0, 0.3]) * s.cavity[1]
        bolts = [placed(bolt, (0.45 * s.plug, 0.0, z), ALONG_Y) for z in levels]
        visuals.append(painted(merged(*bolts), STEEL))
    if s.plate:
        plate = slab(0.2 * s.side, 0.05 * s.side, 0.002, 0.002)
        visuals.append(
            painted(_facing(plate, s.face + 0.0005, 0.25 * s.width, -0.4 * height + 0.02), STEEL)
        )
    if s.hinges:
        visuals.append(painted(_knuckles(s)[1], shade(s.body_color, 0.8)))
    return visuals + _lock(s)


def build(s: SafeShape) -> Design:
    """Body and door; the door's free edge (-y) comes forward (-x) by a turn about -z.

    The axis runs along the door's inner edge on the hinge side, at or outside the body's side, so
    that the slab never crosses the plane of the body's front within the body's width.
    """
    return Design(
        parts=(_body(s), _door(s)),
        pivot=[(-GAP, s.width / 2 + s.offset, 0.0)],
        axis=[(0.0, 0.0, -1.0)],
        upper=[s.travel * TRAVEL],
    )


RECIPE = Recipe(shape=SafeShape, build=build, held_out=HELD_OUT)
