# SPDX-License-Identifier: MIT
"""Eyeglasses: a frame with two lenses across y, two temples along +x that fold inwards.

The wearer looks towards -x, so the left temple (part 1) is at -y, the right one (part 2) at +y.
Everything is built for the right side and mirrored.

The hinge axes lean by a few degrees in the frame's plane, as on real glasses, so that one temple
passes over the other when both are folded: the height between them where they cross is the hinges'
distance times the tangent of the lean, wherever they cross.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, radians, sin

import numpy as np
import trimesh
from jaxtyping import Float

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import RGB, Design, Recipe, painted, shade
from sim_assets.procedural.parameters import (
    SET_BACK,
    HeldOut,
    chance,
    choice,
    ratio,
    span,
    tint,
)
from sim_assets.procedural.shapes import (
    box,
    cylinder,
    ellipsoid,
    loft,
    merged,
    mirrored,
    placed,
    rectangle,
    superellipse,
    sweep,
)

METAL: RGB = (0.7, 0.68, 0.62)
SHORTER = "one temple shorter"
CLEARANCE = 0.0012
"""Between the frame's end pieces and the temples."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EyeglassesShape:
    """Free parameters; lengths in metres, ratios where named so."""

    lens_width: float = span(0.038, 0.06, 0.032, 0.068)
    lens_ratio: float = ratio(0.5, 1.08, 0.34, 1.45)
    """Height over width."""
    lens_power: float = span(1.9, 4.0, 1.7, 5.5)
    """Of the outline: 2 is an ellipse, 4 nearly a rectangle."""
    lens_taper: float = span(-0.06, 0.2, -0.12, 0.28)
    """How much wider the lens is at its top."""
    lens_lift: float = span(-0.04, 0.16, -0.08, 0.24)
    """Rise of the outline towards its outer side: cat's eyes."""
    lens_bulge: float = span(0.001, 0.005, 0.0005, 0.007)
    bridge: float = span(0.012, 0.026, 0.009, 0.032)
    bridge_rise: float = span(0.0, 0.55, -0.1, 0.75)
    """Height of the bridge over half the lens's."""
    bridge_arch: float = span(0.0, 0.006, 0.0, 0.009)
    wrap: float = span(0.001, 0.012, 0.0005, 0.018)
    """How far the frame's sides lie behind its middle."""
    rim_width: float = span(0.0016, 0.0065, 0.0013, 0.008)
    rim_depth: float = span(0.0018, 0.0055, 0.0015, 0.007)
    overhang: float = span(0.002, 0.010, 0.0015, 0.014)
    """Of the hinges beyond the lenses."""
    setback: float = span(0.005, 0.03, 0.004, 0.036)
    """Of the hinges behind the lenses' outer edges."""
    hinge_rise: float = span(0.0, 0.75, -0.15, 0.85)
    temple_length: float = ratio(0.55, 1.14, 0.38, 1.3)
    """Over the distance of the hinges."""
    temple_height: float = ratio(0.003, 0.012, 0.0026, 0.014)
    """At the hinge."""
    temple_slim: float = span(0.35, 0.9, 0.3, 1.0)
    """Height further back over that at the hinge."""
    temple_thickness: float = span(0.0018, 0.004, 0.0015, 0.005)
    bow: float = ratio(0.0003, 0.006, 0.0002, 0.009)
    """Of the temples outwards."""
    inward: float = ratio(0.0005, 0.011, 0.0003, 0.014)
    """Of the temples' ends."""
    drop: float = ratio(0.0006, 0.017, 0.0004, 0.021)
    """Of the ear bends."""
    bend: float = span(0.58, 0.8, 0.5, 0.85)
    """Where the ear bend begins, over the length."""
    curl: float = span(1.2, 2.2, 1.0, 2.6)
    """Exponent of the ear bend: above 1.6 a hook, below nearly straight."""
    lean_more: float = span(1.0, 1.35, 1.0, 1.5)
    """Of the hinge axes over what lets one temple pass over the other."""
    travel: float = span(0.85, 1.0, 0.75, 1.0)
    rim: str = choice("full", "full", "half", "browline", "none")
    nose_pads: bool = chance(0.6)
    brow_bar: bool = chance(0.25)
    ear_tips: bool = chance(0.6)
    side_shields: bool = chance(0.15)
    """Panes at the frame's sides, before the hinges."""
    saddle: bool = chance(0.3)
    """A second bar under the bridge, in place of pads."""
    barrel: bool = chance(0.6)
    plates: bool = chance(0.35)
    """A small plate on the outside of either end piece."""
    left_over: bool = chance(0.5)
    """The left temple passes over the right one."""
    rim_color: tuple[float, float, float] = tint(
        (0.08, 0.08, 0.09), (0.36, 0.22, 0.12), METAL, (0.6, 0.12, 0.12), (0.15, 0.2, 0.45)
    )
    temple_color: tuple[float, float, float] = tint(
        (0.08, 0.08, 0.09), (0.36, 0.22, 0.12), METAL, (0.5, 0.5, 0.52)
    )
    lens_color: tuple[float, float, float] = tint(
        (0.75, 0.82, 0.86), (0.2, 0.2, 0.22), (0.35, 0.28, 0.2)
    )
    trait: str = ""

    @property
    def lens_height(self) -> float:
        """Along z."""
        return self.lens_width * self.lens_ratio

    @property
    def centre(self) -> float:
        """The y of a lens's middle."""
        return self.bridge / 2 + self.lens_width / 2

    @property
    def pivot(self) -> tuple[float, float, float]:
        """A point on the right hinge's axis, at the temple's inner face."""
        y = self.bridge / 2 + self.lens_width + self.overhang
        back = self.setback + (0.35 * self.lens_width if self.trait == SET_BACK else 0.0)
        return self.wrap + back, y, self.hinge_rise * self.lens_height / 2

    @property
    def length(self) -> float:
        """Of a temple, from its hinge."""
        return self.temple_length * 2 * self.pivot[1]

    @property
    def lean(self) -> float:
        """Angle of the hinge axes to z: enough for one folded temple to clear the other."""
        height = self.temple_height * (1 + self.temple_slim) / 2 + self.drop + 0.0032
        least = atan2(height, 2 * self.pivot[1])
        return (1.0 if self.left_over else -1.0) * self.lean_more * least

    @property
    def barrel_radius(self) -> float:
        """Of the visible hinge."""
        return 0.55 * self.temple_thickness if self.barrel else 0.0

    @property
    def start(self) -> float:
        """Distance from the axis at which temple and end piece begin."""
        askew = 0.4 * self.temple_height * abs(sin(self.lean))
        return self.barrel_radius + CLEARANCE / 2 + askew


HELD_OUT: HeldOut = (
    {"rim": "none", "nose_pads": True},
    {"rim": "browline", "ear_tips": False},
    {"barrel": False, "plates": True, "brow_bar": True},
)
SYMMETRIC = {
    "lens_taper": 0.0, "bridge_rise": 0.0, "bridge_arch": 0.0, "hinge_rise": 0.0, "drop": 0.0,
    "lens_lift": 0.0, "rim": "full", "nose_pads": False, "brow_bar": False, "saddle": False,
    "side_shields": False,
}  # fmt: skip


TRAVEL = radians(80.0)


def _outline(s: EyeglassesShape, grow: float = 0.0) -> Float[np.ndarray, "N 2"]:
    """A lens's outline about its middle: outwards, upwards; counter-clockwise."""
    loop = superellipse(s.lens_width + 2 * grow, s.lens_height + 2 * grow, s.lens_power, 40)
    loop[:, 0] *= 1 + s.lens_taper * loop[:, 1] / (s.lens_height / 2)
    loop[:, 1] += s.lens_lift * loop[:, 0]
    return loop


def _on_front(
    s: EyeglassesShape, flat: Float[np.ndarray, "N 2"], bulge: float = 0.0
) -> Float[np.ndarray, "N 3"]:
    """Points of the right lens's outline plane laid on the frame's curved front."""
    y = s.centre + flat[:, 0]
    x = s.wrap * (y / (2 * s.centre)) ** 2 - bulge
    return np.column_stack([x, y, flat[:, 1]])


def _edge(s: EyeglassesShape, rise: float, side: float) -> Float[np.ndarray, 3]:
    """The point of the right lens's edge at this height (over half the lens's), outer or inner."""
    points = _on_front(s, _outline(s, s.rim_width / 2))
    candidates = points[(points[:, 1] - s.centre) * side > 0]
    return candidates[np.abs(candidates[:, 2] - rise * s.lens_height / 2).argmin()]


def _lens(s: EyeglassesShape) -> trimesh.Trimesh:
    """A curved pane, bulging towards -x."""
    outline = _outline(s, 0.0003)
    half = 0.0011
    radii = (0.08, 0.35, 0.62, 0.84, 1.0)
    front = [_on_front(s, r * outline, half + s.lens_bulge * (1 - r**2)) for r in radii]
    back = [_on_front(s, r * outline, -half + s.lens_bulge * (1 - r**2)) for r in radii]
    return loft([*front, *back[::-1]])


def _rim(s: EyeglassesShape) -> list[trimesh.Trimesh]:
    """Full, along the upper half, thicker above (browline), or none."""
    path = _on_front(s, _outline(s, 0.4 * s.rim_width))
    pieces = []
    thin = rectangle(s.rim_width, s.rim_depth, 0.3 * s.rim_width, segments=2)
    upper = path[:21]
    if s.rim in ("full", "browline"):
        pieces.append(sweep(path, 0.7 * thin if s.rim == "browline" else thin, (1, 0, 0), True))
    if s.rim == "half":
        pieces.append(sweep(upper, thin, (1, 0, 0)))
    if s.rim == "browline":
        thick = rectangle(1.9 * s.rim_width, 1.25 * s.rim_depth, 0.4 * s.rim_width, segments=2)
        swell = 0.55 + 0.45 * np.sin(np.linspace(0, np.pi, 21))
        pieces.append(sweep(upper, [thick * k for k in swell], (1, 0, 0)))
    return pieces


def _bar(s: EyeglassesShape, rise: float, arch: float, width: float) -> trimesh.Trimesh:
    """A bar between the lenses' inner edges."""
    end = _edge(s, rise, -1.0)
    t = np.linspace(-1.0, 1.0, 11)
    reach = end[1] + 0.0006
    path = np.column_stack([np.full(11, end[0]), reach * t, end[2] + arch * (1 - t**2)])
    return sweep(path, superellipse(width, s.rim_depth, 2.6, 12), (1.0, 0.0, 0.0))


def _end_piece(s: EyeglassesShape) -> trimesh.Trimesh:
    """From the lens's outer edge outwards and back to the hinge."""
    x, y, z = s.pivot
    first = _edge(s, s.hinge_rise, 1.0)
    last = np.array([x - s.start - CLEARANCE / 2, y + s.temple_thickness / 2, z])
    corner = np.array([first[0], last[1], z])
    t = np.linspace(0.0, 1.0, 10)[:, None]
    path = (1 - t) ** 2 * first + 2 * t * (1 - t) * corner + t**2 * last
    profile = rectangle(s.temple_thickness, s.temple_height, 0.0006, segments=2)
    low = min(1.0, 2.2 * s.rim_width / s.temple_height)
    grow = np.linspace(low, 1.0, 10)
    return sweep(path, [profile * [1.0, k] for k in grow], (0.0, 0.0, 1.0))


def _nose_pad(s: EyeglassesShape) -> trimesh.Trimesh:
    """A pad on a wire behind the bridge."""
    root = _edge(s, -0.1, -1.0)
    place = np.array([root[0] + 0.007, root[1] - 0.0012, root[2] - 0.002])
    angle = radians(25.0)
    turn = np.array([[cos(angle), -sin(angle), 0], [sin(angle), cos(angle), 0], [0, 0, 1.0]])
    pad = placed(ellipsoid((0.0065, 0.0026, 0.0125), 12), place, turn)
    t = np.linspace(0.0, 1.0, 7)[:, None]
    corner = np.array([place[0], root[1] + 0.0015, place[2] + 0.002])
    path = (1 - t) ** 2 * root + 2 * t * (1 - t) * corner + t**2 * place
    return merged(pad, sweep(path, superellipse(0.0011, 0.0011, 2.0, 8), (0.0, 0.0, 1.0)))


def _shield(s: EyeglassesShape) -> trimesh.Trimesh:
    """A pane beside the eye, under the end piece."""
    x, y, z = s.pivot
    start = _edge(s, s.hinge_rise, 1.0)
    low = (start[0] + 0.001, y + 0.2 * s.temple_thickness, z - 0.3 * s.lens_height)
    return box(low, (x - s.start - 0.002, y + 0.2 * s.temple_thickness + 0.0012, z))


def _barrels(s: EyeglassesShape, lean: float) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """The frame's two knuckles and the temple's between them, each with its neck."""
    radius, half = s.barrel_radius, 0.48 * s.temple_height
    third = half / 3
    turn = np.array([[1, 0, 0], [0, cos(lean), sin(lean)], [0, -sin(lean), cos(lean)]])
    reach = s.start + CLEARANCE + 0.001
    frame, temple = [], []
    for k, owner in ((-1, frame), (0, temple), (1, frame)):
        low, high = (2 * k - 1) * third + 2e-4, (2 * k + 1) * third - 2e-4
        owner.append(placed(cylinder(radius, low, high, 0.0, 12), s.pivot, turn))
        ends = (0.0, reach) if k == 0 else (-reach, 0.0)
        neck = box((ends[0], 0.05 * radius, low), (ends[1], radius, high))
        owner.append(placed(neck, s.pivot))
    return merged(*frame), merged(*temple)


def _frame(s: EyeglassesShape) -> list[Visual]:
    """Lenses, rims, bridge, end pieces and what goes with them."""
    rims = [*_rim(s), _end_piece(s)]
    metal = []
    if s.nose_pads:
        metal.append(_nose_pad(s))
    if s.plates:
        x, y, z = s.pivot
        size = (0.6 * s.setback, 0.25 * s.temple_height)
        y += s.temple_thickness
        low = (x - s.start - 0.0016 - size[0], y - 3e-4, z - size[1])
        metal.append(box(low, (x - s.start - 0.0016, y + 5e-4, z + size[1])))
    bridges = [_bar(s, s.bridge_rise, s.bridge_arch, max(0.0022, 0.8 * s.rim_width))]
    if s.brow_bar:
        bridges.append(_bar(s, 0.82, 0.001, 0.0022))
    if s.saddle:
        bridges.append(_bar(s, s.bridge_rise - 0.3, s.bridge_arch, 0.0022))
    if s.side_shields:
        rims.append(_shield(s))
    lens = _lens(s)
    visuals = [
        painted(merged(*rims, *(mirrored(piece, 1) for piece in rims), *bridges), s.rim_color),
        painted(merged(lens, mirrored(lens, 1)), s.lens_color),
    ]
    if s.barrel:
        metal.append(_barrels(s, s.lean)[0])
        other = mirrored(_barrels(s, -s.lean)[0], 1)
    else:
        other = None
    mirror = [mirrored(piece, 1) for piece in (metal[:-1] if s.barrel else metal)]
    metal += mirror + ([other] if other is not None else [])
    return [*visuals, painted(merged(*metal), METAL)] if metal else visuals


def _temple(s: EyeglassesShape, lean: float, share: float = 1.0) -> list[Visual]:
    """The right temple: tapering, bowed outwards, bent down and inwards behind the ear."""
    x, y, z = s.pivot
    t = np.linspace(0.0, 1.0, 25)
    along = s.start + t * (share * s.length - s.start)
    behind = np.clip((t - s.bend) / (1 - s.bend), 0.0, 1.0)
    offset = s.bow * np.sin(np.pi * t) - s.inward * behind**2
    path = np.column_stack(
        [x + along, y + s.temple_thickness / 2 + offset, z - s.drop * behind**s.curl]
    )
    slim = 1 - (1 - s.temple_slim) * np.clip(along / 0.035, 0.0, 1.0)
    profile = rectangle(s.temple_thickness, s.temple_height, 0.3 * s.temple_thickness, segments=2)
    bar = sweep(path, [profile * [1.0, k] for k in slim], (0.0, 0.0, 1.0))
    visuals = [painted(bar, s.temple_color)]
    if s.ear_tips:
        tail = path[t > s.bend - 0.03]
        size = (s.temple_thickness + 0.0008, s.temple_slim * s.temple_height + 0.0008)
        tip = sweep(tail, superellipse(size[0], size[1], 3.0, 14), (0.0, 0.0, 1.0))
        visuals.append(painted(tip, shade(s.rim_color, 0.8)))
    if s.barrel:
        visuals.append(painted(_barrels(s, lean)[1], METAL))
    return visuals


def build(s: EyeglassesShape) -> Design:
    """Frame, left temple (-y) and right temple (+y), both unfolded; states fold them inwards."""
    shares = (1.0, 1.0)
    if s.trait == SHORTER:
        shares = (0.6, 1.0) if s.left_over else (1.0, 0.6)
    left = [Visual(mesh=mirrored(v.mesh, 1), color=v.color) for v in _temple(s, -s.lean, shares[0])]
    x, y, z = s.pivot
    # turning +x by a quarter about (0, n_y, n_z) gives (0, n_z, -n_y)
    lean = -sin(s.lean), cos(s.lean)
    return Design(
        parts=(_frame(s), left, _temple(s, s.lean, shares[1])),
        pivot=[(x, -y, z), (x, y, z)],
        axis=[(0.0, lean[0], lean[1]), (0.0, -lean[0], -lean[1])],
        upper=[s.travel * TRAVEL, s.travel * TRAVEL],
    )


RECIPE = Recipe(
    shape=EyeglassesShape,
    build=build,
    held_out=HELD_OUT,
    main=("lens_ratio", "temple_length"),
    rearranged=(SHORTER, SET_BACK),
    symmetric=SYMMETRIC,
)
