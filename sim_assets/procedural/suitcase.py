# SPDX-License-Identifier: MIT
"""Suitcases lying flat: two hollow shells on a hinge along y at the rear (+x), handle at -x.

The hinge's axis lies in the plane z = 0 in which the shells meet while the object is built.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, pi, radians, sin

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.parameters import (
    OTHER_SIDE,
    PROPORTIONS,
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

    length: float = span(0.34, 0.78, 0.28, 0.9)
    """Along y."""
    aspect: float = ratio(0.5, 1.0, 0.34, 1.45)
    """Depth (x) over length."""
    flat: float = ratio(0.2, 0.6, 0.13, 0.9)
    """Thickness of the closed case over its length."""
    split: float = span(0.36, 0.8, 0.28, 0.87)
    """Share of the base shell."""
    corner_radius: float = span(0.015, 0.085, 0.008, 0.11)
    edge: float = span(0.008, 0.05, 0.005, 0.065)
    """Rounding between the shells' faces and sides."""
    wall: float = span(0.003, 0.006, 0.0025, 0.008)
    lean: float = span(-0.006, 0.006, -0.01, 0.01)
    """Of the axis, rad: lids hang a little askew."""
    half_gap: float = span(0.0006, 0.0012, 0.0005, 0.0015)
    """Between either shell and the plane of the hinge."""
    band: float = span(0.006, 0.014, 0.004, 0.02)
    """Height of the strip along either shell's mouth."""
    handle_length: float = span(0.14, 0.34, 0.1, 0.44)
    """Over the length."""
    handle_height: float = span(0.022, 0.055, 0.018, 0.075)
    handle_radius: float = span(0.006, 0.01, 0.0045, 0.013)
    wheel_radius: float = span(0.015, 0.036, 0.012, 0.046)
    rod_width: float = span(0.25, 0.5, 0.2, 0.6)
    """Of a pull-out handle at the end over the depth."""
    rod_height: float = span(0.012, 0.12, 0.008, 0.2)
    """How far it is pulled out, m."""
    pocket: float = span(0.4, 0.75, 0.3, 0.85)
    """Length of a pocket on the lid over the case's."""
    latch_width: float = span(0.035, 0.06, 0.025, 0.08)
    latch_spread: float = span(0.24, 0.34, 0.18, 0.4)
    """Distance of the latches from the middle over the length."""
    rib_height: float = span(0.0025, 0.005, 0.0015, 0.007)
    barrel_radius: float = span(0.004, 0.007, 0.003, 0.009)
    travel: float = span(0.7, 1.0, 0.6, 1.0)
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
    rods: bool = chance(0.4)
    """A pull-out handle at the +y end."""
    end_handle: bool = chance(0.3)
    pocketed: bool = chance(0.35)
    bands: bool = chance(0.25)
    """Two leather bands about either shell."""
    rib_count: int = choice(4, 5, 6, 8)
    shell_color: tuple[float, float, float] = tint(
        (0.15, 0.2, 0.35), (0.6, 0.12, 0.12), (0.25, 0.25, 0.27), (0.55, 0.4, 0.25),
        (0.75, 0.75, 0.72), (0.2, 0.4, 0.35),
    )  # fmt: skip
    lining_color: tuple[float, float, float] = tint(
        (0.5, 0.48, 0.44), (0.3, 0.3, 0.32), (0.75, 0.7, 0.6)
    )
    trait: str = ""

    @property
    def thickness(self) -> float:
        """Of the closed case."""
        return self.length * self.flat

    @property
    def hinged(self) -> bool:
        """Whether the hinge is seen."""
        return self.barrels and self.trait in ("", PROPORTIONS)

    @property
    def depth(self) -> float:
        """Along x."""
        return self.length * self.aspect

    @property
    def rear(self) -> float:
        """Distance of the shells' rear in front of the hinge axis."""
        if self.trait == SET_BACK:  # the lid stays above what lies behind the axis
            return 0.5 * self.heights[1] + 0.004
        return self.barrel_radius + 0.0012 if self.hinged else 0.0012

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
    "divider": False, "feet": False, "barrels": False, "rods": False, "end_handle": False,
    "pocketed": False, "lean": 0.0,
}  # fmt: skip


BLACK: RGB = (0.08, 0.08, 0.09)
METAL: RGB = (0.66, 0.66, 0.68)
TRAVEL = radians(110.0)


def _edge(s: SuitcaseShape, height: float) -> float:
    """Rounding of a shell of this height."""
    return min(s.edge, 0.6 * height, 0.9 * s.corner_radius)


def _shell(s: SuitcaseShape, height: float) -> trimesh.Trimesh:
    """A hollow half standing on its face, mouth at z = 0, face at z = -height."""
    edge = _edge(s, height)
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
    edge = _edge(s, height)
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
    if s.bands:
        visuals.append(painted(_bands(s, height), shade(s.shell_color, 0.5)))
    return visuals


def _bands(s: SuitcaseShape, height: float) -> trimesh.Trimesh:
    """Two strips over the face and down the sides, along x, 1.5 mm proud."""
    half, edge = s.depth / 2, _edge(s, height)
    angle = np.linspace(0.0, pi / 2, 5)
    corner = [(half - edge * (1 - np.sin(a)), -height + edge * (1 - np.cos(a))) for a in angle]
    right = [(half, -0.55 * height), *corner[::-1]]
    line = np.array([*right, *((-x, z) for x, z in right[::-1])])
    path = np.column_stack([line[:, 0], np.zeros(len(line)), line[:, 1]])
    strip = sweep(path, rectangle(0.004, 0.028, 5e-4, segments=1), (0.0, 1.0, 0.0))
    return merged(*(placed(strip, (0.0, side * 0.27 * s.length, 0.0)) for side in (-1, 1)))


def _handle(s: SuitcaseShape) -> trimesh.Trimesh:
    """A carrying handle on the base's front: two feet and a bow between them."""
    half = s.handle_length * s.length / 2
    z = -s.half_gap - 0.45 * min(0.08, s.heights[0])
    path = np.array([(s.front + 0.002, -half, z), (s.front - s.handle_height, -0.8 * half, z)])
    rise = bezier(path[0], (path[1][0], -half, z), path[1], 6)
    line = np.concatenate([rise, (rise * [1.0, -1.0, 1.0])[::-1]])
    high = min(0.012, 0.4 * s.heights[0])
    r = min(s.handle_radius, 0.75 * high)
    profile = superellipse(2 * r, 2.6 * r, 2.5, 12)
    foot = box((s.front - 0.006, -0.016, z - high), (s.front + 0.001, 0.016, z + high))
    feet = [placed(foot, (0.0, side * half, 0.0)) for side in (-1, 1)]
    return merged(sweep(line, profile, (0.0, 0.0, 1.0)), *feet)


def _latches(s: SuitcaseShape) -> trimesh.Trimesh:
    """Two latches on the base; their tongues stand 1.5 mm before the lid's front."""
    z, wide = -s.half_gap, min(s.latch_width, 0.15 * s.length)
    plate = box(
        (s.front - 0.007, -wide / 2, z - min(0.03, 0.8 * s.heights[0])),
        (s.front + 0.001, wide / 2, z - 0.003),
    )
    reach = min(0.018, 0.5 * s.heights[1])
    tongue = box(
        (s.front - 0.007, -0.3 * wide, z - 0.006),
        (s.front - 0.003, 0.3 * wide, reach),
    )
    latch = merged(plate, tongue)
    spread = min(s.latch_spread * s.length, s.length / 2 - s.corner_radius - 0.03 - wide / 2)
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


def _rods(s: SuitcaseShape) -> trimesh.Trimesh:
    """A pull-out handle at the +y end: two rods and a grip."""
    z = -s.half_gap - 0.5 * s.heights[0]
    half, end = s.rod_width * s.depth / 2, s.length / 2
    rod = box((-0.006, end - 0.003, z - 0.006), (0.006, end + s.rod_height + 0.004, z + 0.006))
    grip = box(
        (-half - 0.012, end + s.rod_height, z - 0.011),
        (half + 0.012, end + s.rod_height + 0.022, z + 0.011),
    )
    return merged(
        placed(grip, (s.middle, 0.0, 0.0)),
        *(placed(rod, (s.middle + side * half, 0.0, 0.0)) for side in (-1, 1)),
    )


def _end_handle(s: SuitcaseShape) -> trimesh.Trimesh:
    """A strap at the -y end."""
    z = -s.half_gap - 0.4 * s.heights[0]
    half, end = min(0.09, 0.3 * s.depth), -s.length / 2
    first = (s.middle - half, end + 0.002, z)
    corner = (s.middle, end - 0.06, z)
    path = bezier(first, corner, (s.middle + half, end + 0.002, z), 11)
    return sweep(
        path, rectangle(0.006, min(0.022, 0.5 * s.heights[0]), 0.002, segments=2), (0.0, 0.0, 1.0)
    )


def _feet(s: SuitcaseShape) -> trimesh.Trimesh:
    """Four studs under the base."""
    foot = cylinder(0.012, -0.007, 0.002, 0.002, 14)
    z = -s.half_gap - s.heights[0]
    x, y = 0.5 * s.depth - 0.075, 0.5 * s.length - 0.075
    return merged(*(placed(foot, (s.middle + i * x, j * y, z)) for i in (-1, 1) for j in (-1, 1)))


def _long_base(s: SuitcaseShape) -> list[Visual]:
    """A base that goes on behind the hinge, closed there."""
    long = replace(s, aspect=1.35 * s.aspect + 0.5 * s.heights[1] / s.length)
    place = (s.front + long.depth / 2, 0.0, -s.half_gap)
    visuals = [Visual(mesh=placed(v.mesh, place), color=v.color) for v in _half(long, s.heights[0])]
    low, high = -s.rear + 0.002, s.front + long.depth - s.wall + 5e-4
    size = (high - low, s.length - 2 * s.wall + 1e-3)
    cover = slab(*size, 0.004, max(0.002, s.corner_radius - s.wall))
    place = ((low + high) / 2, 0.0, -s.half_gap - 0.0045)
    return [*visuals, painted(placed(cover, place), shade(s.shell_color, 0.9))]


def _base(s: SuitcaseShape) -> list[Visual]:
    place = (s.middle, 0.0, -s.half_gap)
    visuals = [Visual(mesh=placed(v.mesh, place), color=v.color) for v in _half(s, s.heights[0])]
    if s.trait == SET_BACK:
        visuals = _long_base(s)
    details = (
        (s.rods and s.trait != OTHER_SIDE, _rods, METAL),
        (s.end_handle, _end_handle, BLACK),
        (s.handle, _handle, BLACK),
        (s.latches, _latches, METAL),
        (s.wheels, _wheels, BLACK),
        (s.straps, _straps, shade(s.lining_color, 0.6)),
        (s.feet, _feet, BLACK),
    )
    visuals += [painted(make(s), color) for there, make, color in details if there]
    if s.hinged:
        visuals.append(painted(_hinges(s)[0], METAL))
    return visuals


def _lid(s: SuitcaseShape) -> list[Visual]:
    place = (s.middle, 0.0, s.half_gap)
    half = _half(s, s.heights[1])
    if s.divider:
        room = (s.depth - 2 * s.wall + 0.001, s.length - 2 * s.wall + 0.001)
        panel = slab(*room, 0.003, s.corner_radius - s.wall)
        half.append(painted(placed(panel, (0.0, 0.0, -0.012)), shade(s.lining_color, 0.8)))
    room = s.depth - 2 * max(_edge(s, s.heights[1]), s.corner_radius)
    if s.pocketed and room > 0.06:
        thick = min(0.25 * s.heights[1], 0.03) + 0.004
        bag = slab(0.8 * room, s.pocket * (s.length - 0.1), thick, 0.02, 0.008)
        half.append(painted(placed(bag, (0.0, 0.0, 0.004 - thick - s.heights[1])), s.lining_color))
    visuals = [Visual(mesh=placed(v.mesh, place, DOWN), color=v.color) for v in half]
    if s.hinged:
        visuals.append(painted(_hinges(s)[1], METAL))
    return visuals


def build(s: SuitcaseShape) -> Design:
    """Base and lid; the lid's free edge rises from -x by a turn about +y."""
    most = 2.0 * s.half_gap / s.length
    lean = min(max(s.lean, -most), most)
    pivot, axis = (0.0, 0.0, 0.0), (sin(lean), cos(lean), 0.0)
    if s.trait == OTHER_SIDE:
        pivot, axis = (s.middle, s.length / 2 + 0.004, 0.0), (-1.0, 0.0, 0.0)
    return Design(parts=(_base(s), _lid(s)), pivot=[pivot], axis=[axis], upper=[s.travel * TRAVEL])


RECIPE = Recipe(
    shape=SuitcaseShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "flat"),
    rearranged=(OTHER_SIDE, SET_BACK),
    symmetric=SYMMETRIC,
)
