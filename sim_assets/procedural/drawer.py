# SPDX-License-Identifier: MIT
"""Drawers: a cabinet of bays in one or two columns, one of whose drawers slides out towards -x.

The other bays are drawers that stay shut, doors, or open shelves.

The cabinet's front lies in the plane x = 0 while the object is built, its floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.cabinets import QUARTER, Cabinet, facing
from sim_assets.procedural.parameters import (
    HeldOut,
    chance,
    choice,
    ratio,
    span,
    tint,
)
from sim_assets.procedural.shapes import (
    at,
    box,
    cylinder,
    ellipsoid,
    lathe,
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

GAP = 0.002
"""Between a front and the boards beside or behind it."""
REACH = 0.45
"""Longest travel, m."""
STEEL: RGB = (0.6, 0.6, 0.62)
LEAST = 0.05
"""Height of the lowest bay, m."""
MORE = "more bays"
BEHIND = "drawer set back"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bay:
    """The clear room between boards; y to the viewer's left."""

    kind: str
    y: tuple[float, float]
    z: tuple[float, float]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height."""
        return self.y[1] - self.y[0], self.z[1] - self.z[0]

    @property
    def middle(self) -> tuple[float, float]:
        """The y and z."""
        return sum(self.y) / 2, sum(self.z) / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawerShape(Cabinet):
    """Free parameters; lengths in metres, ratios where named so."""

    size: float = span(0.32, 0.54, 0.29, 0.62)
    aspect: float = ratio(0.55, 1.65, 0.45, 2.4)
    tall: float = ratio(0.32, 4.8, 0.22, 6.8)
    share: float = ratio(0.08, 0.5, 0.06, 0.65)
    """Height of the moving drawer's bay over the cabinet's."""
    place: float = span(0.0, 1.0, 0.0, 1.0)
    """Of the height that its bay leaves, how much is below."""
    board: float = span(0.01, 0.024, 0.008, 0.03)
    front_thickness: float = span(0.012, 0.026, 0.009, 0.034)
    overhang: float = span(0.0, 0.03, 0.0, 0.05)
    """Of the top board beyond the sides and the fronts."""
    tray_height: float = span(0.5, 0.85, 0.4, 0.92)
    """Over the bay's height."""
    tray_depth: float = span(0.6, 0.96, 0.45, 0.97)
    tray_wall: float = span(0.008, 0.014, 0.006, 0.018)
    edge: float = span(0.001, 0.006, 0.0005, 0.009)
    """Rounding of the fronts' edges."""
    grip_length: float = span(0.15, 0.6, 0.1, 0.8)
    """Of a bar or cup, over the width."""
    grip_size: float = span(0.007, 0.014, 0.005, 0.018)
    grip_height: float = span(0.42, 0.75, 0.35, 0.82)
    """Over the front's height."""
    standoff: float = span(0.02, 0.035, 0.015, 0.045)
    leg_height: float = span(0.05, 0.24, 0.03, 0.34)
    leg_width: float = span(0.014, 0.032, 0.01, 0.042)
    rim: float = span(0.015, 0.08, 0.01, 0.12)
    """Height of a rim about the top."""
    relief: float = span(0.12, 0.22, 0.09, 0.28)
    """Width of a panelled front's frame over its height."""
    travel: float = span(0.6, 0.88, 0.5, 0.92)
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
    below: str = choice("drawers", "drawers", "door", "open")
    """What the bays under the moving drawer are."""
    above: str = choice("drawers", "drawers", "door", "open")
    beside: str = choice("nothing", "nothing", "drawers", "door", "open")
    """What a second column is."""
    left: bool = chance(0.5)
    """The moving drawer is in the left column."""
    square_legs: bool = chance(0.5)
    rimmed: bool = chance(0.3)
    double_grip: bool = chance(0.3)
    """Two grips on a wide front."""
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

    trait: str = ""

    @property
    def columns(self) -> int:
        """Of bays side by side."""
        if self.width < 0.3:
            return 1
        return 1 if self.beside == "nothing" and self.trait != MORE else 2

    def column(self, moving: bool) -> tuple[float, float]:
        """From y to y: the column of the moving drawer, or the other."""
        half = self.width / 2 - self.board
        if self.columns == 1:
            return -half, half
        return (self.board / 2, half) if self.left == moving else (-half, -self.board / 2)

    @property
    def bay(self) -> Bay:
        """Of the moving drawer."""
        y = self.column(moving=True)
        clear = self.height - 2 * self.board
        share = 0.06 + 0.1 * self.share if self.trait == MORE else self.share
        high = min(max(share * self.height, LEAST), 0.9 * (y[1] - y[0]), clear)
        least = LEAST + self.board
        rest = clear - high
        if rest < least:
            high, low = clear, 0.0
        else:
            low = self.place * rest
            low = 0.0 if low < least else rest if rest - low < least else low
        return Bay(kind="drawer", y=y, z=(self.board + low, self.board + low + high))

    def filled(self, kind: str, y: tuple[float, float], z: tuple[float, float]) -> list[Bay]:
        """Bays of one kind in a clear room, drawers about as high as the one that moves."""
        if z[1] - z[0] < 0.5 * LEAST:
            return []
        bay = self.bay.size[1]
        most = 9 if self.trait == MORE else 5
        count = round((z[1] - z[0]) / (bay + self.board)) if kind == "drawers" else 1
        count = max(1, min(count, most))
        high = (z[1] - z[0] - (count - 1) * self.board) / count
        name = {"drawers": "drawer"}.get(kind, kind)
        starts = [z[0] + k * (high + self.board) for k in range(count)]
        return [Bay(kind=name, y=y, z=(start, start + high)) for start in starts]

    @property
    def others(self) -> list[Bay]:
        """All bays but the moving drawer's."""
        bay, top = self.bay, self.height - self.board
        more = self.trait == MORE
        found = self.filled(
            "drawers" if more else self.below, bay.y, (self.board, bay.z[0] - self.board)
        )
        found += self.filled("drawers" if more else self.above, bay.y, (bay.z[1] + self.board, top))
        if self.columns == 2:
            y = self.column(moving=False)
            found += self.filled("drawers" if more else self.beside, y, (self.board, top))
        return found

    def front(self, bay: Bay) -> tuple[tuple[float, float], tuple[float, float]]:
        """Size (width, height) and middle (y, z) of a bay's front.

        A front before the boards covers the one below its bay, and those beside it up to its
        neighbours.
        """
        if self.inset or self.trait == BEHIND:
            return (bay.size[0] - 2 * GAP, bay.size[1] - 2 * GAP), bay.middle
        half = self.width / 2
        edges = [
            end + side * (self.board if abs(end) > half - 1.5 * self.board else self.board / 2)
            for end, side in zip(bay.y, (-1, 1), strict=True)
        ]
        size = (edges[1] - edges[0] - 2 * GAP, bay.size[1] + self.board - 2 * GAP)
        return size, ((edges[0] + edges[1]) / 2, bay.middle[1] - self.board / 2)

    @property
    def front_x(self) -> float:
        """The x of the fronts' back faces."""
        if self.trait == BEHIND:
            return (0.1 + 0.1 * self.grip_height) * self.depth + self.front_thickness
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
    if s.columns == 2:
        sides.append(box((0.0003, -t / 2, 3e-4), (s.depth - 3e-4, t / 2, s.height - 3e-4)))
    # under every bay lies a board
    shelves = [
        box(
            (0.0003, bay.y[0] - 3e-4, bay.z[0] - t + 3e-4),
            (s.depth - 3e-4, bay.y[1] + 3e-4, bay.z[0]),
        )
        for bay in (s.bay, *s.others)
    ]
    back = box(
        (s.depth - 0.5 * t, -half + 4e-4, 4e-4), (s.depth - 4e-4, half - 4e-4, s.height - 4e-4)
    )
    return [*sides, *shelves, back]


def _top(s: DrawerShape) -> list[trimesh.Trimesh]:
    """The top board, flush or overhanging, with sharp or rounded edges."""
    front = 0.0 if s.inset or s.trait == BEHIND else GAP + s.front_thickness
    low, high = -front - s.overhang, s.depth
    bevel = 0.35 * s.board if s.round_top else 0.0005
    width = s.width + 2 * s.overhang
    top = slab(high - low, width, s.board, 0.003 + 2 * bevel, bevel)
    pieces = [placed(top, ((low + high) / 2, 0.0, s.height - s.board + 2e-4))]
    if s.rimmed:
        ground, end = s.height - 0.004, s.height + s.rim
        side = width / 2 - 0.004
        rail = box((low + 0.3 * s.depth, side - 0.012, ground), (high - 0.002, side, end))
        back = box((high - 0.014, -side + 0.002, ground), (high - 0.0025, side - 0.002, end - 5e-4))
        pieces += [rail, mirrored(rail, 1), back]
    return pieces


def _support(s: DrawerShape) -> list[trimesh.Trimesh]:
    """Four tapered legs, a plinth set back, or nothing."""
    if s.legs:
        r = s.leg_width
        leg = lathe([(0.55 * r, -s.leg_height), (r, 0.001)], 14)
        if s.square_legs:
            leg = box((-r, -r, -s.leg_height), (r, r, 0.001))
        x, y = (r + 0.005, s.depth - r - 0.005), s.width / 2 - r - 0.005
        return [placed(leg, (i, j * y, 0.0)) for i in x for j in (-1, 1)]
    if s.plinth:
        drop = min(0.06, 0.5 * s.leg_height)
        return [box((0.03, -s.width / 2 + 0.01, -drop), (s.depth - 5e-4, s.width / 2 - 0.01, 5e-4))]
    return []


def _front_panel(s: DrawerShape, width: float, height: float) -> trimesh.Trimesh:
    """A drawer's front, plain or with a recessed panel; back face in z = 0, seen from outside."""
    rings = rounded_sides(width, height, s.edge + 1e-3, s.edge, (0.0, s.front_thickness))
    if s.panelled:
        frame = s.relief * min(width, height)
        size = (width - 2 * frame, height - 2 * frame)
        rings += [at(rectangle(*size, 0.002), s.front_thickness)]
        size = (size[0] - 0.008, size[1] - 0.008)
        rings += [at(rectangle(*size, 0.002), 0.62 * s.front_thickness)]
    return loft(rings)


def _grip(s: DrawerShape, width: float, height: float) -> trimesh.Trimesh:
    """What one pulls at, standing on the plane z = 0, y up; reaches 1 mm or more below it."""
    half = s.grip_length * width / 2
    stand, wide = min(s.standoff, 0.4 * height), min(s.grip_size, 0.2 * height)
    if s.grip == "knob":
        stem = cylinder(0.6 * wide, -0.008, stand, 0.0, 14)
        head = ellipsoid((3.4 * wide, 3.4 * wide, 2 * wide))
        return merged(stem, placed(head, (0.0, 0.0, stand)))
    if s.grip == "cup":
        angle = np.linspace(0.04, 0.96, 9) * pi
        arc = np.column_stack([np.zeros(9), 0.8 * np.cos(angle) - 0.2, np.sin(angle)])
        path = arc[:6] * stand + np.array([0.0, 0.0, -0.008])
        strip = rectangle(2 * half, 0.003, 0.001, segments=1)
        return sweep(path, strip[:, ::-1][::-1], (1.0, 0.0, 0.0))
    steps = np.linspace(-1.0, 1.0, 13)
    bow = np.cos(pi * steps / 2) if s.grip == "bow" else np.ones(13)
    path = np.column_stack([half * steps, np.zeros(13), (stand + 0.008) * bow - 0.008])
    profile = superellipse(1.3 * wide, wide, 2.5, 12)
    bar = sweep(path, profile, (0.0, 1.0, 0.0))
    if s.grip == "bow":
        return bar
    post = cylinder(0.42 * wide, -0.008, stand, 0.0, 10)
    return merged(bar, *(placed(post, (0.85 * side * half, 0.0, 0.0)) for side in (-1, 1)))


def _front(s: DrawerShape, bay: Bay) -> list[Visual]:
    """Front and grip of a bay's drawer or door; nothing before an open shelf."""
    if bay.kind == "open":
        return []
    (width, height), (y, z) = s.front(bay)
    panel = facing(_front_panel(s, width, height), s.front_x, y, z)
    face = s.front_x - s.front_thickness
    if bay.kind == "door":
        grip = placed(_grip(s, min(0.5 * height, 0.4), width), rotation=QUARTER)
        grips = [facing(grip, face, y - 0.4 * width, z)]
    else:
        room = 0.5 * height - min(s.standoff, 0.4 * height) - 0.002
        rise = z + min((s.grip_height - 0.5) * height, max(room, 0.0))
        two = s.double_grip and width > 0.4
        grip = _grip(s, 0.4 * width if two else width, height)
        spots = (-0.27 * width, 0.27 * width) if two else (0.0,)
        grips = [facing(grip, face, y + spot, rise) for spot in spots]
    return [painted(panel, s.front_color), painted(merged(*grips), s.grip_color)]


def _reach(s: DrawerShape) -> float:
    """Depth of the tray behind its front."""
    return s.tray_depth * (s.depth - s.board - max(0.0, s.front_x))


def _tray(s: DrawerShape) -> list[Visual]:
    """The open box behind the moving front, with a divider or two in it."""
    bay = s.bay
    low = bay.z[0] + 0.004
    tall = s.tray_height * (bay.size[1] - 0.008)
    start = s.front_x - 0.001
    end = start + _reach(s)
    size = np.array([end - start, bay.size[0] - 2 * (0.011 if s.rails else 0.004)])
    outer = rectangle(size[0], size[1], 0.002, segments=1)
    hollow = size - 2 * s.tray_wall
    inside = rectangle(hollow[0], hollow[1], 0.001, segments=1)
    floor = 0.006
    rings = [at(outer, 0.0), at(outer, tall), at(inside, tall), at(inside, floor)]
    middle = np.array([(start + end) / 2, bay.middle[0], low])
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
    bay = s.bay
    z, high = bay.z[0] + 0.4 * bay.size[1], min(0.018, 0.2 * bay.size[1])
    near, far = s.front_x + 0.004, 0.9 * s.depth
    right = box((near, bay.y[0] - 5e-4, z), (far, bay.y[0] + 0.008, z + high))
    left = box((near, bay.y[1] - 0.008, z), (far, bay.y[1] + 5e-4, z + high))
    return merged(left, right)


def _body(s: DrawerShape) -> list[Visual]:
    visuals = [
        painted(merged(*_boards(s), *_support(s)), s.body_color),
        painted(merged(*_top(s)), shade(s.body_color, 1.08)),
    ]
    for bay in s.others:
        visuals += _front(s, bay)
    if s.rails:
        visuals.append(painted(_rails(s), STEEL))
    return visuals


def build(s: DrawerShape) -> Design:
    """Cabinet and drawer; the drawer comes out towards -x."""
    return Design(
        parts=(_body(s), [*_front(s, s.bay), *_tray(s)]),
        pivot=[(0.0, 0.0, 0.0)],
        axis=[(-1.0, 0.0, 0.0)],
        upper=[min(REACH, s.travel * _reach(s))],
    )


RECIPE = Recipe(
    shape=DrawerShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "tall"),
    rearranged=(MORE, BEHIND),
)
