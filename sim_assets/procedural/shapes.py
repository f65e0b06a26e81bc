# SPDX-License-Identifier: MIT
"""Closed surfaces from a few primitives: lofts, cups, frames, sweeps, lathes.

Almost everything is a loft: a row of closed loops with equally many points, joined by quads and
capped at both ends (or joined into a ring). A box with a cavity is a loft that runs up outside and
down inside. All surfaces are watertight with normals outwards. Metres.

Closed solids: boxes, plates, lathed bodies. Metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float, Int

Loop = Float[np.ndarray, "N 2"]
"""Counter-clockwise outline in a plane."""
Ring = Float[np.ndarray, "N 3"]
Numbers = Sequence[float] | np.ndarray
"""A few coordinates or sizes."""

FRONT = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Object axes of a panel seen from the front (-x): its x to the viewer's right (-y), its y up
(z), its z towards the viewer (-x)."""
ALONG_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Local z along object x, local x along y, local y along z."""
ALONG_Y = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Local z along object y, local x along z, local y along x."""
DOWN = np.diag([1.0, -1.0, -1.0])
"""Local z downwards."""


def rectangle(
    width: float,
    height: float,
    radius: float | Numbers = 0.0,
    centre: Numbers = (0.0, 0.0),
    segments: int = 4,
) -> Loop:
    """A rectangle with rounded corners, 4 (segments + 1) points, counter-clockwise.

    Corners have at least 0.1 mm of radius, so that loops of different rectangles correspond; edges
    of two such loops are parallel, so that quads between them never fold.

    Args:
        width: Along the first axis.
        height: Along the second axis.
        radius: Of all corners, or of each, from (+, +) counter-clockwise.
        centre: Of the rectangle.
        segments: Edges per rounded corner.
    """
    radii = np.broadcast_to(np.asarray(radius, float), 4)
    radii = np.clip(radii, 1e-4, 0.499 * min(width, height))
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    angles = np.linspace(0.0, np.pi / 2, segments + 1)
    corners = []
    for quarter in range(4):
        turn = angles + quarter * np.pi / 2
        arc = np.column_stack([np.cos(turn), np.sin(turn)])
        middle = signs[quarter] * (np.array([width, height]) / 2 - radii[quarter])
        corners.append(middle + radii[quarter] * arc)
    return np.concatenate(corners) + np.asarray(centre)


def superellipse(width: float, height: float, power: float = 2.0, count: int = 32) -> Loop:
    """|2x/width|^power + |2y/height|^power = 1; power 2 is an ellipse, 4 nearly a rectangle."""
    angle = 2 * np.pi * np.arange(count) / count
    cosine, sine = np.cos(angle), np.sin(angle)
    exponent = 2.0 / power
    x = np.sign(cosine) * np.abs(cosine) ** exponent * width / 2
    y = np.sign(sine) * np.abs(sine) ** exponent * height / 2
    return np.column_stack([x, y])


def at(loop: Loop, height: float) -> Ring:
    """The loop lifted to z = height."""
    return np.column_stack([loop, np.full(len(loop), height)])


def _side_faces(first: Int[np.ndarray, " N"], second: Int[np.ndarray, " N"]) -> np.ndarray:
    """Two triangles per edge between corresponding points of two loops."""
    first_next, second_next = np.roll(first, -1), np.roll(second, -1)
    return np.concatenate(
        [
            np.column_stack([first, first_next, second_next]),
            np.column_stack([first, second_next, second]),
        ]
    )


def loft(rings: Sequence[Ring], ring: bool = False) -> trimesh.Trimesh:
    """The closed surface through loops with equally many points.

    Seen along the direction in which the loft leaves the first cap the loops run
    counter-clockwise about it, so that normals point outwards.

    Args:
        rings: The loops, in order; caps are fans about the loop's mean, so the first and last
            loop must be star-shaped about it (convex ones are).
        ring: Join the last loop to the first in place of capping both.
    """
    count = len(rings[0])
    index = np.arange(len(rings) * count).reshape(len(rings), count)
    pairs = list(zip(index, np.roll(index, -1, axis=0), strict=True))
    faces = [_side_faces(a, b) for a, b in (pairs if ring else pairs[:-1])]
    vertices = list(rings)
    if not ring:
        base = index.size
        vertices += [rings[0].mean(0, keepdims=True), rings[-1].mean(0, keepdims=True)]
        first, last = index[0], index[-1]
        faces.append(np.column_stack([np.roll(first, -1), first, np.full(count, base)]))
        faces.append(np.column_stack([last, np.roll(last, -1), np.full(count, base + 1)]))
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def sweep(
    path: Float[np.ndarray, "K 3"],
    loop: Loop | Sequence[Loop],
    up: Numbers,
    closed: bool = False,
) -> trimesh.Trimesh:
    """A profile carried along a path.

    Args:
        path: Points of the centre line; for a closed path the first is not repeated.
        loop: The profile, or one per point; its second axis stays as close to `up` as the
            direction of travel lets it, its first points to the right of travel.
        up: Never parallel to the path.
        closed: Whether the path is a ring.
    """
    if closed:
        tangents = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    else:
        tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    right = np.cross(tangents, np.asarray(up, float))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    upward = np.cross(right, tangents)
    profiles = [loop] * len(path) if isinstance(loop, np.ndarray) else list(loop)
    rings = [
        # right x upward = -tangent: the loop is reversed to run about the direction of travel
        point + profile[::-1, :1] * r + profile[::-1, 1:] * u
        for point, profile, r, u in zip(path, profiles, right, upward, strict=True)
    ]
    return loft(rings, ring=closed)


def placed(
    mesh: trimesh.Trimesh,
    translation: Numbers = (0.0, 0.0, 0.0),
    rotation: Float[np.ndarray, "3 3"] | None = None,
) -> trimesh.Trimesh:
    """A copy, rotated and then moved."""
    vertices = np.asarray(mesh.vertices)
    if rotation is not None:
        vertices = vertices @ rotation.T
    return trimesh.Trimesh(vertices + np.asarray(translation), mesh.faces, process=False)


def mirrored(mesh: trimesh.Trimesh, axis: int) -> trimesh.Trimesh:
    """A copy mirrored in the plane through the origin across `axis`, normals still outwards."""
    vertices = np.array(mesh.vertices)
    vertices[:, axis] *= -1
    return trimesh.Trimesh(vertices, np.asarray(mesh.faces)[:, ::-1], process=False)


def merged(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Several closed surfaces as one mesh."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return trimesh.Trimesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.faces + offset for m, offset in zip(meshes, offsets, strict=True)]),
        process=False,
    )


def bezier(first: Numbers, corner: Numbers, last: Numbers, count: int) -> Ring:
    """`count` points of the parabola from first to last, tangent to the lines to the corner."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    ends = (1 - t) ** 2 * np.asarray(first) + t**2 * np.asarray(last)
    return ends + 2 * t * (1 - t) * np.asarray(corner)


def resampled(loop: Loop, count: int) -> Float[np.ndarray, "{count} 2"]:
    """`count` points at equal distances along the loop."""
    closed = np.concatenate([loop, loop[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    wanted = np.arange(count) * length[-1] / count
    return np.column_stack([np.interp(wanted, length, closed[:, k]) for k in range(2)])


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
