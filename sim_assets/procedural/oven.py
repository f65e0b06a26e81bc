# SPDX-License-Identifier: MIT
"""Ovens and ranges: a body with a cavity, a door hinged along its lower edge on the -x face.

The body's front lies in the plane x = 0 while the object is built, the door before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.cabinets import QUARTER, Cabinet, facing
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
    ALONG_X,
    ALONG_Y,
    at,
    box,
    cylinder,
    loft,
    merged,
    mirrored,
    placed,
    rectangle,
    rounded_sides,
    slab,
    superellipse,
    sweep,
)

STEEL: RGB = (0.72, 0.73, 0.74)
BLACK: RGB = (0.08, 0.08, 0.09)
GAP = 0.003
"""Between the closed door and the body's front."""
TRAVEL = radians(90.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class OvenShape(Cabinet):
    """Free parameters; lengths in metres, ratios where named so."""

    size: float = span(0.48, 0.74, 0.42, 0.85)
    aspect: float = span(0.45, 1.3, 0.36, 1.55)
    tall: float = span(0.55, 1.7, 0.42, 2.05)
    door_low: float = span(0.02, 0.38, 0.01, 0.46)
    """Height of the door's lower edge over the body's height."""
    panel: float = span(0.06, 0.22, 0.05, 0.26)
    """Height of the strip above the door over the body's height."""
    door_thickness: float = span(0.024, 0.06, 0.018, 0.08)
    door_margin: float = span(0.004, 0.055, 0.002, 0.08)
    """From the body's sides to the door's."""
    hinge_depth: float = span(0.0, 0.8, 0.0, 0.95)
    """Of the axis before the door's inner face, over its thickness."""
    lean: float = span(-0.006, 0.006, -0.01, 0.01)
    """Of the axis, rad: doors hang a little askew."""
    corner_radius: float = span(0.004, 0.025, 0.002, 0.04)
    wall: float = span(0.035, 0.06, 0.028, 0.08)
    """Of the cavity at the sides."""
    cavity_depth: float = span(0.72, 0.88, 0.62, 0.92)
    cheek: float = span(0.5, 1.5, 0.3, 2.0)
    """How far the body reaches forward beside a recessed door, over its thickness."""
    window_width: float = span(0.5, 0.84, 0.4, 0.88)
    window_height: float = span(0.3, 0.62, 0.22, 0.68)
    handle_length: float = span(0.5, 0.9, 0.35, 0.95)
    handle_radius: float = span(0.006, 0.014, 0.005, 0.018)
    handle_rise: float = span(0.84, 0.95, 0.76, 0.96)
    standoff: float = span(0.022, 0.055, 0.018, 0.075)
    knob_radius: float = span(0.26, 0.42, 0.22, 0.44)
    """Over half the height of the strip."""
    foot_height: float = span(0.015, 0.11, 0.01, 0.17)
    foot_width: float = span(0.03, 0.06, 0.02, 0.08)
    splash: float = span(0.05, 0.24, 0.03, 0.32)
    """Height of the board behind the top."""
    splash_depth: float = span(0.02, 0.09, 0.015, 0.12)
    burner: float = span(0.12, 0.17, 0.1, 0.19)
    """Radius over the top's smaller side."""
    travel: float = span(0.85, 1.0, 0.75, 1.0)
    window: bool = chance(0.8)
    knobs: bool = chance(0.75)
    display: bool = chance(0.55)
    feet: bool = chance(0.55)
    square_feet: bool = chance(0.4)
    backsplash: bool = chance(0.45)
    rear_controls: bool = chance(0.4)
    """Knobs and display on the board behind the top, where there is one."""
    rack: bool = chance(0.7)
    recessed: bool = chance(0.4)
    """The door lies between the body's cheeks."""
    twin: bool = chance(0.5)
    """A wide oven has a second door that stays shut."""
    below: str = choice("nothing", "drawer", "drawer", "two drawers", "panel")
    hob: str = choice("nothing", "glass", "gas", "coils")
    handle: str = choice("bar", "bar", "bowed", "ledge")
    knob_count: int = choice(3, 4, 5, 6)
    body_color: tuple[float, float, float] = tint(
        STEEL, (0.92, 0.92, 0.9), (0.13, 0.13, 0.14), (0.35, 0.36, 0.38), (0.5, 0.12, 0.1)
    )
    door_color: tuple[float, float, float] = tint(
        STEEL, (0.92, 0.92, 0.9), (0.16, 0.16, 0.17), (0.45, 0.46, 0.48)
    )
    inner_color: tuple[float, float, float] = tint((0.25, 0.26, 0.3), (0.18, 0.16, 0.15))
    trait: str = ""

    @property
    def low(self) -> float:
        """The z of the door's lower edge; the body's lower face is at z = 0."""
        return self.door_low * self.height

    @property
    def strip(self) -> float:
        """Height of the strip with the knobs."""
        return self.panel * self.height

    @property
    def door_height(self) -> float:
        """From its lower edge to 7 mm under the strip."""
        return self.height - self.strip - self.low - 0.007

    @property
    def doubled(self) -> bool:
        """Whether there are two doors side by side."""
        return self.twin and self.tall < 1.0

    @property
    def bay(self) -> tuple[float, float]:
        """Width of the door's bay and the y of its middle."""
        if self.doubled:
            return self.width / 2, self.width / 4
        return self.width, 0.0

    @property
    def door_width(self) -> float:
        """Along y."""
        return self.bay[0] - 2 * self.door_margin

    @property
    def outer(self) -> float:
        """The x of the door's front."""
        return -GAP - self.door_thickness

    @property
    def upright(self) -> bool:
        """Whether the door turns about an upright axis."""
        return self.trait == OTHER_SIDE

    @property
    def sweep(self) -> float:
        """Room that the door's front needs below its lower edge."""
        return (1 - self.hinge_depth) * self.door_thickness + 0.012


HELD_OUT: HeldOut = (
    {"window": False, "display": True},
    {"backsplash": True, "feet": True, "hob": "glass"},
    {"below": "two drawers", "handle": "bowed"},
    {"recessed": True, "hob": "gas"},
)


def _cavity(s: OvenShape) -> tuple[float, float]:
    """Width and height of the opening behind the door."""
    return s.bay[0] - 2 * s.wall, s.door_height - 2 * min(s.wall, 0.15 * s.door_height)


def _shell(s: OvenShape) -> trimesh.Trimesh:
    """The body with its cavity: outside from back to front, then in to the cavity's back."""
    rings = rounded_sides(s.width, s.height, s.corner_radius, 0.003, (-s.depth, 0.0))
    centre = (-s.bay[1], s.low + s.door_height / 2 - s.height / 2)
    back = -s.cavity_depth * s.depth
    rings += [at(rectangle(*_cavity(s), 0.02, centre), z) for z in (0.0, back)]
    return facing(loft(rings), 0.0, z=s.height / 2)


def _burners(s: OvenShape) -> list[trimesh.Trimesh]:
    """Four on the top: flat rings, wound coils, or caps under a grate."""
    side = min(s.depth, s.width)
    r = s.burner * side
    heights = {"glass": (0.0004, 0.0012), "coils": (0.010, 0.012), "gas": (0.030, 0.010)}
    lift, thick = heights[s.hob]
    pieces = []
    turn = 2 * np.pi * np.arange(20) / 20
    radii = (0.45, 0.72, 1.0) if s.hob == "coils" else (1.0,)
    rings = [
        sweep(
            np.column_stack([k * r * np.cos(turn), k * r * np.sin(turn), np.full(20, lift)]),
            rectangle(0.011, thick, 0.0004, segments=1), (0, 0, 1), closed=True,
        )
        for k in radii
    ]  # fmt: skip
    if s.hob == "gas":
        bar = box((-1.25 * r, -0.005, lift - 0.005), (1.25 * r, 0.005, lift + 0.004))
        across = placed(bar, rotation=np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
        legs = [
            box((i * 1.2 * r - 0.004, -0.004, -0.002), (i * 1.2 * r + 0.004, 0.004, lift))
            for i in (-1, 1)
        ]
        rings += [bar, across, *legs, cylinder(0.4 * r, -0.002, 0.016, 0.003, 16)]
    for i in (0.27, 0.71):
        for j in (-0.25, 0.25):
            place = (i * (s.depth - 0.04), j * s.width, s.height + 0.005)
            pieces += [placed(mesh, place) for mesh in rings]
    return pieces


def _top(s: OvenShape) -> list[Visual]:
    """What stands on the body: a hob, a board at the back."""
    visuals = []
    if s.hob != "nothing":
        plate = slab(0.94 * s.depth, 0.96 * s.width, 0.006, 0.012, 0.002)
        color = BLACK if s.hob == "glass" else shade(s.body_color, 0.8)
        visuals.append(painted(placed(plate, (s.depth / 2, 0.0, s.height - 0.001)), color))
        tone = (0.5, 0.5, 0.52) if s.hob == "glass" else (0.16, 0.16, 0.17)
        visuals.append(painted(merged(*_burners(s)), tone))
    if s.backsplash:
        board = slab(s.splash_depth, s.width - 0.004, s.splash + 0.004, 0.008, 0.003)
        place = (s.depth - s.splash_depth / 2 - 0.003, 0.0, s.height - 0.004)
        visuals.append(painted(placed(board, place), s.body_color))
    return visuals


def _controls(s: OvenShape) -> list[Visual]:
    """The strip above the door with knobs and a display, or these on the board behind the top."""
    middle = s.height - s.strip / 2
    strip = slab(s.width, s.strip - 0.002, s.door_thickness + GAP, 0.004, 0.003)
    visuals = [painted(facing(strip, 0.0005, z=middle), s.door_color)]
    face, high = s.outer, s.strip
    if s.backsplash and s.rear_controls:
        face, high = s.depth - s.splash_depth - 0.003, s.splash
        middle = s.height + s.splash / 2
    if s.knobs:
        radius = min(max(s.knob_radius * high / 2, 0.009), 0.036)
        knob = merged(
            cylinder(radius, -0.002, 0.008, 0.002),
            cylinder(0.75 * radius, 0.006, 0.026, 0.003),
            box((-0.12 * radius, -0.8 * radius, 0.008), (0.12 * radius, 0.8 * radius, 0.032)),
        )
        slots = np.linspace(-0.42, 0.42, s.knob_count) * s.width
        if s.display:
            slots = slots[np.abs(slots) > 0.14 * s.width + radius]
        pieces = [facing(knob, face, z=middle, y=y) for y in slots]
        visuals.append(painted(merged(*pieces), BLACK))
    if s.display:
        screen = slab(0.24 * s.width, 0.5 * high, 0.004, 0.004, 0.001)
        visuals.append(painted(facing(screen, face + 0.002, z=middle), (0.05, 0.12, 0.16)))
    return visuals


def _fronts(s: OvenShape) -> list[Visual]:
    """Drawers or a panel under the door, clear of its swing, flush with it."""
    top, bottom = s.low - s.sweep, 0.008
    count = 2 if s.below == "two drawers" and top > 0.2 else 1
    if s.below == "nothing" or s.trait == SET_BACK or top - bottom < 0.05:
        return []
    visuals = []
    high = (top - bottom) / count
    for k in range(count):
        middle = bottom + (k + 0.5) * high
        thick = GAP + (0.2 if s.below == "panel" else 1.0) * s.door_thickness
        front = slab(s.width - 2 * s.door_margin, high - 0.004, thick, 0.004, 0.002)
        visuals.append(painted(facing(front, 0.0005, z=middle), shade(s.door_color, 0.92)))
        if s.below != "panel":
            grip = slab(0.5 * s.width, 0.014, 0.02, 0.004, 0.002)
            rise = middle + 0.32 * high
            visuals.append(painted(facing(grip, 0.001 - thick, z=rise), shade(s.door_color, 0.6)))
    return visuals


def _frame(s: OvenShape) -> list[Visual]:
    """Feet, cheeks beside a recessed door, the second door of a wide oven."""
    visuals = []
    if s.feet:
        half = s.foot_width / 2
        foot = cylinder(half, -s.foot_height, 0.004, 0.003, 16)
        if s.square_feet:
            foot = box((-half, -half, -s.foot_height), (half, half, 0.004))
        x, y = (half + 0.02, s.depth - half - 0.02), s.width / 2 - half - 0.01
        feet = merged(*(placed(foot, (i, j * y, 0)) for i in x for j in (-1, 1)))
        visuals.append(painted(feet, BLACK))
    if s.recessed and s.door_margin > 0.012:
        low, high = 0.004, s.height - s.strip - 0.001
        reach = -GAP - s.cheek * s.door_thickness
        inner = s.width / 2 - s.door_margin + 0.004
        cheek = box((reach, inner, low), (0.0005, s.width / 2 - 0.0005, high))
        visuals.append(painted(merged(cheek, mirrored(cheek, 1)), s.body_color))
    if s.doubled:
        leaf = slab(s.door_width, s.door_height, GAP + s.door_thickness, 0.008, 0.004)
        middle = s.low + s.door_height / 2
        pane = slab(0.6 * s.door_width, 0.4 * s.door_height, 0.002, 0.01)
        visuals.append(painted(facing(leaf, 0.0005, z=middle, y=-s.bay[1]), s.door_color))
        visuals.append(painted(facing(pane, s.outer + 0.001, z=middle, y=-s.bay[1]), BLACK))
        visuals.append(painted(placed(_handle(s), (0.0, -2 * s.bay[1], 0.0)), STEEL))
    return visuals


def _rack(s: OvenShape) -> trimesh.Trimesh:
    """A wire rack half way up the cavity."""
    half = s.bay[0] / 2 - s.wall + 0.002
    near, far = 0.03, s.cavity_depth * s.depth - 0.01
    z = s.low + s.door_height / 2
    wire = cylinder(0.0025, near, far, 0.0, 8)
    wires = [placed(wire, (0, y, z), ALONG_X) for y in np.linspace(-half + 0.02, half - 0.02, 13)]
    cross = cylinder(0.0035, -half, half, 0.0, 8)
    wires += [placed(cross, (x, 0, z), ALONG_Y) for x in (near, far)]
    return placed(merged(*wires), (0.0, s.bay[1], 0.0))


def _body(s: OvenShape) -> list[Visual]:
    visuals = [painted(_shell(s), s.body_color), *_top(s), *_controls(s), *_fronts(s), *_frame(s)]
    depth = s.cavity_depth * s.depth
    width, height = _cavity(s)
    # a thin enamel lining, open to the front, in the cavity's own colour
    outer, inner = rectangle(width, height, 0.02), rectangle(width - 0.002, height - 0.002, 0.019)
    rings = [at(outer, -depth - 0.001), at(outer, -0.002), at(inner, -0.002)]
    rings.append(at(inner, -depth + 0.001))
    lining = facing(loft(rings), 0.0, z=s.low + s.door_height / 2, y=s.bay[1])
    visuals.append(painted(lining, s.inner_color))
    if s.rack:
        visuals.append(painted(_rack(s), STEEL))
    return visuals


def _grip(s: OvenShape, half: float) -> trimesh.Trimesh:
    """Along x on the plane z = 0, towards +z: a bar on posts, a bow, or a ledge."""
    if s.handle == "ledge":
        return placed(slab(2 * half, 0.022, 0.4 * s.standoff + 0.004, 0.006, 0.002), (0, 0, -0.004))
    steps = np.linspace(-half, half, 13)
    bow = s.standoff * (np.cos(pi * steps / (2 * half)) if s.handle == "bowed" else np.ones(13))
    path = np.column_stack([steps, np.zeros(13), bow + (-0.004 if s.handle == "bowed" else 0.0)])
    bar = sweep(path, superellipse(2 * s.handle_radius, 2 * s.handle_radius, 2.5, 14), (0, 1, 0))
    if s.handle == "bowed":
        return bar
    post = cylinder(0.75 * s.handle_radius, -0.004, s.standoff, 0.0, 12)
    return merged(bar, *(placed(post, (side * 0.86 * half, 0.0, 0.0)) for side in (-1, 1)))


def _handle(s: OvenShape) -> trimesh.Trimesh:
    """Near the edge that comes forward."""
    middle = s.low + s.door_height / 2
    if s.upright:
        grip = placed(_grip(s, s.handle_length * s.door_height / 2), rotation=QUARTER)
        return facing(grip, s.outer, z=middle, y=s.bay[1] - (s.handle_rise - 0.5) * s.door_width)
    side = -1 if s.trait == OTHER_WAY else 1
    rise = middle + side * (s.handle_rise - 0.5) * s.door_height
    return facing(_grip(s, s.handle_length * s.door_width / 2), s.outer, z=rise, y=s.bay[1])


def _door(s: OvenShape) -> list[Visual]:
    """A slab, or a frame with a pane of glass set into it, with a handle."""
    rings = rounded_sides(s.door_width, s.door_height, 0.008, 0.004, (0.0, s.door_thickness))
    middle, y = s.low + s.door_height / 2, s.bay[1]
    visuals = [painted(_handle(s), STEEL)]
    if s.window:
        size = (s.window_width * s.door_width, s.window_height * s.door_height)
        centre = (0.0, -0.03 * s.door_height)
        hole = rectangle(*size, 0.02, centre)
        rings += [at(hole, s.door_thickness), at(hole, 0.0)]
        pane = placed(
            slab(size[0] + 0.004, size[1] + 0.004, 0.5 * s.door_thickness, 0.02),
            (*centre, 0.25 * s.door_thickness),
        )
        visuals.append(painted(facing(pane, -GAP, z=middle, y=y), (0.1, 0.11, 0.13)))
    frame = facing(loft(rings, ring=s.window), -GAP, z=middle, y=y)
    return [painted(frame, s.door_color), *visuals]


def _hinge(s: OvenShape) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Pivot and axis.

    The axis of a common door runs along its lower edge, within its thickness: nothing of the door
    lies below, so that none of it turns into the body. An edge beside or below a fixed surface
    turns about its front. An axis set back into the body lies lower than it lies back, so that the
    door moves forward before it sinks.
    """
    if s.trait == OTHER_SIDE:
        return (s.outer, s.bay[1] + s.door_width / 2, s.low), (0.0, 0.0, -1.0)
    if s.trait == OTHER_WAY:
        return (s.outer, s.bay[1], s.low + s.door_height), (0.0, 1.0, 0.0)
    if s.trait == SET_BACK:
        back = 0.02 + 0.05 * s.hinge_depth
        return (back - GAP, s.bay[1], s.low - back - 0.006), (0.0, -1.0, 0.0)
    x = -GAP - s.hinge_depth * s.door_thickness
    most = 2 * GAP / s.door_width  # no end of the edge comes nearer to the body than the gap
    lean = min(max(s.lean, -most), most)
    return (x, s.bay[1], s.low), (0.0, -cos(lean), sin(lean))


def build(s: OvenShape) -> Design:
    """Body and door; the door's upper edge comes forward (-x) by a turn about -y."""
    pivot, axis = _hinge(s)
    return Design(parts=(_body(s), _door(s)), pivot=[pivot], axis=[axis], upper=[s.travel * TRAVEL])


RECIPE = Recipe(
    shape=OvenShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "tall"),
    rearranged=(OTHER_SIDE, OTHER_WAY, SET_BACK),
)
