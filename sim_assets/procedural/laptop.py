# SPDX-License-Identifier: MIT
"""Laptops: a base with a keyboard, a screen on a hinge along y at the rear (+x) edge."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.parameters import (
    OTHER_SIDE,
    SET_BACK,
    HeldOut,
    chance,
    choice,
    ratio,
    span,
    tint,
)
from sim_assets.procedural.shapes import (
    ALONG_Y,
    DOWN,
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
)

BLACK: RGB = (0.06, 0.06, 0.07)
TRAVEL = radians(135.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LaptopShape:
    """Free parameters; lengths in metres, ratios of width or depth where named so."""

    width: float = span(0.22, 0.4, 0.18, 0.46)
    aspect: float = ratio(0.5, 1.0, 0.42, 1.2)
    """Depth over width."""
    base_thickness: float = ratio(0.009, 0.04, 0.007, 0.055)
    lid_thickness: float = ratio(0.004, 0.014, 0.0035, 0.02)
    deck: float = span(0.06, 0.38, 0.05, 0.42)
    """How much of the base lies behind the hinge where some does, over the depth."""
    corner_radius: float = span(0.002, 0.022, 0.001, 0.03)
    bevel: float = span(0.0005, 0.003, 0.0003, 0.004)
    wedge: float = span(0.0, 0.4, 0.0, 0.5)
    """How much thinner the base is at its front."""
    half_gap: float = span(0.0007, 0.0014, 0.0006, 0.0018)
    """Between either half and the plane of the hinge."""
    lid_ratio: float = span(0.93, 1.0, 0.88, 1.0)
    lean: float = span(-0.006, 0.006, -0.01, 0.01)
    """Of the axis, rad: lids hang a little askew."""
    well_width: float = span(0.7, 0.94, 0.62, 0.95)
    well_depth: float = span(0.34, 0.48, 0.3, 0.52)
    pad_width: float = span(0.2, 0.46, 0.15, 0.55)
    pad_depth: float = span(0.2, 0.35, 0.16, 0.37)
    chin: float = span(0.03, 0.16, 0.02, 0.22)
    """Border below the display over the lid's depth."""
    border: float = span(0.012, 0.06, 0.008, 0.08)
    barrel_radius: float = span(0.003, 0.0065, 0.0025, 0.008)
    barrel_length: float = span(0.3, 0.8, 0.2, 0.85)
    foot_height: float = span(0.0012, 0.005, 0.001, 0.009)
    travel: float = span(0.75, 1.0, 0.65, 1.0)
    keys: bool = chance(0.8)
    """A well with keys; else a flat touch surface."""
    touchpad: bool = chance(0.85)
    bezel: bool = chance(0.6)
    """A raised border about the display; else flush glass."""
    barrel: bool = chance(0.6)
    decked: bool = chance(0.5)
    """The base goes on behind the hinge."""
    feet: bool = chance(0.7)
    webcam: bool = chance(0.5)
    logo: bool = chance(0.5)
    strips: bool = chance(0.3)
    """Speaker strips beside the keyboard."""
    rows: int = choice(4, 5, 6)
    columns: int = choice(10, 12, 14)
    ports: bool = chance(0.5)
    """Sockets at the base's sides."""
    body_color: tuple[float, float, float] = tint(
        (0.75, 0.76, 0.78),
        (0.2, 0.2, 0.22),
        (0.45, 0.46, 0.5),
        (0.85, 0.8, 0.74),
        (0.25, 0.3, 0.4),
        (0.7, 0.3, 0.3),
    )
    key_color: tuple[float, float, float] = tint(
        (0.1, 0.1, 0.1), (0.85, 0.85, 0.85), (0.25, 0.25, 0.27)
    )
    display_color: tuple[float, float, float] = tint(
        (0.07, 0.08, 0.1), (0.15, 0.25, 0.45), (0.1, 0.3, 0.3)
    )
    plain: bool = False
    """Two equal slabs and nothing else: has the category's swap symmetry exactly."""
    trait: str = ""

    @property
    def behind(self) -> float:
        """Length of the base behind the hinge, over the depth."""
        least = (self.barrel_radius + 0.015) / (self.width * self.aspect)
        if self.trait == SET_BACK:
            return 0.42 + 0.3 * self.deck
        if self.decked and self.trait != OTHER_SIDE and not self.plain:
            return max(self.deck, least)
        return 0.0

    @property
    def corner(self) -> float:
        """Radius of the base's corners, small where it goes on behind the hinge."""
        return min(self.corner_radius, 0.006) if self.behind > 0 else self.corner_radius

    @property
    def barrelled(self) -> bool:
        """Whether the hinge is seen."""
        return (self.barrel and self.trait != OTHER_SIDE) or self.behind > 0

    @property
    def thick(self) -> float:
        """Of the base: a barrel in it needs room."""
        least = self.barrel_radius + 0.006 if self.behind > 0 else 0.0
        return max(self.base_thickness, least)

    @property
    def rear(self) -> float:
        """Distance of both halves' rear edge in front of the hinge axis."""
        if self.behind > 0:  # the lid stays above what lies behind the axis
            return max(self.barrel_radius, self.lid_thickness) + 2 * self.half_gap + 0.001
        return self.barrel_radius + 0.001 if self.barrelled else self.half_gap

    @property
    def depth(self) -> float:
        """Of the base in front of the hinge, along x."""
        return self.width * self.aspect * (1 - self.behind)

    @property
    def middle(self) -> float:
        """The x of the base's middle."""
        return -self.rear - self.depth / 2


HELD_OUT: HeldOut = (
    {"keys": False, "bezel": True},
    {"barrel": True, "feet": False, "webcam": True},
    {"touchpad": False, "logo": True},
)
SYMMETRIC = {
    "plain": True, "keys": False, "touchpad": False, "bezel": False, "barrel": False,
    "feet": False, "webcam": False, "logo": False, "strips": False, "wedge": 0.0, "ports": False,
    "lean": 0.0,
    "lid_ratio": 1.0, "lid_thickness": 0.012, "base_thickness": 0.012,
}  # fmt: skip


def _well(s: LaptopShape) -> tuple[float, float, tuple[float, float]]:
    """Depth (x), width (y) and centre of the keyboard well, relative to the base's middle."""
    depth, width = s.well_depth * s.depth, s.well_width * s.width
    return depth, width, (s.depth * 0.44 - depth / 2, 0.0)


def _base_body(s: LaptopShape) -> trimesh.Trimesh:
    """The base: a slab, with a well if it has keys, thinner towards the front."""
    rings = rounded_sides(s.depth, s.width, s.corner, s.bevel, (-s.thick, 0.0))
    if s.keys:
        depth, width, centre = _well(s)
        rim = rectangle(depth, width, 0.003, centre)
        rings += [at(rim, 0.0), at(rim, -0.25 * s.thick)]
    mesh = placed(loft(rings), (s.middle, 0.0, -s.half_gap))
    vertices = np.array(mesh.vertices)
    top = -s.half_gap
    lower = vertices[:, 2] < top - 0.5 * s.thick
    front = np.clip((-s.rear - vertices[:, 0]) / s.depth, 0.0, 1.0)
    taper = 1 - s.wedge * front * (2 * (top - vertices[:, 2]) / s.thick - 1)
    vertices[lower, 2] = top + (vertices[lower, 2] - top) * taper[lower]
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def _keys(s: LaptopShape) -> trimesh.Trimesh:
    """Rows of key caps standing in the well, level with the base; a space bar in front."""
    depth, width, centre = _well(s)
    columns = s.columns
    floor, top = -s.half_gap - 0.26 * s.thick, -s.half_gap - 0.0001
    pitch = np.array([(depth - 0.004) / s.rows, (width - 0.004) / columns])
    low = np.array([s.middle + centre[0], centre[1]]) - pitch * [s.rows, columns] / 2
    gap = 0.12 * pitch.min()
    caps = []
    for row in range(s.rows):
        column = 0
        while column < columns:
            wide = 4 if row == 0 and column == 3 else 1
            corner = low + pitch * [row, column] + gap
            end = low + pitch * [row + 1, column + wide] - gap
            caps.append(box((*corner, floor), (*end, top)))
            column += wide
    return merged(*caps)


def _touch_parts(s: LaptopShape) -> list[Visual]:
    """Touch pad, speaker strips."""
    visuals = []
    top = -s.half_gap - 0.0005
    if s.touchpad:
        depth = s.pad_depth * s.depth
        pad = slab(depth, s.pad_width * s.width, 0.0007, 0.003)
        x = s.middle - s.depth / 2 + 0.04 * s.depth + depth / 2
        visuals.append(painted(placed(pad, (x, 0.0, top)), shade(s.body_color, 0.85)))
    room = (1 - s.well_width) * s.width / 2
    if s.strips and room > 0.012:
        strip = slab(0.4 * s.depth, 0.4 * room, 0.0007, 0.001)
        y = (s.width - room) / 2
        both = [placed(strip, (s.middle + 0.2 * s.depth, side * y, top)) for side in (-1, 1)]
        visuals.append(painted(merged(*both), shade(s.body_color, 0.5)))
    return visuals


def _deck(s: LaptopShape) -> trimesh.Trimesh:
    """What of the base lies behind the hinge, joined to the rest under the barrel."""
    start, end = s.barrel_radius + 0.0015, s.behind * s.width * s.aspect
    top, bottom = -s.half_gap, -s.half_gap - s.thick
    under = -s.barrel_radius - 0.0015
    block = placed(
        slab(end - start, s.width, top - bottom, s.corner, s.bevel),
        ((start + end) / 2, 0.0, bottom),
    )
    half = s.width / 2 - 1.1 * s.corner - 0.001
    lower = bottom + 0.3 * (under - bottom)
    bridge = box((-s.rear - 0.01, -half, lower), (start + 0.003, half, under))
    return merged(block, bridge)


def _ports(s: LaptopShape) -> trimesh.Trimesh:
    """Sockets at both sides, half a millimetre proud."""
    high = min(0.4 * s.thick, 0.006)
    z = -s.half_gap - 0.35 * s.thick
    half = s.width / 2
    pieces = []
    for x in (0.12, 0.2, 0.28):
        place = s.middle + x * s.depth
        pieces.append(
            box((place, half - 0.004, z - high / 2), (place + 0.012, half + 5e-4, z + high / 2))
        )
    return merged(*pieces, *(mirrored(piece, 1) for piece in pieces))


def _feet(s: LaptopShape) -> trimesh.Trimesh:
    """Four discs under the base, all reaching to one plane."""
    bottom = -s.half_gap - s.thick
    top = bottom + 0.6 * s.thick
    disc = cylinder(0.03 * s.width, bottom - s.foot_height, top, 0.0004)
    x, y = 0.36 * s.depth, 0.38 * s.width
    return merged(*(placed(disc, (s.middle + i * x, j * y, 0.0)) for i in (-1, 1) for j in (-1, 1)))


def _hinge(s: LaptopShape) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Base's lugs at both ends and the lid's barrel between them, each with its neck."""
    half = s.barrel_length * s.width / 2
    lug = min(0.06 * s.width, 0.47 * s.width - half)
    inner = -s.rear - s.corner_radius - 0.004
    barrel = cylinder(s.barrel_radius, -half, half, 0.0005)
    barrel = placed(barrel, rotation=ALONG_Y)
    rise = s.half_gap + min(0.8 * s.lid_thickness, s.barrel_radius)
    neck = box((inner, -half, s.half_gap + 2e-4), (0.0, half, rise))
    low, high = half + 0.001, half + lug
    end = placed(cylinder(s.barrel_radius, low, high, 0.0005), rotation=ALONG_Y)
    drop = s.half_gap + min(0.8 * s.thick, s.barrel_radius)
    root = box((inner, low, -drop), (0.0, high, -s.half_gap - 2e-4))
    lugs = merged(end, root)
    return merged(lugs, mirrored(lugs, 1)), merged(barrel, neck)


def _base(s: LaptopShape) -> list[Visual]:
    visuals = [painted(_base_body(s), s.body_color), *_touch_parts(s)]
    if s.behind > 0:
        visuals.append(painted(_deck(s), shade(s.body_color, 0.9)))
    if s.ports:
        visuals.append(painted(_ports(s), BLACK))
    if s.keys:
        visuals.append(painted(_keys(s), s.key_color))
    elif not s.plain:
        depth, width, centre = _well(s)
        touch = placed(
            slab(depth, width, 0.0006, 0.004), (s.middle + centre[0], 0.0, -s.half_gap - 0.0004)
        )
        visuals.append(painted(touch, s.key_color))
    if s.feet:
        visuals.append(painted(_feet(s), BLACK))
    if s.barrelled:
        visuals.append(painted(_hinge(s)[0], shade(s.body_color, 0.7)))
    return visuals


def _lid(s: LaptopShape) -> list[Visual]:
    """The lid over the base at rest; its lower face carries the display."""
    depth, width = s.depth * s.lid_ratio, s.width * s.lid_ratio
    middle = -s.rear - depth / 2
    # built face up, then turned: local +x is the object's, local z points down
    rings = rounded_sides(depth, width, s.corner_radius, s.bevel, (-s.lid_thickness, 0.0))
    side, chin = s.border * width, s.chin * depth
    size = (depth - chin - side, width - 2 * side)
    centre = ((side - chin) / 2, 0.0)
    recess = 0.2 * s.lid_thickness
    if s.bezel:
        rings += [at(rectangle(*size, 0.002, centre), z) for z in (0.0, -recess)]
    place = (middle, 0.0, s.half_gap)
    visuals = [painted(placed(loft(rings), place, DOWN), s.body_color)]
    level = -recess - 0.0002 if s.bezel else -0.0003
    if not s.plain:
        glass = placed(slab(size[0] - 4e-4, size[1] - 4e-4, 0.0005, 0.002), (*centre, level))
        visuals.append(painted(placed(glass, place, DOWN), s.display_color))
    if s.webcam:
        x = -depth / 2 + side / 2
        dot = placed(cylinder(0.3 * side, -0.0005, 0.0003), (x, 0.0, 0.0))
        visuals.append(painted(placed(dot, place, DOWN), BLACK))
    if s.logo:
        mark = placed(
            cylinder(0.07 * depth, -0.0002, 0.0005), (middle, 0.0, s.half_gap + s.lid_thickness)
        )
        visuals.append(painted(mark, shade(s.body_color, 1.3)))
    if s.barrelled:
        visuals.append(painted(_hinge(s)[1], shade(s.body_color, 0.7)))
    return visuals


def build(s: LaptopShape) -> Design:
    """Base and screen; the lid's free edge rises from -x by a turn about +y."""
    pivot, axis = (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    most = 2.0 * s.half_gap / s.width
    lean = min(max(s.lean, -most), most)
    if s.trait == OTHER_SIDE:
        pivot, axis = (s.middle, s.width / 2 + s.half_gap, 0.0), (-1.0, 0.0, 0.0)
    elif lean:
        axis = (sin(lean), cos(lean), 0.0)
    return Design(parts=(_base(s), _lid(s)), pivot=[pivot], axis=[axis], upper=[s.travel * TRAVEL])


RECIPE = Recipe(
    shape=LaptopShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "base_thickness"),
    rearranged=(OTHER_SIDE, SET_BACK),
    symmetric=SYMMETRIC,
)
