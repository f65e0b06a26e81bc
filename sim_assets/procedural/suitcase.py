# SPDX-License-Identifier: MIT
"""Suitcases lying flat: two hollow shells on a hinge along y at the rear (+x), handle at -x.

The hinge's axis lies in the plane z = 0 in which the shells meet while the object is built.

Free parameters of suitcases and the measures that follow from them.
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
    DOWN,
    at,
    bezier,
    box,
    cylinder,
    loft,
    merged,
    mirrored,
    placed,
    rectangle,
    slab,
    superellipse,
    sweep,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SuitcaseShape:
    """Free parameters; lengths in metres, ratios where named so."""

    length: float = span(0.46, 0.74, 0.38, 0.84)
    """Along y."""
    aspect: float = span(0.62, 0.78, 0.54, 0.86)
    """Depth (x) over length."""
    thickness: float = span(0.16, 0.28, 0.12, 0.34)
    """Of the closed case."""
    split: float = span(0.42, 0.66, 0.34, 0.74)
    """Share of the base shell."""
    corner_radius: float = span(0.025, 0.075, 0.012, 0.1)
    edge: float = span(0.012, 0.045, 0.006, 0.06)
    """Rounding between the shells' faces and sides."""
    wall: float = span(0.003, 0.006, 0.0025, 0.008)
    half_gap: float = span(0.0006, 0.0012, 0.0005, 0.0015)
    """Between either shell and the plane of the hinge."""
    band: float = span(0.006, 0.014, 0.004, 0.02)
    """Height of the strip along either shell's mouth."""
    handle_length: float = span(0.16, 0.26, 0.12, 0.34)
    """Over the length."""
    handle_height: float = span(0.024, 0.04, 0.018, 0.055)
    handle_radius: float = span(0.006, 0.01, 0.0045, 0.013)
    wheel_radius: float = span(0.018, 0.03, 0.013, 0.038)
    latch_width: float = span(0.035, 0.06, 0.025, 0.08)
    latch_spread: float = span(0.24, 0.34, 0.18, 0.4)
    """Distance of the latches from the middle over the length."""
    rib_height: float = span(0.0025, 0.005, 0.0015, 0.007)
    barrel_radius: float = span(0.004, 0.007, 0.003, 0.009)
    travel: float = span(0.8, 1.0, 0.7, 1.0)
    handle: bool = chance(0.8)
    wheels: bool = chance(0.55)
    latches: bool = chance(0.6)
    ribs: bool = chance(0.6)
    guards: bool = chance(0.35)
    """Plates over the corners."""
    straps: bool = chance(0.4)
    """Two crossed straps in the base."""
    divider: bool = chance(0.5)
    """A flat panel closing the lid's inside."""
    barrels: bool = chance(0.5)
    edging: bool = chance(0.6)
    feet: bool = chance(0.3)
    rib_count: int = choice(4, 5, 6, 8)
    shell_color: tuple[float, float, float] = tint(
        (0.15, 0.2, 0.35), (0.6, 0.12, 0.12), (0.25, 0.25, 0.27), (0.55, 0.4, 0.25),
        (0.75, 0.75, 0.72), (0.2, 0.4, 0.35),
    )  # fmt: skip
    lining_color: tuple[float, float, float] = tint(
        (0.5, 0.48, 0.44), (0.3, 0.3, 0.32), (0.75, 0.7, 0.6)
    )

    @property
    def depth(self) -> float:
        """Along x."""
        return self.length * self.aspect

    @property
    def rear(self) -> float:
        """Distance of the shells' rear in front of the hinge axis."""
        return self.barrel_radius + 0.0012 if self.barrels else 0.0012

    @property
    def middle(self) -> float:
        """The x of the shells' middle."""
        return -self.rear - self.depth / 2

    @property
    def front(self) -> float:
        """The x of the shells' front."""
        return -self.rear - self.depth

    @property
    def heights(self) -> tuple[float, float]:
        """Of the base and of the lid."""
        return self.split * self.thickness, (1 - self.split) * self.thickness


HELD_OUT: HeldOut = (
    {"wheels": True, "ribs": False, "guards": True},
    {"handle": False, "latches": True},
    {"straps": True, "divider": True, "barrels": False},
)
SYMMETRIC = {
    "split": 0.5, "handle": False, "wheels": False, "latches": False, "straps": False,
    "divider": False, "feet": False, "barrels": False,
}  # fmt: skip


BLACK: RGB = (0.08, 0.08, 0.09)
METAL: RGB = (0.66, 0.66, 0.68)
TRAVEL = radians(110.0)


def _shell(s: SuitcaseShape, height: float) -> trimesh.Trimesh:
    """A hollow half standing on its face, mouth at z = 0, face at z = -height."""
    edge = min(s.edge, 0.6 * height, 0.9 * s.corner_radius)
    angle = np.linspace(0.0, pi / 2, 5)
    profile = [(edge * (1 - np.sin(a)), -height + edge * (1 - np.cos(a))) for a in angle]
    profile.append((0.0, 0.0))
    inner = [(s.wall, 0.0), (s.wall, -height + edge)]
    inner += [
        (s.wall + (edge - s.wall) * (1 - np.cos(a)), -height + edge - (edge - s.wall) * np.sin(a))
        for a in angle[1:]
    ]
    rings = [
        at(rectangle(s.depth - 2 * i, s.length - 2 * i, s.corner_radius - i, segments=6), z)
        for i, z in profile + inner
    ]
    return loft(rings)


def _edging(s: SuitcaseShape, height: float) -> trimesh.Trimesh:
    """A strip about the mouth, 1 mm proud of the shell."""
    band = min(s.band, 0.4 * height)
    loops = [
        at(rectangle(s.depth + 2 * i, s.length + 2 * i, s.corner_radius + i, segments=6), z)
        for i, z in ((-5e-4, -band), (0.001, -band), (0.001, -2e-4), (-5e-4, -2e-4))
    ]
    return loft(loops, ring=True)


def _ribs(s: SuitcaseShape, height: float) -> trimesh.Trimesh:
    """Raised strips over the face, along x."""
    edge = min(s.edge, 0.6 * height, 0.9 * s.corner_radius)
    usable = s.length - 2 * max(edge, s.corner_radius) - 0.02
    width = 0.45 * usable / s.rib_count
    rib = slab(s.depth - 2 * edge - 0.01, width, s.rib_height + 0.001, 0.004, 0.45 * s.rib_height)
    places = np.linspace(-0.5, 0.5, s.rib_count) * (usable - width)
    lift = -height - s.rib_height
    return merged(*(placed(rib, (0.0, y, lift)) for y in places))


def _guards(s: SuitcaseShape, height: float) -> trimesh.Trimesh:
    """Plates about the four upright corners near the mouth, 1.2 mm proud."""
    high = -s.band - 0.002
    low = min(-0.6 * height, high - 0.01)
    corner = rectangle(s.depth, s.length, s.corner_radius, segments=6)[:7]
    middle = np.array([s.depth / 2, s.length / 2]) - s.corner_radius
    outward = (corner - middle) / s.corner_radius
    tail = np.array([[0.0, -0.02], [-0.02, 0.0]])
    line = np.concatenate([corner[:1] + tail[:1], corner, corner[-1:] + tail[1:]])
    normal = np.concatenate([outward[:1], outward, outward[-1:]])
    path = np.column_stack([line + 2e-4 * normal, np.full(len(line), (low + high) / 2)])
    plate = sweep(path, rectangle(0.002, high - low, 4e-4, segments=1), (0.0, 0.0, 1.0))
    across = merged(plate, mirrored(plate, 0))
    return merged(across, mirrored(across, 1))


def _half(s: SuitcaseShape, height: float) -> list[Visual]:
    """What either shell has, mouth up at z = 0, about its own middle."""
    visuals = [painted(_shell(s, height), s.shell_color)]
    room = (s.depth - 2 * s.wall, s.length - 2 * s.wall)
    cloth = slab(room[0] - 0.05, room[1] - 0.05, 0.003, max(0.01, s.corner_radius - 0.03))
    floor = -height + s.wall - 0.001
    visuals.append(painted(placed(cloth, (0.0, 0.0, floor)), s.lining_color))
    if s.edging:
        visuals.append(painted(_edging(s, height), BLACK))
    if s.ribs:
        visuals.append(painted(_ribs(s, height), shade(s.shell_color, 0.9)))
    if s.guards:
        visuals.append(painted(_guards(s, height), METAL))
    return visuals


def _handle(s: SuitcaseShape) -> trimesh.Trimesh:
    """A carrying handle on the base's front: two feet and a bow between them."""
    half = s.handle_length * s.length / 2
    z = -s.half_gap - 0.45 * min(0.08, s.heights[0])
    path = np.array([(s.front + 0.002, -half, z), (s.front - s.handle_height, -0.8 * half, z)])
    rise = bezier(path[0], (path[1][0], -half, z), path[1], 6)
    line = np.concatenate([rise, (rise * [1.0, -1.0, 1.0])[::-1]])
    profile = superellipse(2 * s.handle_radius, 2.6 * s.handle_radius, 2.5, 12)
    foot = box((s.front - 0.006, -0.016, z - 0.012), (s.front + 0.001, 0.016, z + 0.012))
    feet = [placed(foot, (0.0, side * half, 0.0)) for side in (-1, 1)]
    return merged(sweep(line, profile, (0.0, 0.0, 1.0)), *feet)


def _latches(s: SuitcaseShape) -> trimesh.Trimesh:
    """Two latches on the base; their tongues stand 1.5 mm before the lid's front."""
    z = -s.half_gap
    plate = box(
        (s.front - 0.007, -s.latch_width / 2, z - 0.03),
        (s.front + 0.001, s.latch_width / 2, z - 0.003),
    )
    reach = min(0.018, 0.5 * s.heights[1])
    tongue = box(
        (s.front - 0.007, -0.3 * s.latch_width, z - 0.006),
        (s.front - 0.003, 0.3 * s.latch_width, reach),
    )
    latch = merged(plate, tongue)
    spread = s.latch_spread * s.length
    return merged(*(placed(latch, (0.0, side * spread, 0.0)) for side in (-1, 1)))


def _wheels(s: SuitcaseShape) -> trimesh.Trimesh:
    """Four wheels in housings at the -y end, two of them on the base's side of the case."""
    r = s.wheel_radius
    wheel = placed(cylinder(r, -0.011, 0.011, 0.003, 18), rotation=ALONG_X)
    end = -s.length / 2 - 0.55 * r
    z = -s.half_gap - s.band - r - 0.004
    housing = box((-0.016, end, z - 0.5 * r), (0.016, -s.length / 2 + 0.002, z + 0.5 * r))
    place = 0.5 * s.depth - max(s.corner_radius, 0.03) - 0.02
    pieces = [
        placed(k, (s.middle + i * place, d, h))
        for i in (-1, 1)
        for k, d, h in ((wheel, end, z), (housing, 0.0, 0.0))
    ]
    return merged(*pieces)


def _straps(s: SuitcaseShape) -> trimesh.Trimesh:
    """Two bands over what would be packed, with a buckle."""
    height = s.heights[0]
    z = -s.half_gap - 0.35 * height
    reach = s.depth / 2 - s.wall + 5e-4
    band = box((-reach, -0.015, z), (reach, 0.015, z + 0.002))
    buckle = box((-0.02, -0.022, z - 0.002), (0.02, 0.022, z + 0.006))
    return merged(
        *(
            placed(k, (s.middle, side * 0.2 * s.length, 0.0))
            for side in (-1, 1)
            for k in (band, buckle)
        )
    )


def _hinges(s: SuitcaseShape) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Three barrels at the rear: the base's outer knuckles, the lid's inner ones, with leaves."""
    r = s.barrel_radius
    base, lid = [], []
    for y in np.array([-0.3, 0.0, 0.3]) * s.length:
        for owner, low, high, side in ((base, -0.03, -0.0006, -1), (lid, 0.0006, 0.03, 1)):
            knuckle = placed(cylinder(r, low, high, 5e-4, 12), (0.0, y, 0.0), ALONG_Y)
            span_z = sorted((side * (s.half_gap + 3e-4), side * (s.half_gap + 0.02)))
            leaf = box(
                (-s.rear - 0.001, y + low, span_z[0]), (-s.rear + 0.0009, y + high, span_z[1])
            )
            tops = sorted((side * (s.half_gap + 3e-4), side * 0.8 * r))
            neck = box((-s.rear - 0.001, y + low, tops[0]), (0.0, y + high, tops[1]))
            owner += [knuckle, leaf, neck]
    return merged(*base), merged(*lid)


def _base(s: SuitcaseShape) -> list[Visual]:
    place = (s.middle, 0.0, -s.half_gap)
    visuals = [Visual(mesh=placed(v.mesh, place), color=v.color) for v in _half(s, s.heights[0])]
    if s.handle:
        visuals.append(painted(_handle(s), BLACK))
    if s.latches:
        visuals.append(painted(_latches(s), METAL))
    if s.wheels:
        visuals.append(painted(_wheels(s), BLACK))
    if s.straps:
        visuals.append(painted(_straps(s), shade(s.lining_color, 0.6)))
    if s.feet:
        foot = cylinder(0.012, -0.007, 0.002, 0.002, 14)
        z = -s.half_gap - s.heights[0]
        x, y = 0.5 * s.depth - 0.075, 0.5 * s.length - 0.075
        feet = [placed(foot, (s.middle + i * x, j * y, z)) for i in (-1, 1) for j in (-1, 1)]
        visuals.append(painted(merged(*feet), BLACK))
    if s.barrels:
        visuals.append(painted(_hinges(s)[0], METAL))
    return visuals


def _lid(s: SuitcaseShape) -> list[Visual]:
    place = (s.middle, 0.0, s.half_gap)
    half = _half(s, s.heights[1])
    if s.divider:
        room = (s.depth - 2 * s.wall + 0.001, s.length - 2 * s.wall + 0.001)
        panel = slab(*room, 0.003, s.corner_radius - s.wall)
        half.append(painted(placed(panel, (0.0, 0.0, -0.012)), shade(s.lining_color, 0.8)))
    visuals = [Visual(mesh=placed(v.mesh, place, DOWN), color=v.color) for v in half]
    if s.barrels:
        visuals.append(painted(_hinges(s)[1], METAL))
    return visuals


def build(s: SuitcaseShape) -> Design:
    """Base and lid; the lid's free edge rises from -x by a turn about +y."""
    return Design(
        parts=(_base(s), _lid(s)),
        pivot=[(0.0, 0.0, 0.0)],
        axis=[(0.0, 1.0, 0.0)],
        upper=[s.travel * TRAVEL],
    )


RECIPE = Recipe(shape=SuitcaseShape, build=build, held_out=HELD_OUT, symmetric=SYMMETRIC)
