# SPDX-License-Identifier: MIT
"""Closed solids: boxes, plates, lathed bodies. Metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from sim_assets.procedural.shapes import Numbers, Ring, at, loft, rectangle, superellipse


def box(lower: Numbers, upper: Numbers) -> trimesh.Trimesh:
    """An axis-aligned box from its two corners."""
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    loop = low[:2] + corners * (high - low)[:2]
    return loft([at(loop, low[2]), at(loop, high[2])])


def slab(
    width: float, depth: float, thickness: float, radius: float, bevel: float = 0.0
) -> trimesh.Trimesh:
    """A plate with rounded corners in the x-y plane, z from 0 to thickness.

    Args:
        width: Along x.
        depth: Along y.
        thickness: Along z.
        radius: Of the corners seen from above.
        bevel: Rounding of the upper and lower edges.
    """
    rings = rounded_sides(width, depth, radius, bevel, (0.0, thickness))
    return loft(rings)


def rounded_sides(
    width: float, depth: float, radius: float, bevel: float, heights: tuple[float, float]
) -> list[Ring]:
    """Loops of a plate's outside from its lower to its upper edge, both rounded by `bevel`."""
    low, high = heights
    bevel = min(bevel, 0.49 * (high - low), 0.49 * radius + 1e-5)
    if bevel < 1e-5:
        loop = rectangle(width, depth, radius)
        return [at(loop, low), at(loop, high)]
    steps = np.linspace(0.0, np.pi / 2, 4)
    profile = [(bevel * (1 - np.sin(a)), low + bevel * (1 - np.cos(a))) for a in steps]
    profile += [(bevel * (1 - np.cos(a)), high - bevel * (1 - np.sin(a))) for a in steps]
    return [
        at(rectangle(width - 2 * inset, depth - 2 * inset, radius - inset), z)
        for inset, z in profile
    ]


def lathe(profile: Sequence[tuple[float, float]], count: int = 24) -> trimesh.Trimesh:
    """The profile (radius, z) turned about z, from bottom to top along the outside.

    A profile may come back down inside (a cup). Radii must be positive; ends are capped flat.
    """
    circle = superellipse(2.0, 2.0, 2.0, count)
    return loft([at(circle * radius, z) for radius, z in profile])


def cylinder(
    radius: float, low: float, high: float, bevel: float = 0.0, count: int = 20
) -> trimesh.Trimesh:
    """A cylinder about z with bevelled edges."""
    if bevel <= 0:
        return lathe([(radius, low), (radius, high)], count)
    return lathe(
        [
            (radius - bevel, low),
            (radius, low + bevel),
            (radius, high - bevel),
            (radius - bevel, high),
        ],
        count,
    )


def ellipsoid(size: Numbers, count: int = 16) -> trimesh.Trimesh:
    """An ellipsoid with these full axes about the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 1)
    angle[[0, -1]] *= 0.985  # small flat poles in place of degenerate triangles
    mesh = lathe([(float(np.cos(a)), float(np.sin(a))) for a in angle], count)
    return trimesh.Trimesh(mesh.vertices * np.asarray(size) / 2, mesh.faces, process=False)


def tub(outer: Numbers, wall: float, floor: float, radius: float) -> trimesh.Trimesh:
    """An open box standing on z = 0 about the z axis.

    Args:
        outer: Width (x), depth (y), height (z).
        wall: Thickness of the sides.
        floor: Thickness of the bottom.
        radius: Of the outer corners seen from above.
    """
    width, depth, height = outer
    outside = rectangle(width, depth, radius)
    inside = rectangle(width - 2 * wall, depth - 2 * wall, radius - wall)
    return loft([at(outside, 0.0), at(outside, height), at(inside, height), at(inside, floor)])
