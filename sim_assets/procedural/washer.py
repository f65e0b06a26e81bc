# SPDX-License-Identifier: MIT
"""Front-loading washers: a cabinet with a drum, a round door hinged at the viewer's left (+y).

The cabinet's front lies in the plane x = 0 while the object is built, its floor at z = 0. The
hinge's axis lies in the plane of the door ring's front, beyond the ring, so that the door swings
through 135 degrees without crossing the plane of its gap.
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
    span,
    tint,
)
from sim_assets.procedural.shapes import (
    at,
    box,
    cylinder,
    lathe,
    loft,
    merged,
    placed,
    rectangle,
    slab,
    superellipse,
)

STEEL: RGB = (0.72, 0.73, 0.75)
BLACK: RGB = (0.08, 0.08, 0.09)
GAP = 0.003
"""Between the closed door and the cabinet's front."""
TRAVEL = radians(135.0)
ROUND = 8
"""Segments per quarter of the door's circles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WasherShape(Cabinet):
    """Free parameters; lengths in metres, ratios where named so."""

    size: float = span(0.5, 0.74, 0.44, 0.82)
    aspect: float = span(0.58, 1.22, 0.48, 1.45)
    tall: float = span(0.85, 1.7, 0.7, 2.0)
    corner_radius: float = span(0.006, 0.03, 0.003, 0.05)
    bevel: float = span(0.002, 0.009, 0.001, 0.014)
    door_radius: float = span(0.24, 0.41, 0.2, 0.45)
    """Over the front's smaller side."""
    door_power: float = span(2.0, 4.0, 2.0, 6.0)
    """Of the door's outline: 2 is a circle, 4 nearly a square."""
    door_shift: float = span(-1.0, 1.0, -1.0, 1.0)
    """Of the door from the middle to the viewer's left, over the room there."""
    hole: float = span(0.66, 0.84, 0.6, 0.87)
    """Radius of the opening over the door's."""
    ring_thickness: float = span(0.022, 0.065, 0.017, 0.085)
    ring_round: float = span(0.15, 0.48, 0.08, 0.49)
    """Rounding of the ring's edges over its thickness."""
    hinge_gap: float = span(0.01, 0.024, 0.009, 0.03)
    """Of the axis beyond the door's edge."""
    lean: float = span(-0.012, 0.012, -0.02, 0.02)
    """Of the axis, rad: doors hang a little askew."""
    bowl_depth: float = span(0.04, 0.11, 0.03, 0.14)
    """How far the glass reaches into the opening."""
    bowl_taper: float = span(0.5, 0.75, 0.42, 0.8)
    door_rise: float = span(0.3, 0.7, 0.2, 0.8)
    """Height of the door's middle between its limits over and under it."""
    drum_depth: float = span(0.5, 0.78, 0.42, 0.84)
    panel: float = span(0.09, 0.2, 0.07, 0.25)
    """Height of the control strip over the cabinet's."""
    dial_radius: float = span(0.2, 0.38, 0.16, 0.42)
    """Over the control strip's height, at most 6 cm."""
    tray_width: float = span(0.2, 0.36, 0.17, 0.38)
    foot_height: float = span(0.01, 0.06, 0.006, 0.1)
    plinth: float = span(0.1, 0.35, 0.07, 0.45)
    """Height of a pedestal with a drawer under the cabinet, over the cabinet's."""
    top_height: float = span(0.012, 0.04, 0.008, 0.055)
    console: float = span(0.06, 0.16, 0.04, 0.2)
    """Height of a board behind the top, over the cabinet's."""
    flap: float = span(0.05, 0.12, 0.04, 0.14)
    """Height of the panel at the foot over the cabinet's."""
    travel: float = span(0.75, 1.0, 0.65, 1.0)
    tray: bool = chance(0.75)
    display: bool = chance(0.6)
    buttons: bool = chance(0.6)
    feet: bool = chance(0.7)
    plinth_flap: bool = chance(0.5)
    pedestal: bool = chance(0.25)
    backboard: bool = chance(0.25)
    pocket: bool = chance(0.4)
    """A dished field about the door."""
    trim: bool = chance(0.5)
    """A ring about the opening, on the glass."""
    lifters: bool = chance(0.7)
    worktop: bool = chance(0.5)
    handle: str = choice("bar", "scoop", "bump")
    dial_side: int = choice(-1, 0, 1)
    body_color: tuple[float, float, float] = tint(
        (0.93, 0.93, 0.93), (0.6, 0.61, 0.63), (0.2, 0.2, 0.22), (0.85, 0.86, 0.88)
    )
    ring_color: tuple[float, float, float] = tint(
        (0.88, 0.88, 0.9), (0.3, 0.31, 0.33), STEEL, (0.12, 0.12, 0.13)
    )
    glass_color: tuple[float, float, float] = tint((0.3, 0.36, 0.4), (0.18, 0.2, 0.22))
    trait: str = ""

    @property
    def strip(self) -> float:
        """Height of the control strip."""
        return self.panel * self.height

    @property
    def radius(self) -> float:
        """Of the door."""
        room = self.height - self.strip - (self.flap * self.height if self.plinth_flap else 0.0)
        return min(self.door_radius * min(self.width, room), self.width / 2 - 0.045)

    @property
    def aside(self) -> float:
        """The y of the door's middle, so that its hinge stays on the front."""
        return self.door_shift * max(0.0, self.width / 2 - self.radius - 0.05)

    @property
    def hole_radius(self) -> float:
        """Of the opening in the cabinet."""
        return self.hole * self.radius

    @property
    def bowl(self) -> float:
        """How far the glass reaches in: its far edge must pass the opening's when it turns."""
        far = self.pivot_y + self.hole_radius - 0.014
        edge = self.pivot_y + self.bowl_taper * 0.86 * self.hole_radius
        room = max(far**2 - edge**2, 0.0) ** 0.5 - self.ring_thickness - GAP
        return max(min(self.bowl_depth, room), 0.018)

    @property
    def middle(self) -> float:
        """The z of the door's middle, kept below the control strip."""
        highest = self.height - self.strip - self.radius - 0.02
        lowest = self.radius + (self.flap * self.height if self.plinth_flap else 0.0) + 0.02
        if self.trait == OTHER_WAY:
            highest = max(lowest, highest - 0.04)
        return lowest + self.door_rise * max(0.0, highest - lowest)

    @property
    def outer(self) -> float:
        """The x of the door ring's front."""
        return -GAP - self.ring_thickness

    @property
    def pivot_y(self) -> float:
        """Of the hinge's axis from the door's middle."""
        far = 0.05 + 2 * self.hinge_gap if self.trait == SET_BACK else 0.0
        return self.radius + self.hinge_gap + far


HELD_OUT: HeldOut = (
    {"tray": False, "display": True},
    {"handle": "bump", "trim": False},
    {"worktop": True, "feet": False, "buttons": True},
    {"pedestal": True, "backboard": True},
)
UPWARDS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From a hinge at the door's left to one at its top."""


def _circle(radius: float) -> np.ndarray:
    """A circle whose points correspond to a rounded rectangle's."""
    return rectangle(2 * radius, 2 * radius, radius, segments=ROUND)


def _cabinet(s: WasherShape) -> trimesh.Trimesh:
    """Outside from back to front, then through the round opening to the back of the drum."""
    heights = np.array([-s.depth, -s.depth + s.bevel, -s.bevel, 0.0])
    insets = np.array([s.bevel, 0.0, 0.0, s.bevel])
    rings = [
        at(
            rectangle(s.width - 2 * inset, s.height - 2 * inset, s.corner_radius, segments=ROUND),
            z,
        )
        for inset, z in zip(insets, heights, strict=True)
    ]
    centre = np.array([-s.aside, s.middle - s.height / 2])
    hole = _circle(s.hole_radius) + centre
    if s.pocket:
        field = _circle(1.03 * s.radius) + centre
        rings += [at(field, 0.0), at(centre + 0.985 * (field - centre), -0.006)]
        rings.append(at(hole, -0.006))
    else:
        rings.append(at(hole, 0.0))
    rings.append(at(hole, -s.drum_depth * s.depth))
    return facing(loft(rings), 0.0, 0.0, s.height / 2)


def _drum(s: WasherShape) -> list[Visual]:
    """A steel cup in the cabinet, three ridges in it, a rubber lip at its mouth."""
    r, depth = s.hole_radius, s.drum_depth * s.depth
    profile = [(r, 0.0), (r, depth - 0.05), (r - 0.002, depth - 0.05), (r - 0.002, 0.002)]
    drum = lathe(profile, 36)
    visuals = [painted(facing(drum, depth - 0.001, s.aside, s.middle), STEEL)]
    lip = [(r - 0.009, -0.022), (r, -0.022), (r, -0.001), (r - 0.004, -0.001)]
    ring = loft([at(superellipse(2 * k, 2 * k, 2.0, 36), z) for k, z in lip], ring=True)
    inner = 0.006 if s.pocket else 0.0
    visuals.append(painted(facing(ring, inner, s.aside, s.middle), (0.3, 0.3, 0.32)))
    if s.lifters:
        ridge = box((-0.012, r - 0.035, 0.004), (0.012, r - 0.001, 0.35 * depth))
        angles = np.radians([30.0, 150.0, 270.0])
        ridges = []
        for a in angles:
            turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
            ridges.append(facing(placed(ridge, rotation=turn), depth, s.aside, s.middle))
        visuals.append(painted(merged(*ridges), shade(STEEL, 0.9)))
    return visuals


def _controls(s: WasherShape) -> list[Visual]:
    """The strip above the door: dial, detergent tray, display, buttons."""
    strip = s.strip
    z = s.height - strip / 2 - s.bevel
    plate = slab(s.width - 2 * s.bevel - 0.004, strip - 0.006, 0.006, 0.006, 0.002)
    visuals = [painted(facing(plate, 0.001, 0.0, z), shade(s.body_color, 0.9))]
    x = -0.0045
    r = min(s.dial_radius * strip, 0.06)
    dial = lathe([(1.2 * r, 0.0), (1.2 * r, 0.003), (r, 0.004), (0.92 * r, 0.024),
                  (0.82 * r, 0.027)], 24)  # fmt: skip
    y = -s.dial_side * 0.12 * s.width
    visuals.append(painted(facing(dial, x, y, z), STEEL))
    if s.tray:
        width = s.tray_width * s.width
        tray = slab(width, 0.72 * strip, 0.006, 0.006, 0.002)
        grip = slab(0.5 * width, 0.012, 0.012, 0.004, 0.002)
        place = (0.5 - 0.03) * s.width - width / 2
        both = merged(tray, placed(grip, (0.0, -0.2 * strip, 0.003)))
        visuals.append(painted(facing(both, x, place, z), s.body_color))
    if s.display:
        screen = slab(0.16 * s.width, 0.4 * strip, 0.003, 0.003, 0.001)
        visuals.append(painted(facing(screen, x, -0.36 * s.width, z + 0.12 * strip), BLACK))
    if s.buttons:
        button = cylinder(0.09 * strip, 0.0, 0.006, 0.0015, 12)
        row = np.linspace(-0.43, -0.29, 4) * s.width
        pieces = [facing(button, x, y, z - 0.3 * strip) for y in row]
        visuals.append(painted(merged(*pieces), shade(s.body_color, 0.6)))
    return visuals


def _body(s: WasherShape) -> list[Visual]:
    visuals = [painted(_cabinet(s), s.body_color), *_drum(s), *_controls(s)]
    if s.plinth_flap:
        flap = slab(0.94 * s.width, s.flap * s.height, 0.004, 0.006, 0.001)
        middle = s.bevel + 0.006 + s.flap * s.height / 2
        visuals.append(painted(facing(flap, 0.0015, 0.0, middle), shade(s.body_color, 0.85)))
    if s.worktop:
        top = slab(s.depth + 0.004, s.width + 0.004, s.top_height, 0.01, 0.005)
        place = (s.depth / 2, 0.0, s.height - 0.002)
        visuals.append(painted(placed(top, place), shade(s.body_color, 0.8)))
    if s.backboard:
        board = slab(0.06, s.width - 0.01, s.console * s.height, 0.012, 0.004)
        place = (s.depth - 0.034, 0.0, s.height - 0.004)
        visuals.append(painted(placed(board, place), shade(s.body_color, 0.9)))
    return [*visuals, *_stand(s), *_roots(s)]


def _stand(s: WasherShape) -> list[Visual]:
    """A pedestal with a drawer, and feet."""
    visuals, low = [], 0.0
    if s.pedestal:
        low = -s.plinth * s.height
        block = box(
            (0.004, -s.width / 2 + 0.004, low), (s.depth - 0.004, s.width / 2 - 0.004, 0.004)
        )
        front = slab(s.width - 0.05, -0.8 * low, 0.012, 0.006, 0.003)
        grip = slab(0.4 * s.width, 0.016, 0.018, 0.005, 0.003)
        visuals.append(painted(block, shade(s.body_color, 0.85)))
        visuals.append(painted(facing(front, 0.006, 0.0, low / 2), s.body_color))
        visuals.append(painted(facing(grip, -0.005, 0.0, 0.25 * low), shade(s.body_color, 0.5)))
    if s.feet:
        foot = cylinder(0.025, low - s.foot_height, low + 0.004, 0.003, 16)
        x, y = (0.06, s.depth - 0.06), s.width / 2 - 0.06
        feet = merged(*(placed(foot, (i, j * y, 0.0)) for i in x for j in (-1, 1)))
        visuals.append(painted(feet, BLACK))
    return visuals


def _roots(s: WasherShape) -> list[Visual]:
    """The cabinet's two knuckles with their arms."""
    pieces = []
    for low, high in ((-0.045, -0.022), (0.022, 0.045)):
        knuckle = cylinder(0.007, s.middle + low, s.middle + high, 0.001, 12)
        pieces.append(placed(knuckle, (s.outer, s.pivot_y, 0.0)))
        ends = (s.middle + low + 0.001, s.middle + high - 0.001)
        arm = ((s.outer, s.pivot_y - 0.005, ends[0]), (0.002, s.pivot_y + 0.005, ends[1]))
        pieces.append(box(*arm))
    return _hung(s, [painted(merged(*pieces), shade(s.ring_color, 0.8))])


def _hung(s: WasherShape, visuals: list[Visual]) -> list[Visual]:
    """What is built about (y, z) = (0, middle), put in the door's place, its hinge where it is."""
    turn = UPWARDS if s.trait == OTHER_WAY else np.eye(3)
    shift = np.array([0.0, 0.0, s.middle])
    return [
        Visual(
            mesh=placed(placed(v.mesh, -shift), shift + np.array([0.0, s.aside, 0.0]), turn),
            color=v.color,
        )
        for v in visuals
    ]


def _ring(s: WasherShape) -> trimesh.Trimesh:
    """The door's ring, edges rounded, hollow for the glass."""
    t, edge = s.ring_thickness, s.ring_round * s.ring_thickness
    inner = 0.86 * s.hole_radius
    angle = np.linspace(0.0, np.pi / 2, 5)
    profile = [(s.radius - edge * (1 - np.cos(a)), t - edge * (1 - np.sin(a))) for a in angle]
    profile += [(inner + 0.008, t), (inner, t - 0.01), (inner, 0.0), (s.radius, 0.0)]
    powers = [s.door_power] * len(angle) + [2.0, 2.0, 2.0, s.door_power]
    loops = [
        at(superellipse(2 * r, 2 * r, power, 40), z)
        for (r, z), power in zip(profile, powers, strict=True)
    ]
    return facing(loft(loops, ring=True), -GAP, 0.0, s.middle)


def _bowl(s: WasherShape) -> trimesh.Trimesh:
    """The glass: a bowl open to the front, its bottom inside the opening."""
    inner, small = 0.86 * s.hole_radius + 0.002, s.bowl_taper * 0.86 * s.hole_radius
    deep = -s.bowl
    mouth = 0.5 * s.ring_thickness
    outside = [(0.6 * small, deep), (small, deep + 0.004), (inner - 0.006, -0.012), (inner, 0.001)]
    inside = [(r - 0.005, z + 0.005) for r, z in outside[::-1]]
    return facing(
        lathe([*outside, (inner, mouth), (inner - 0.005, mouth), *inside], 36),
        -GAP, 0.0, s.middle,
    )  # fmt: skip


def _handle(s: WasherShape) -> trimesh.Trimesh:
    """At the right of the ring: a bar on two posts, a scooped plate or a bump."""
    r, x = (s.radius + s.hole_radius * 0.86) / 2, s.outer
    wide = s.radius - 0.86 * s.hole_radius
    if s.handle == "bar":
        bar = cylinder(0.009, s.middle - 0.07, s.middle + 0.07, 0.003, 14)
        post = cylinder(0.006, -0.004, 0.028, 0.0, 10)
        posts = [facing(post, x, -r, s.middle + side * 0.055) for side in (-1, 1)]
        return merged(placed(bar, (x - 0.028, -r, 0.0)), *posts)
    if s.handle == "scoop":
        plate = slab(0.5 * wide, 0.13, 0.012, 0.2 * wide, 0.004)
        lip = slab(0.12 * wide, 0.12, 0.02, 0.05 * wide, 0.002)
        return merged(*(facing(k, x + 0.004, -r + d, s.middle)
                        for k, d in ((plate, 0.0), (lip, 0.14 * wide))))  # fmt: skip
    profile = [(0.3 * wide, -0.004), (0.3 * wide, 0.01), (0.2 * wide, 0.018)]
    bump = lathe(profile, 20)
    stretched = trimesh.Trimesh(bump.vertices * [1.0, 2.2, 1.0], bump.faces, process=False)
    return facing(stretched, x, -r, s.middle)


def _door(s: WasherShape) -> list[Visual]:
    knuckle = cylinder(0.007, s.middle - 0.0205, s.middle + 0.0205, 0.001, 12)
    low = (s.outer, s.radius - 0.02, s.middle - 0.02)
    neck = box(low, (s.outer + 0.45 * s.ring_thickness, s.pivot_y, s.middle + 0.02))
    hinge = merged(placed(knuckle, (s.outer, s.pivot_y, 0.0)), neck)
    visuals = [
        painted(_ring(s), s.ring_color),
        painted(_bowl(s), s.glass_color),
        painted(hinge, shade(s.ring_color, 0.8)),
        painted(_handle(s), shade(s.ring_color, 0.6)),
    ]
    if s.trim:
        r, t = 0.86 * s.hole_radius, s.ring_thickness
        profile = [(r + 0.006, t - 0.008), (r + 0.014, t - 0.002), (r + 0.012, t + 0.004),
                   (r + 0.004, t + 0.002)]  # fmt: skip
        loops = [at(superellipse(2 * k, 2 * k, 2.0, 40), z) for k, z in profile]
        trim = loft([*loops[1:], loops[0]], ring=True)
        visuals.append(painted(facing(trim, -GAP, 0.0, s.middle), STEEL))
    return _hung(s, visuals)


def build(s: WasherShape) -> Design:
    """Cabinet and door; the door's free edge (-y) comes forward (-x) by a turn about -z."""
    most = 0.7 * GAP / s.radius
    lean = min(max(s.lean, -most), most)
    pivot, axis = np.array([s.outer, s.pivot_y, 0.0]), np.array([0.0, sin(lean), -cos(lean)])
    if s.trait == OTHER_WAY:
        pivot, axis = UPWARDS @ pivot, UPWARDS @ axis
    design = Design(
        parts=(_body(s), _door(s)),
        pivot=[pivot + np.array([0.0, s.aside, s.middle])],
        axis=[axis],
        upper=[s.travel * TRAVEL],
    )
    return mirrored_design(design) if s.trait == OTHER_SIDE else design


RECIPE = Recipe(
    shape=WasherShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "tall", "door_radius"),
    rearranged=(OTHER_SIDE, OTHER_WAY, SET_BACK),
)
