# SPDX-License-Identifier: MIT
"""Ovens and ranges: a body with a cavity, a door hinged along its lower edge on the -x face.

The body's front lies in the plane x = 0 while the object is built, the door before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians

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
    loft,
    merged,
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
class OvenShape:
    """Free parameters; lengths in metres, ratios where named so."""

    width: float = span(0.50, 0.76, 0.44, 0.92)
    depth: float = span(0.48, 0.64, 0.42, 0.74)
    height: float = span(0.56, 0.92, 0.48, 1.05)
    door_low: float = span(0.06, 0.26, 0.04, 0.32)
    """Height of the door's lower edge over the body's height."""
    panel: float = span(0.12, 0.22, 0.09, 0.27)
    """Height of the strip above the door over the body's height."""
    door_thickness: float = span(0.028, 0.05, 0.022, 0.065)
    door_margin: float = span(0.004, 0.03, 0.002, 0.045)
    """From the body's sides to the door's."""
    corner_radius: float = span(0.004, 0.025, 0.002, 0.04)
    wall: float = span(0.035, 0.06, 0.028, 0.08)
    """Of the cavity at the sides."""
    cavity_depth: float = span(0.72, 0.88, 0.62, 0.92)
    window_width: float = span(0.55, 0.8, 0.45, 0.86)
    window_height: float = span(0.38, 0.6, 0.3, 0.66)
    handle_length: float = span(0.6, 0.88, 0.45, 0.94)
    handle_radius: float = span(0.007, 0.013, 0.005, 0.017)
    standoff: float = span(0.025, 0.045, 0.02, 0.06)
    knob_radius: float = span(0.28, 0.4, 0.22, 0.44)
    """Over half the height of the strip."""
    foot_height: float = span(0.02, 0.06, 0.012, 0.1)
    splash: float = span(0.06, 0.18, 0.04, 0.24)
    """Height of the board behind the top."""
    travel: float = span(0.9, 1.0, 0.82, 1.0)
    window: bool = chance(0.8)
    knobs: bool = chance(0.75)
    display: bool = chance(0.55)
    feet: bool = chance(0.6)
    backsplash: bool = chance(0.4)
    cooktop: bool = chance(0.6)
    rack: bool = chance(0.7)
    lower_panel: bool = chance(0.5)
    bowed_handle: bool = chance(0.35)
    knob_count: int = choice(4, 5, 6)
    body_color: tuple[float, float, float] = tint(
        STEEL, (0.92, 0.92, 0.9), (0.13, 0.13, 0.14), (0.35, 0.36, 0.38)
    )
    door_color: tuple[float, float, float] = tint(
        STEEL, (0.92, 0.92, 0.9), (0.16, 0.16, 0.17), (0.45, 0.46, 0.48)
    )
    inner_color: tuple[float, float, float] = tint((0.25, 0.26, 0.3), (0.18, 0.16, 0.15))

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
        """From its lower edge to 3 mm under the strip."""
        return self.height - self.strip - self.low - 0.003

    @property
    def door_width(self) -> float:
        """Along y."""
        return self.width - 2 * self.door_margin

    @property
    def outer(self) -> float:
        """The x of the door's front."""
        return -GAP - self.door_thickness


HELD_OUT: HeldOut = (
    {"window": False, "display": True},
    {"backsplash": True, "feet": True, "knobs": False},
    {"cooktop": False, "bowed_handle": True},
)


def _facing(mesh: trimesh.Trimesh, x: float, z: float) -> trimesh.Trimesh:
    """A panel built as seen from the front, put with its back face at (x, 0, z)."""
    return placed(mesh, (x, 0.0, z), FRONT)


def _shell(s: OvenShape) -> trimesh.Trimesh:
    """The body with its cavity: outside from back to front, then in to the cavity's back."""
    rings = rounded_sides(s.width, s.height, s.corner_radius, 0.003, (-s.depth, 0.0))
    size = (s.width - 2 * s.wall, s.door_height - 2 * s.wall)
    centre = (0.0, s.low + s.door_height / 2 - s.height / 2)
    back = -s.cavity_depth * s.depth
    rings += [at(rectangle(*size, 0.02, centre), z) for z in (0.0, back)]
    return _facing(loft(rings), 0.0, s.height / 2)


def _top(s: OvenShape) -> list[Visual]:
    """What stands on the body: burners, a board at the back."""
    visuals = []
    if s.cooktop:
        glass = slab(0.92 * s.depth, 0.94 * s.width, 0.006, 0.012, 0.002)
        visuals.append(painted(placed(glass, (s.depth / 2, 0.0, s.height - 0.001)), BLACK))
        ring = np.column_stack([0.17 * s.width * superellipse(1.0, 1.0, 2.0, 20), np.zeros(20)])
        burner = sweep(ring, rectangle(0.012, 0.014, 0.003, segments=1), (0, 0, 1), closed=True)
        cap = cylinder(0.045 * s.width, -0.006, 0.006, 0.002, 16)
        spots = [(i, j) for i in (0.28, 0.7) for j in (-0.24, 0.24)]
        pieces = [
            placed(mesh, (i * s.depth, j * s.width, s.height + 0.011))
            for i, j in spots
            for mesh in (burner, cap)
        ]
        visuals.append(painted(merged(*pieces), (0.2, 0.2, 0.21)))
    if s.backsplash:
        board = slab(0.05, s.width - 0.004, s.splash + 0.004, 0.008, 0.003)
        place = (s.depth - 0.028, 0.0, s.height - 0.004)
        visuals.append(painted(placed(board, place), s.body_color))
    return visuals


def _controls(s: OvenShape) -> list[Visual]:
    """The strip above the door with knobs and a display."""
    middle = s.height - s.strip / 2
    strip = slab(s.width, s.strip - 0.002, s.door_thickness + GAP, 0.004, 0.003)
    visuals = [painted(_facing(strip, 0.0005, middle), s.door_color)]
    if s.knobs:
        radius = s.knob_radius * s.strip / 2
        knob = merged(
            cylinder(radius, -0.002, 0.008, 0.002),
            cylinder(0.75 * radius, 0.006, 0.026, 0.003),
            box((-0.12 * radius, -0.8 * radius, 0.008), (0.12 * radius, 0.8 * radius, 0.032)),
        )
        slots = np.linspace(-0.42, 0.42, s.knob_count) * s.width
        if s.display:
            slots = slots[np.abs(slots) > 0.14 * s.width + radius]
        pieces = [placed(_facing(knob, s.outer, middle), (0.0, y, 0.0)) for y in slots]
        visuals.append(painted(merged(*pieces), BLACK))
    if s.display:
        screen = slab(0.24 * s.width, 0.5 * s.strip, 0.004, 0.004, 0.001)
        visuals.append(painted(_facing(screen, s.outer + 0.002, middle), (0.05, 0.12, 0.16)))
    return visuals


def _below(s: OvenShape) -> list[Visual]:
    """Feet, and a drawer front under the door, thinner than the door's gap."""
    visuals = []
    if s.feet:
        foot = cylinder(0.022, -s.foot_height, 0.004, 0.003, 16)
        x, y = (0.1 * s.depth, 0.9 * s.depth), 0.42 * s.width
        visuals.append(
            painted(merged(*(placed(foot, (i, j * y, 0)) for i in x for j in (-1, 1))), BLACK)
        )
    if s.lower_panel and s.low > 0.06:
        front = slab(s.door_width, s.low - 0.02, 0.003, 0.004, 0.0005)
        visuals.append(painted(_facing(front, 0.001, s.low / 2 - 0.002), shade(s.door_color, 0.9)))
    return visuals


def _rack(s: OvenShape) -> trimesh.Trimesh:
    """A wire rack half way up the cavity."""
    half = s.width / 2 - s.wall + 0.002
    near, far = 0.03, s.cavity_depth * s.depth - 0.01
    z = s.low + s.door_height / 2
    wire = cylinder(0.0025, near, far, 0.0, 8)
    wires = [placed(wire, (0, y, z), ALONG_X) for y in np.linspace(-half + 0.02, half - 0.02, 13)]
    cross = cylinder(0.0035, -half, half, 0.0, 8)
    wires += [placed(cross, (x, 0, z), ALONG_Y) for x in (near, far)]
    return merged(*wires)


def _body(s: OvenShape) -> list[Visual]:
    visuals = [painted(_shell(s), s.body_color), *_top(s), *_controls(s), *_below(s)]
    depth = s.cavity_depth * s.depth
    size = (s.width - 2 * s.wall, s.door_height - 2 * s.wall)
    # a thin enamel lining, open to the front, in the cavity's own colour
    rings = [at(rectangle(*size, 0.02), -depth - 0.001)]
    rings += [at(rectangle(*size, 0.02), -0.002)]
    inner = rectangle(size[0] - 0.002, size[1] - 0.002, 0.019)
    rings += [at(inner, -0.002), at(inner, -depth + 0.001)]
    lining = _facing(loft(rings), 0.0, s.low + s.door_height / 2)
    visuals.append(painted(lining, s.inner_color))
    if s.rack:
        visuals.append(painted(_rack(s), STEEL))
    return visuals


def _handle(s: OvenShape) -> trimesh.Trimesh:
    """A bar along y on two posts, straight or bowed away from the door."""
    half = s.handle_length * s.door_width / 2
    z = s.low + s.door_height * 0.93
    y = np.linspace(-half, half, 13)
    bow = s.standoff * (np.cos(pi * y / (2 * half)) if s.bowed_handle else np.ones(13))
    path = np.column_stack([s.outer - 0.004 - bow, y, np.full(13, z)])
    bar = sweep(path, superellipse(2 * s.handle_radius, 2 * s.handle_radius, 2.5, 14), (0, 0, 1))
    if s.bowed_handle:
        return bar
    post = cylinder(0.75 * s.handle_radius, -0.004, s.standoff + 0.004, 0.0, 12)
    posts = [placed(post, (s.outer, side * 0.86 * half, z), FRONT) for side in (-1, 1)]
    return merged(bar, *posts)


def _door(s: OvenShape) -> list[Visual]:
    """A slab, or a frame with a pane of glass set into it, with a handle."""
    rings = rounded_sides(s.door_width, s.door_height, 0.008, 0.004, (0.0, s.door_thickness))
    middle = s.low + s.door_height / 2
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
        visuals.append(painted(_facing(pane, -GAP, middle), (0.1, 0.11, 0.13)))
    frame = _facing(loft(rings, ring=s.window), -GAP, middle)
    return [painted(frame, s.door_color), *visuals]


def build(s: OvenShape) -> Design:
    """Body and door; the door's upper edge comes forward (-x) by a turn about -y.

    The axis runs along the door's lower inner edge, so that the door never leaves the half space
    in front of the plane of its gap.
    """
    return Design(
        parts=(_body(s), _door(s)),
        pivot=[(-GAP, 0.0, s.low)],
        axis=[(0.0, -1.0, 0.0)],
        upper=[s.travel * TRAVEL],
    )


RECIPE = Recipe(shape=OvenShape, build=build, held_out=HELD_OUT)
