# SPDX-License-Identifier: MIT
"""Scissors lying flat: rings towards the user (-x), tips towards +x, axis along z.

The first half lies above the plane z = 0, its blade at y > 0 and its ring at y < 0; the second is
the first after half a turn about x. Before the pivot each half keeps to its own side of the x
axis, behind it to its own side of the plane z = 0, so that they touch nowhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians

import numpy as np
import trimesh

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.parameters import (
    OTHER_SIDE,
    SET_BACK,
    HeldOut,
    chance,
    ratio,
    span,
    tint,
)
from sim_assets.procedural.shapes import (
    cylinder,
    ellipsoid,
    lathe,
    loft,
    merged,
    mirrored,
    placed,
    rectangle,
    superellipse,
    sweep,
)

STEEL: RGB = (0.72, 0.73, 0.75)
TRAVEL = radians(60.0)
LONGER = "one handle longer"
TURN_X = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class ScissorsShape:
    """Free parameters; lengths in metres, ratios where named so."""

    blade: float = ratio(0.045, 0.15, 0.045, 0.24)
    """Length of the blades beyond the pivot."""
    blade_width: float = span(0.1, 0.2, 0.08, 0.26)
    """At the pivot, over the blade's length."""
    overlap: float = span(0.08, 0.34, 0.05, 0.42)
    """Of the closed cutting edges beyond the x axis over the blade's width."""
    thickness: float = span(0.0014, 0.0036, 0.0011, 0.0045)
    gap: float = span(0.0003, 0.0006, 0.0002, 0.0008)
    """Between the halves."""
    tip_width: float = span(0.05, 0.42, 0.03, 0.6)
    """Over the width at the pivot."""
    belly: float = span(0.7, 2.0, 0.55, 2.8)
    """Exponent of the spine's taper: below 1 slender, above 1 full."""
    shank: float = ratio(0.012, 0.065, 0.008, 0.11)
    """From the pivot to the ring."""
    ring_length: float = span(0.034, 0.062, 0.028, 0.074)
    ring_width: float = span(0.024, 0.042, 0.02, 0.05)
    """Outer width of the ring."""
    ring_power: float = span(1.9, 3.2, 1.7, 3.8)
    ring_radius: float = span(0.0025, 0.006, 0.002, 0.0075)
    """Half the thickness of the ring's section."""
    ring_height: float = span(0.8, 1.8, 0.7, 2.2)
    """Height over width of the ring's section."""
    splay: float = span(-0.15, 0.4, -0.25, 0.55)
    """Turn of the rings outwards, rad."""
    screw_radius: float = span(0.28, 0.42, 0.22, 0.48)
    """Over the blade's width."""
    stagger: float = span(-0.7, 0.3, -0.85, 0.4)
    """Of the second ring behind the first, over its length."""
    narrow: float = span(0.68, 1.5, 0.6, 1.7)
    """Width of the second ring over the first's, where they are of one size."""
    thin: float = span(0.5, 1.0, 0.42, 1.15)
    """Height of the second ring's section over the first's."""
    enlarged: float = span(1.15, 1.6, 1.1, 1.75)
    """Length of the larger ring over the smaller one's, where they differ."""
    travel: float = span(0.65, 1.0, 0.5, 1.0)
    sleeve: bool = chance(0.65)
    """Plastic grips around the shanks."""
    screw: bool = chance(0.7)
    big_ring: bool = chance(0.45)
    tang: bool = chance(0.3)
    """A finger rest behind the second ring."""
    pads: bool = chance(0.35)
    """A soft lining in the rings."""
    fuller: bool = chance(0.35)
    """A raised strip along the blades."""
    stop: bool = chance(0.4)
    """A bump inside either ring's root."""
    grip_color: tuple[float, float, float] = tint(
        (0.85, 0.2, 0.1), (0.1, 0.1, 0.11), (0.1, 0.35, 0.7), (0.2, 0.55, 0.25), (0.9, 0.55, 0.1)
    )
    metal_grip: bool = chance(0.25)
    """Rings of the blades' steel."""
    nut: bool = chance(0.3)
    """A raised nut on the second half's screw."""
    trait: str = ""

    @property
    def reach(self) -> float:
        """From the pivot to the ring, clear of the blade's root."""
        least = 0.9 * self.width + 0.004
        if self.trait == SET_BACK:
            return max(self.shank, least) + 0.7 * self.blade
        return max(self.shank, least)

    @property
    def near(self) -> float:
        """The x behind which the other half's ring may lie: there shanks keep off the x axis."""
        ahead = min(self.stagger, 0.0) * self.ring_length
        turned = 0.6 * self.enlarged * self.ring_width * abs(np.sin(self.splay))
        return 0.006 + turned - max(self.reach + ahead, 0.9 * self.width + 0.004)

    @property
    def width(self) -> float:
        """Of a blade at the pivot."""
        return self.blade_width * self.blade

    @property
    def section(self) -> float:
        """Half the thickness of the rings' section, thin enough for a finger to pass."""
        return min(self.ring_radius, 0.15 * self.ring_width)


HELD_OUT: HeldOut = (
    {"sleeve": True, "metal_grip": True},
    {"big_ring": False, "tang": True},
    {"screw": False, "fuller": True},
)
SYMMETRIC = {
    "big_ring": False, "tang": False, "nut": False, "stagger": 0.0, "narrow": 1.0, "thin": 1.0,
}  # fmt: skip


def _ring_outline(s: ScissorsShape, factor: tuple[float, float]) -> np.ndarray:
    """The centre line of a ring (N, 2), its point nearest to the pivot at the origin."""
    length = factor[0] * s.ring_length - 2 * s.section
    width = (0.4 + 0.6 * factor[0]) * factor[1] * s.ring_width - 2 * s.section
    loop = superellipse(length, width, s.ring_power, 36)
    loop[:, 1] *= 1 - 0.25 * loop[:, 0] / length  # wider away from the pivot
    return loop - [length / 2, 0.0]


def _ring_path(s: ScissorsShape, factor: tuple[float, float], longer: float) -> np.ndarray:
    """The ring in place at y < 0: its inner side 1 mm clear of the x axis plane."""
    loop = _ring_outline(s, factor)
    cosine, sine = np.cos(s.splay), np.sin(s.splay)
    loop = loop @ np.array([[cosine, sine], [-sine, cosine]])
    loop[:, 0] -= max(s.reach + longer, 0.9 * s.width + 0.004)
    loop[:, 1] -= loop[:, 1].max() + s.section + 0.001
    return np.column_stack([loop, np.zeros(len(loop))])


def _root(path: np.ndarray) -> np.ndarray:
    """The point of a ring nearest to the pivot."""
    return path[np.linalg.norm(path, axis=1).argmin()]


def _spine(s: ScissorsShape, root: np.ndarray) -> list[tuple[float, float, float]]:
    """Sections (x, lower y, upper y) from the ring's root over the pivot to the tip."""
    w = s.width
    sections = []
    for t in np.linspace(0.0, 1.0, 8)[:-1]:
        smooth = (1 - t) ** 2 * (1 + 2 * t)
        x, middle, half = root[0] * (1 - t), root[1] * smooth, w * (0.3 + 0.2 * t)
        if x < s.near:
            half = min(half, max(-middle, 0.002))
        sections.append((x, middle - half, middle + half))
    tip = s.tip_width * w
    for t in np.linspace(0.0, 1.0, 12):
        low = -0.5 * w + (0.5 - s.overlap) * w * min(1.0, 5 * t)
        low += s.overlap * w * t
        spine = tip * 0.6 + (0.5 * w - 0.6 * tip) * (1 - t ** (1 + s.belly))
        rounded = 1.0 if t < 0.99 else 0.45
        sections.append((s.blade * t, low, max(spine * rounded, low + 0.0012)))
    return sections


def _blade(s: ScissorsShape, root: np.ndarray) -> trimesh.Trimesh:
    """Shank and blade in one, lower face at z = gap / 2, ground towards the cutting edge."""
    low, high = s.gap / 2, s.gap / 2 + s.thickness
    rings = []
    for x, edge, back in _spine(s, root):
        wide = back - edge
        ground = 0.3 if x > 0.12 * s.blade else 0.9
        y = np.array([edge, edge, edge + 0.4 * wide, back - 0.1 * wide, back, back])
        z = np.array([low, low + ground * s.thickness, high, high, high - 0.15 * s.thickness, low])
        rings.append(np.column_stack([np.full(6, x), y, z])[::-1])
    return loft(rings)


def _strip(s: ScissorsShape) -> trimesh.Trimesh:
    """A raised strip along the blade near its spine."""
    stations = np.linspace(0.12, 0.7, 6) * s.blade
    sections = {x: (low, high) for x, low, high in _spine(s, np.zeros(3))[7:]}
    keys = np.array(sorted(sections))
    spine = np.interp(stations, keys, [sections[x][1] for x in keys])
    edge = np.interp(stations, keys, [sections[x][0] for x in keys])
    y = edge + 0.68 * (spine - edge)
    path = np.column_stack([stations, y, np.full(6, s.gap / 2 + s.thickness)])
    profile = rectangle(1.0, 0.0012, 0.0002, segments=1)
    return sweep(path, [profile * [0.16 * k, 1.0] for k in spine - edge], (0.0, 0.0, 1.0))


def _grip(s: ScissorsShape, path: np.ndarray) -> list[trimesh.Trimesh]:
    """The ring, and a sleeve around the shank's end."""
    section = superellipse(2 * s.section, 2 * s.section * s.ring_height, 2.4, 12)
    pieces = [sweep(path, section, (0.0, 0.0, 1.0), closed=True)]
    root = _root(path)
    if s.sleeve:
        t = np.linspace(0.0, 0.55, 7)
        smooth = (1 - t) ** 2 * (1 + 2 * t)
        line = np.column_stack(
            [root[0] * (1 - t), root[1] * smooth, 0.5 * s.gap + 0.5 * s.thickness + 0 * t]
        )
        wide = s.width * (0.66 + 0.3 * t) + 0.0016
        wide = np.where(
            line[:, 0] < s.near, np.minimum(wide, np.maximum(-2 * line[:, 1], 0.005)), wide
        )
        tall = s.thickness + 0.003
        # above the plane z = 0 beside the other half's shank, as thick as the ring at its root
        sizes = [(w, tall) for w in wide]
        line[:, 2] = 1e-4 + tall / 2
        profile = superellipse(1.0, 1.0, 4.0, 12)
        pieces.append(sweep(line, [profile * size for size in sizes], (0.0, 0.0, 1.0)))
    if s.stop:
        bump = ellipsoid((0.008, 0.004, 2 * s.section), 10)
        inner = root - np.array([0.25 * s.ring_length, 0.0, 0.0])
        near = path[np.linalg.norm(path - inner, axis=1).argmin()]
        pieces.append(placed(bump, near))
    return pieces


def _finger_rest(path: np.ndarray) -> trimesh.Trimesh:
    """A tang behind a ring."""
    end = path[np.argmin(path[:, 0])]
    step = np.linspace(0.0, 1.0, 6)[:, None]
    line = end + step * np.array([-0.016, -0.004, 0.0]) + step**2 * np.array([0, -0.006, 0])
    return sweep(line, superellipse(0.006, 0.006, 2.0, 10), (0.0, 0.0, 1.0))


def _screw(s: ScissorsShape, *, raised: bool) -> Visual:
    """What holds the halves together: a nut, a screw's head, or a rivet."""
    z = s.gap / 2 + s.thickness
    if raised:
        return painted(cylinder(0.36 * s.width, z - 3e-4, z + 0.003, 3e-4, 6), shade(STEEL, 0.6))
    if s.screw:
        r = s.screw_radius * s.width
        head = lathe([(r, z - 2e-4), (r, z + 0.0007), (0.7 * r, z + 0.0013)], 18)
        return painted(head, shade(STEEL, 0.7))
    rivet = cylinder(0.2 * s.width, s.gap / 2 + 2e-4, z + 4e-4, 2e-4, 14)
    return painted(rivet, shade(STEEL, 0.8))


def _half(s: ScissorsShape, *, second: bool) -> list[Visual]:
    """The first half, or what becomes the second after half a turn about x."""
    large = second and s.big_ring
    if second:
        s = replace(s, ring_height=s.thin * s.ring_height)
    longer = (0.9 if s.trait == LONGER else s.stagger) * s.ring_length if second else 0.0
    wide = s.narrow if second and not large else 1.0
    path = _ring_path(s, (s.enlarged if large else 1.0, wide), longer)
    color = STEEL if s.metal_grip else s.grip_color
    steel = [_blade(s, _root(path))]
    if s.fuller:
        steel.append(_strip(s))
    grips = _grip(s, path)
    if s.tang and second:
        grips.append(_finger_rest(path))
    visuals = [painted(merged(*steel), STEEL), painted(merged(*grips), color)]
    visuals.append(_screw(s, raised=s.nut and second))
    if s.pads:
        flat = path - path.mean(0)
        scale = 1 - s.section / np.linalg.norm(flat, axis=1, keepdims=True)
        section = superellipse(1.1 * s.section, 1.3 * s.section, 2.0, 8)
        pad = sweep(path.mean(0) + flat * scale, section, (0.0, 0.0, 1.0), closed=True)
        visuals.append(painted(pad, (0.2, 0.2, 0.22)))
    return visuals


def build(s: ScissorsShape) -> Design:
    """Two halves; the second one's blade moves towards -y by a turn about -z."""
    first = _half(s, second=False)
    second = [
        Visual(mesh=placed(v.mesh, rotation=TURN_X), color=v.color) for v in _half(s, second=True)
    ]
    if s.trait == OTHER_SIDE:  # for the left hand: mirrored, and the halves change names
        first, second = (
            [Visual(mesh=mirrored(v.mesh, 1), color=v.color) for v in half]
            for half in (second, first)
        )
    return Design(
        parts=(first, second),
        pivot=[(0.0, 0.0, 0.0)],
        axis=[(0.0, 0.0, -1.0)],
        upper=[s.travel * TRAVEL],
    )


RECIPE = Recipe(
    shape=ScissorsShape,
    build=build,
    held_out=HELD_OUT,
    main=("blade", "shank"),
    rearranged=(OTHER_SIDE, LONGER, SET_BACK),
    symmetric=SYMMETRIC,
)
