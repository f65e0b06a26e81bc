# SPDX-License-Identifier: MIT
"""Baskets with two swing handles: upright at rest, they fold down outwards to the sides (+-y).

The left handle (part 1) is the one on the left of somebody who looks at the front, at +y; the
right one (part 2) is at -y. The basket stands on z = 0 while the object is built.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians

import numpy as np
import trimesh
from jaxtyping import Float

from sim_assets.objects import Visual
from sim_assets.procedural.assembly import Design, Recipe, painted, shade
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
    ALONG_X,
    FRONT,
    Loop,
    at,
    box,
    cylinder,
    loft,
    merged,
    mirrored,
    placed,
    rectangle,
    resampled,
    slab,
    superellipse,
    sweep,
)

TRAVEL = radians(85.0)
SHORTER = "one handle shorter"
COUNT = 80
"""Points about the basket: four per column of the weave."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BasketShape:
    """Free parameters; lengths in metres, ratios where named so."""

    length: float = span(0.26, 0.48, 0.22, 0.56)
    """Along y, at the rim."""
    aspect: float = ratio(0.5, 1.08, 0.4, 1.35)
    """Width (x) over length."""
    deep: float = ratio(0.26, 0.85, 0.2, 1.1)
    """Height of the wall over the length."""
    taper: float = span(0.6, 0.97, 0.5, 1.0)
    """Of the foot over the rim."""
    curve: float = span(0.5, 1.4, 0.4, 1.8)
    """Exponent of the wall's profile."""
    corner: float = span(0.06, 0.49, 0.03, 0.499)
    """Radius of the corners over the smaller side."""
    spread: float = span(0.0, 0.5, 0.0, 0.62)
    """Of the handles' axes from the middle, over half the length."""
    wall: float = span(0.005, 0.009, 0.004, 0.012)
    weave: float = span(0.0015, 0.003, 0.001, 0.004)
    """How far the strands of a wicker wall stand out."""
    rim_radius: float = span(0.004, 0.012, 0.003, 0.016)
    handle_rise: float = span(0.28, 0.85, 0.2, 1.1)
    """Height of the handles over the length."""
    handle_radius: float = span(0.0038, 0.009, 0.003, 0.012)
    handle_power: float = span(2.0, 5.0, 2.0, 7.0)
    """2: round bow, above: squarer."""
    grip_length: float = span(0.2, 0.4, 0.15, 0.5)
    band_height: float = span(0.5, 0.8, 0.4, 0.85)
    slat_width: float = span(0.35, 0.6, 0.25, 0.7)
    """Over their distance."""
    foot_height: float = span(0.006, 0.03, 0.004, 0.045)
    travel: float = span(0.8, 1.0, 0.7, 1.0)
    style: str = choice("wicker", "wicker", "plastic", "slatted")
    grips: bool = chance(0.5)
    twisted: bool = chance(0.4)
    liner: bool = chance(0.35)
    band: bool = chance(0.4)
    feet: bool = chance(0.4)
    divider: bool = chance(0.25)
    label: bool = chance(0.35)
    rows: int = choice(9, 11, 13)
    slats: int = choice(32, 40)
    body_color: tuple[float, float, float] = tint(
        (0.72, 0.55, 0.33), (0.5, 0.35, 0.2), (0.82, 0.72, 0.52), (0.75, 0.2, 0.15),
        (0.15, 0.35, 0.65), (0.35, 0.35, 0.36),
    )  # fmt: skip
    handle_color: tuple[float, float, float] = tint(
        (0.6, 0.42, 0.24), (0.15, 0.15, 0.16), (0.8, 0.7, 0.5)
    )
    cloth_color: tuple[float, float, float] = tint(
        (0.9, 0.88, 0.82), (0.7, 0.2, 0.2), (0.3, 0.45, 0.6)
    )
    trait: str = ""

    @property
    def height(self) -> float:
        """Of the wall."""
        return self.length * self.deep

    @property
    def width(self) -> float:
        """Along x, at the rim."""
        return self.length * self.aspect

    @property
    def offset(self) -> float:
        """The |y| of the handles."""
        least = max(1.35 * self.handle_radius, self.handle_radius + 0.0012) + 0.0012
        straight = self.length / 2 - self.corner * min(self.width, self.length) - 0.02
        share = 0.7 + 0.2 * self.spread if self.trait == SET_BACK else self.spread
        return max(least, min(share * self.length / 2, straight))

    @property
    def reach(self) -> float:
        """The |x| of the handles' legs, inside the ears that stand on the rim."""
        return self.width / 2 - 0.004 - self.handle_radius

    @property
    def pivot_z(self) -> float:
        """Of the handles' axes, high enough for a folded handle to lie over the rim."""
        return self.height + self.rim_radius + 1.3 * self.handle_radius + 0.003


HELD_OUT: HeldOut = (
    {"style": "slatted", "grips": True},
    {"style": "wicker", "liner": True, "feet": True},
    {"style": "plastic", "twisted": True},
)
SYMMETRIC = {"label": False}


def _outline(s: BasketShape, z: float, inset: float = 0.0) -> Loop:
    """The wall's horizontal section at height z."""
    scale = s.taper + (1 - s.taper) * max(z / s.height, 0.0) ** s.curve
    size = np.array([s.width, s.length]) * scale - 2 * inset
    radius = max(s.corner * size.min(), 0.002)
    return resampled(rectangle(size[0], size[1], radius, segments=12), COUNT)


def _outward(loop: Loop) -> Float[np.ndarray, "N 2"]:
    """Unit normals of a loop."""
    along = np.roll(loop, -1, axis=0) - np.roll(loop, 1, axis=0)
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _outside(s: BasketShape) -> list[np.ndarray]:
    """Rings of the outer wall from the foot to the rim: woven strands, or bands of plastic."""
    rings = [at(_outline(s, 0.0, 0.003), 0.0)]
    column = np.cos(2 * pi * np.arange(COUNT) / 4)[:, None]
    for step in range(1, 2 * s.rows):
        z = s.height * step / (2 * s.rows)
        loop = _outline(s, z)
        if s.style == "wicker":
            sign = 1 if step % 4 == 1 else -1
            bump = s.weave * (0.4 + 0.6 * sign * column) if step % 2 else -0.4 * s.weave
            loop = loop + _outward(loop) * bump
        elif step % 6 == 3:
            loop = loop + _outward(loop) * s.weave
        rings.append(at(loop, z))
    rings.append(at(_outline(s, s.height), s.height))
    return rings


def _slatted(s: BasketShape) -> trimesh.Trimesh:
    """A low tub, upright slats and a hoop half way up."""
    low = 0.12 * s.height
    outside = [at(_outline(s, z), z) for z in (0.0, low)]
    inside = [at(_outline(s, low, s.wall), low), at(_outline(s, 0.0, s.wall), s.wall)]
    pieces = [loft([*outside, *inside])]
    heights = np.array([0.8 * low, 0.5 * s.height, s.height])
    lines = [resampled(_outline(s, z, s.wall / 2), 4 * s.slats)[2::4] for z in heights]
    gap = float(np.linalg.norm(lines[0][1] - lines[0][0]))
    section = rectangle(s.slat_width * gap, 0.7 * s.wall, 0.0005, segments=1)
    for k in range(s.slats):
        path = np.array([[*line[k], z] for line, z in zip(lines, heights, strict=True)])
        normal = _outward(lines[1])[k]
        pieces.append(sweep(path, section, (*normal, 0.0)))
    hoop = _outline(s, 0.55 * s.height, s.wall / 2)
    profile = rectangle(0.012, 1.1 * s.wall, 0.001, segments=1)
    path = at(hoop, 0.55 * s.height)
    pieces.append(sweep(path, profile[:, ::-1][::-1], (0.0, 0.0, 1.0), closed=True))
    return merged(*pieces)


def _tub(s: BasketShape) -> trimesh.Trimesh:
    """The closed wall and floor."""
    inside = [at(_outline(s, z, s.wall), z) for z in np.linspace(1.0, 0.03, 5) * s.height]
    return loft([*_outside(s), *inside])


def _rim(s: BasketShape) -> trimesh.Trimesh:
    """A roll about the mouth."""
    path = at(_outline(s, s.height, s.wall / 2), s.height)
    return sweep(path, superellipse(2 * s.rim_radius, 2 * s.rim_radius, 2.0, 10), (0, 0, 1), True)


def _ears(s: BasketShape) -> trimesh.Trimesh:
    """Plates on the rim in which the handles turn."""
    half = 1.3 * s.handle_radius + 0.004
    top = s.pivot_z + 1.3 * s.handle_radius + 0.002
    x = s.width / 2
    pieces = []
    for y in (-s.offset, s.offset):
        pieces.append(box((x - 0.0028, y - half, s.height - 0.012), (x + 0.0022, y + half, top)))
        rivet = cylinder(0.7 * s.handle_radius, x + 0.002, x + 0.0045, 0.0008, 10)
        pieces.append(placed(rivet, (0.0, y, s.pivot_z), ALONG_X))
    both = merged(*pieces)
    return merged(both, mirrored(both, 0))


def _cloth(s: BasketShape) -> trimesh.Trimesh:
    """A lining laid over the rim's inside and outside, 1.5 mm thick."""
    r = s.rim_radius + 0.001
    profile = [(r + 0.0015, -0.3 * s.height), (r + 0.0015, 0.0), (0.0, r + 0.0012),
               (-r - 0.0015, 0.0), (-r - 0.0015, -0.3 * s.height)]  # fmt: skip
    inner = [(r, -0.3 * s.height), (r, 0.0), (0.0, r - 0.0003), (-r, 0.0), (-r, -0.3 * s.height)]
    rings = []
    for out, rise in [*profile, *inner[::-1]]:
        z = s.height + min(rise, 0.0)
        rings.append(at(_outline(s, z, s.wall / 2 - out), s.height + rise))
    return loft(rings, ring=True)


def _extras(s: BasketShape) -> list[Visual]:
    """Cloth, band, feet, divider, label."""
    visuals = []
    if s.liner and s.style != "slatted":
        visuals.append(painted(_cloth(s), s.cloth_color))
    if s.band:
        z = s.band_height * s.height
        stand = s.weave + 0.0008
        rings = [
            at(_outline(s, h, -g), h)
            for g, h in (
                (-0.002, z - 0.012),
                (stand, z - 0.012),
                (stand, z + 0.012),
                (-0.002, z + 0.012),
            )
        ]
        visuals.append(painted(loft(rings, ring=True), shade(s.body_color, 0.6)))
    if s.feet:
        x, y = 0.3 * s.taper * s.width, 0.36 * s.taper * s.length
        foot = cylinder(0.014, -s.foot_height, 0.003, 0.002, 14)
        feet = [placed(foot, (i * x, j * y, 0.0)) for i in (-1, 1) for j in (-1, 1)]
        visuals.append(painted(merged(*feet), shade(s.body_color, 0.5)))
    if s.divider:
        z = 0.6 * s.height
        half = _outline(s, 0.1 * s.height, s.wall - 0.001)[:, 0].max()
        board = box((-half, -0.003, 0.025 * s.height), (half, 0.003, z))
        visuals.append(painted(board, shade(s.body_color, 0.85)))
    if s.label:
        z = 0.4 * s.height
        front = _outline(s, z)[:, 0].min()
        lean = s.width / 2 * (1 - s.taper) / s.height * 0.016 + s.weave
        tag = slab(0.2 * s.length, 0.032, 0.004 + lean, 0.004, 0.001)
        visuals.append(painted(placed(tag, (front + 0.002, 0.0, z), FRONT), s.cloth_color))
    return visuals


def _body(s: BasketShape) -> list[Visual]:
    shell = _slatted(s) if s.style == "slatted" else _tub(s)
    return [
        painted(shell, s.body_color),
        painted(_rim(s), shade(s.body_color, 0.85)),
        painted(_ears(s), shade(s.handle_color, 0.8)),
        *_extras(s),
    ]


def _handle(s: BasketShape, y: float, share: float = 1.0) -> list[Visual]:
    """A bow over the basket's width, upright at this y, with eyes about its axis."""
    angle = np.linspace(0.0, pi, 41)
    exponent = 2.0 / s.handle_power
    rise = share * s.handle_rise * s.length
    x = s.reach * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** exponent
    z = s.pivot_z + rise * np.abs(np.sin(angle)) ** exponent
    path = np.column_stack([x, np.full(41, y), z])
    section = superellipse(2 * s.handle_radius, 2 * s.handle_radius, 2.2, 12)
    swell = 1 + (0.1 * np.cos(pi * np.arange(41)) - 0.1) * s.twisted
    bow = sweep(path, [section * k for k in swell], (0.0, 1.0, 0.0))
    r = s.handle_radius
    eye = cylinder(1.3 * r, s.reach - r, s.reach + r, 0.0006, 14)
    eyes = [placed(eye, (shift, y, s.pivot_z), ALONG_X) for shift in (0.0, -2 * s.reach)]
    visuals = [painted(merged(bow, *eyes), s.handle_color)]
    if s.grips:
        middle = np.abs(angle - pi / 2) < s.grip_length * pi / 2
        sleeve = superellipse(2 * r + 0.0024, 2 * r + 0.0024, 2.0, 14)
        grip = sweep(path[middle], sleeve, (0.0, 1.0, 0.0))
        visuals.append(painted(grip, shade(s.handle_color, 0.55)))
    return visuals


def build(s: BasketShape) -> Design:
    """Body, left handle (+y, folds towards +y) and right handle (-y, folds towards -y)."""
    y, z = s.offset, s.pivot_z
    return Design(
        parts=(_body(s), _handle(s, y), _handle(s, -y, 0.55 if s.trait == SHORTER else 1.0)),
        pivot=[(0.0, y, z), (0.0, -y, z)],
        axis=[(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)],
        upper=[s.travel * TRAVEL, s.travel * TRAVEL],
    )


RECIPE = Recipe(
    shape=BasketShape,
    build=build,
    held_out=HELD_OUT,
    main=("aspect", "deep", "handle_rise"),
    rearranged=(SHORTER, SET_BACK),
    symmetric=SYMMETRIC,
)
