# SPDX-License-Identifier: MIT
"""Drawers: a small cabinet of one to four bays, one of whose drawers slides out towards -x.

The cabinet's front lies in the plane x = 0 while the object is built, its floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.parameters import HeldOut, chance, choice, span, tint
from sim_assets.procedural.shapes import (
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
    superellipse,
    sweep,
)

GAP = 0.002
"""Between a front and the boards beside or behind it."""
REACH = 0.45
"""Longest travel, m."""
STEEL: RGB = (0.6, 0.6, 0.62)


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawerShape:
    """Free parameters; lengths in metres, ratios where named so."""

    width: float = span(0.34, 0.62, 0.28, 0.8)
    depth: float = span(0.34, 0.52, 0.28, 0.6)
    bay: float = span(0.12, 0.22, 0.09, 0.28)
    """Clear height of a bay."""
    board: float = span(0.012, 0.022, 0.009, 0.028)
    front_thickness: float = span(0.014, 0.022, 0.010, 0.028)
    overhang: float = span(0.0, 0.025, 0.0, 0.04)
    """Of the top board beyond the sides and the fronts."""
    tray_height: float = span(0.5, 0.85, 0.4, 0.92)
    """Over the bay's height."""
    tray_depth: float = span(0.8, 0.95, 0.7, 0.97)
    tray_wall: float = span(0.008, 0.014, 0.006, 0.018)
    edge: float = span(0.001, 0.006, 0.0005, 0.009)
    """Rounding of the fronts' edges."""
    grip_length: float = span(0.18, 0.5, 0.1, 0.75)
    """Of a bar or cup, over the width."""
    grip_size: float = span(0.007, 0.014, 0.005, 0.018)
    grip_height: float = span(0.42, 0.75, 0.35, 0.82)
    """Over the front's height."""
    standoff: float = span(0.02, 0.035, 0.015, 0.045)
    leg_height: float = span(0.06, 0.18, 0.04, 0.26)
    relief: float = span(0.12, 0.22, 0.09, 0.28)
    """Width of a panelled front's frame over its height."""
    travel: float = span(0.65, 0.85, 0.55, 0.9)
    """Over the tray's depth."""
    legs: bool = chance(0.5)
    plinth: bool = chance(0.4)
    """Where there are no legs."""
    inset: bool = chance(0.35)
    """Fronts between the boards; else before them."""
    panelled: bool = chance(0.4)
    rails: bool = chance(0.4)
    divider: bool = chance(0.45)
    round_top: bool = chance(0.5)
    grip: str = choice("bar", "bow", "knob", "cup")
    bays: int = choice(1, 2, 2, 3, 3, 4)
    moving: int = choice(0, 1, 2, 3)
    """Which bay's drawer moves, from below, modulo their number."""
    open_bay: bool = chance(0.3)
    """One of the other bays is an open shelf."""
    body_color: tuple[float, float, float] = tint(
        (0.62, 0.45, 0.28),
        (0.9, 0.89, 0.86),
        (0.35, 0.24, 0.16),
        (0.78, 0.64, 0.45),
        (0.3, 0.33, 0.37),
    )
    front_color: tuple[float, float, float] = tint(
        (0.66, 0.5, 0.32), (0.93, 0.92, 0.9), (0.4, 0.28, 0.2), (0.5, 0.6, 0.62), (0.75, 0.4, 0.3)
    )
    grip_color: tuple[float, float, float] = tint(
        (0.7, 0.7, 0.7), (0.15, 0.15, 0.15), (0.72, 0.58, 0.3)
    )

    @property
    def inner(self) -> float:
        """Clear width of a bay."""
        return self.width - 2 * self.board

    @property
    def height(self) -> float:
        """Of the cabinet without legs."""
        return self.bays * self.bay + (self.bays + 1) * self.board

    @property
    def bay_index(self) -> int:
        """Of the drawer that moves."""
        return self.moving % self.bays

    def floor(self, bay: int) -> float:
        """The z of a bay's floor."""
        return self.board + bay * (self.bay + self.board)

    @property
    def front(self) -> tuple[float, float]:
        """Width and height of a drawer's front."""
        if self.inset:
            return self.inner - 2 * GAP, self.bay - 2 * GAP
        return self.width - 2 * GAP, self.bay + self.board - 2 * GAP

    @property
    def front_x(self) -> float:
        """The x of the fronts' back faces."""
        return self.front_thickness + 0.001 if self.inset else -GAP


HELD_OUT: HeldOut = (
    {"inset": True, "panelled": True},
    {"legs": True, "grip": "cup"},
    {"divider": True, "rails": True, "round_top": False},
)


def _boards(s: DrawerShape) -> list[trimesh.Trimesh]:
    """Sides, back, floor and shelves; each runs a little into its neighbours."""
    half, t = s.width / 2, s.board
    sides = [box((0.0, y, 0.0), (s.depth, y + t, s.height)) for y in (-half, half - t)]
    levels = [s.floor(bay) - t for bay in range(s.bays)]
    shelves = [
        box((0.0003, -half + t - 3e-4, z + 3e-4), (s.depth - 3e-4, half - t + 3e-4, z + t))
        for z in levels
    ]
    back = box(
        (s.depth - 0.5 * t, -half + 4e-4, 4e-4), (s.depth - 4e-4, half - 4e-4, s.height - 4e-4)
    )
    return [*sides, *shelves, back]


def _top(s: DrawerShape) -> trimesh.Trimesh:
    """The top board, flush or overhanging, with sharp or rounded edges."""
    front = 0.0 if s.inset else GAP + s.front_thickness
    low, high = -front - s.overhang, s.depth
    bevel = 0.35 * s.board if s.round_top else 0.0005
    width = s.width + 2 * s.overhang
    top = slab(high - low, width, s.board, 0.003 + 2 * bevel, bevel)
    return placed(top, ((low + high) / 2, 0.0, s.height - s.board + 2e-4))


def _support(s: DrawerShape) -> list[trimesh.Trimesh]:
    """Four tapered legs, a plinth set back, or nothing."""
    if s.legs:
        leg = lathe([(0.011, -s.leg_height), (0.02, 0.001)], 14)
        x, y = (0.04, s.depth - 0.04), s.width / 2 - 0.04
        return [placed(leg, (i, j * y, 0.0)) for i in x for j in (-1, 1)]
    if s.plinth:
        drop = min(0.06, 0.5 * s.leg_height)
        return [box((0.03, -s.width / 2 + 0.01, -drop), (s.depth - 5e-4, s.width / 2 - 0.01, 5e-4))]
    return []


def _front_panel(s: DrawerShape) -> trimesh.Trimesh:
    """A drawer's front, plain or with a recessed panel; back face in z = 0, seen from outside."""
    width, height = s.front
    rings = rounded_sides(width, height, s.edge + 1e-3, s.edge, (0.0, s.front_thickness))
    if s.panelled:
        frame = s.relief * height
        size = (width - 2 * frame, height - 2 * frame)
        rings += [at(rectangle(*size, 0.002), s.front_thickness)]
        size = (size[0] - 0.008, size[1] - 0.008)
        rings += [at(rectangle(*size, 0.002), 0.62 * s.front_thickness)]
    return loft(rings)


def _grip(s: DrawerShape) -> trimesh.Trimesh:
    """What one pulls at, standing on the plane z = 0, y up; reaches 1 mm or more below it."""
    half = s.grip_length * s.width / 2
    if s.grip == "knob":
        stem = cylinder(0.6 * s.grip_size, -0.008, s.standoff, 0.0, 14)
        head = ellipsoid((3.4 * s.grip_size, 3.4 * s.grip_size, 2 * s.grip_size))
        return merged(stem, placed(head, (0.0, 0.0, s.standoff)))
    if s.grip == "cup":
        angle = np.linspace(0.04, 0.96, 9) * pi
        arc = np.column_stack([np.zeros(9), 0.8 * np.cos(angle) - 0.2, np.sin(angle)])
        path = arc[:6] * s.standoff + np.array([0.0, 0.0, -0.008])
        strip = rectangle(2 * half, 0.003, 0.001, segments=1)
        return sweep(path, strip[:, ::-1][::-1], (1.0, 0.0, 0.0))
    steps = np.linspace(-1.0, 1.0, 13)
    bow = np.cos(pi * steps / 2) if s.grip == "bow" else np.ones(13)
    path = np.column_stack([half * steps, np.zeros(13), (s.standoff + 0.008) * bow - 0.008])
    profile = superellipse(1.3 * s.grip_size, s.grip_size, 2.5, 12)
    bar = sweep(path, profile, (0.0, 1.0, 0.0))
    if s.grip == "bow":
        return bar
    post = cylinder(0.42 * s.grip_size, -0.008, s.standoff, 0.0, 10)
    return merged(bar, *(placed(post, (0.85 * side * half, 0.0, 0.0)) for side in (-1, 1)))


def _front(s: DrawerShape, bay: int) -> list[Visual]:
    """Front and grip of a bay's drawer."""
    # a front before the boards covers the one below its bay
    middle = s.floor(bay) + (s.bay - (0.0 if s.inset else s.board)) / 2
    panel = placed(_front_panel(s), (s.front_x, 0.0, middle), FRONT)
    rise = (s.grip_height - 0.5) * s.front[1]
    grip = placed(_grip(s), (s.front_x - s.front_thickness, 0.0, middle + rise), FRONT)
    return [painted(panel, s.front_color), painted(grip, s.grip_color)]


def _tray(s: DrawerShape) -> list[Visual]:
    """The open box behind the moving front, with a divider or two in it."""
    low = s.floor(s.bay_index) + 0.004
    tall = s.tray_height * (s.bay - 0.008)
    start = s.front_x - 0.001
    end = s.tray_depth * (s.depth - s.board)
    size = np.array([end - start, s.inner - 2 * (0.011 if s.rails else 0.004)])
    outer = rectangle(size[0], size[1], 0.002, segments=1)
    hollow = size - 2 * s.tray_wall
    inside = rectangle(hollow[0], hollow[1], 0.001, segments=1)
    floor = 0.006
    rings = [at(outer, 0.0), at(outer, tall), at(inside, tall), at(inside, floor)]
    middle = np.array([(start + end) / 2, 0.0, low])
    color = shade(s.front_color, 0.95)
    visuals = [painted(placed(loft(rings), middle), color)]
    if s.divider:
        reach = size / 2 - s.tray_wall + 5e-4
        long = box((-reach[0], -0.004, floor - 5e-4), (reach[0], 0.004, 0.8 * tall))
        cross = box((-0.004, 0.0035, floor - 5e-4), (0.004, reach[1], 0.7 * tall))
        visuals.append(painted(placed(merged(long, cross), middle), shade(s.front_color, 0.8)))
    return visuals


def _rails(s: DrawerShape) -> trimesh.Trimesh:
    """A runner on either side of the moving drawer."""
    z = s.floor(s.bay_index) + 0.4 * s.bay
    half = s.inner / 2
    rail = box((s.front_x + 0.004, half - 0.008, z), (0.9 * s.depth, half + 5e-4, z + 0.018))
    other = box((s.front_x + 0.004, -half - 5e-4, z), (0.9 * s.depth, -half + 0.008, z + 0.018))
    return merged(rail, other)


def _body(s: DrawerShape) -> list[Visual]:
    visuals = [
        painted(merged(*_boards(s), *_support(s)), s.body_color),
        painted(_top(s), shade(s.body_color, 1.08)),
    ]
    others = [bay for bay in range(s.bays) if bay != s.bay_index]
    if s.open_bay and others:
        others = others[1:]
    for bay in others:
        visuals += _front(s, bay)
    if s.rails:
        visuals.append(painted(_rails(s), STEEL))
    return visuals


def build(s: DrawerShape) -> Design:
    """Cabinet and drawer; the drawer comes out towards -x."""
    depth = s.tray_depth * (s.depth - s.board)
    return Design(
        parts=(_body(s), [*_front(s, s.bay_index), *_tray(s)]),
        pivot=[(0.0, 0.0, 0.0)],
        axis=[(-1.0, 0.0, 0.0)],
        upper=[min(REACH, s.travel * depth)],
    )


RECIPE = Recipe(shape=DrawerShape, build=build, held_out=HELD_OUT)
