# SPDX-License-Identifier: MIT
"""The object of a depth image without a mask: the nearest thing that is neither floor nor wall.

Planes that reach the image's border are taken away, then pixels are joined whose depths follow
each other. An object is several such pieces: a door before its body, a temple beside its frame. Of
the large ones the nearest is the object's, and with it all that lies near it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scapo.geometry.camera import Intrinsics, back_project

PLANES = 3
"""Floor and two walls."""
DRAWS, SAMPLE = 200, 2000
"""Planes through three points that are tried, and points that they are tried with."""
NEAR_PLANE = 0.012
"""Share of a point's depth within which it lies on a plane."""
LEAST_PLANE = 0.08
"""Share of the points that a plane has at least."""
LEAST_BORDER = 0.12
"""Share of the border's pixels that floor or wall cover at least; an object's face covers none."""
STEP = 0.02
"""Share of the depth by which neighbouring pixels of one thing differ at most."""
LEAST_PIECE = 0.005
"""Share of the pixels with a depth that the object has at least."""
LARGE = 0.1
"""Share of the largest piece's pixels that a piece has at least with which the object is begun."""
REACH, LARGER = 1 / 3, 3.0
"""Share of a diagonal within which another piece is the object's own: that of the object as far as
it is found, or of the piece, if it is not more times as large."""
LEAST_SPECK, MOST_PIECES = 20, 200
"""Pixels of a piece at least, and how many pieces, the largest, are asked; others are left out."""
SAMPLE_GAP = 1000
"""Points of a piece that distances are measured with."""


def nearest_object(
    depth: Float[np.ndarray, "H W"], camera: Intrinsics
) -> tuple[Bool[np.ndarray, "H W"], tuple[str, ...]]:
    """The object's pixels, and what was done in words.

    Args:
        depth: Metres; 0: not seen.
        camera: Of the image.
    """
    left = depth > 0
    total, planes = int(left.sum()), 0
    for _ in range(PLANES):
        plane = _dominant_plane(depth, left, camera)
        if plane is None or (left & ~plane).sum() < LEAST_PIECE * total:
            break
        left, planes = left & ~plane, planes + 1
    pieces = _pieces(depth, left)
    count = np.bincount(pieces[left], minlength=1)
    count[0] = 0
    if count.max() < max(LEAST_PIECE * total, 1):
        return depth > 0, ("no --mask: no single object found, all of the image is taken",)
    large = np.flatnonzero(count >= max(LARGE * count.max(), LEAST_PIECE * total))
    middles = [float(np.median(depth[pieces == piece])) for piece in large]
    specks = int((count >= LEAST_SPECK).sum())
    others = np.argsort(-count, kind="stable")[: min(MOST_PIECES, specks)]
    own = _with_what_is_near(int(large[int(np.argmin(middles))]), pieces, others, depth, camera)
    chosen = np.isin(pieces, own)
    words = (
        f"no --mask: {planes} plane(s) at the border left out as floor or wall, the nearest thing "
        f"is taken, {len(own)} piece(s), {int(chosen.sum()):,} of {total:,} pixels"
    )
    return chosen, (words,)


def _with_what_is_near(
    first: int,
    pieces: np.ndarray,
    others: np.ndarray,
    depth: Float[np.ndarray, "H W"],
    camera: Intrinsics,
) -> list[int]:
    """Numbers of the pieces of an object: the first, and whatever lies near what is found."""
    shown = back_project(depth, pieces > 0, camera)
    order = np.argsort(pieces[pieces > 0], kind="stable")
    number, begin = np.unique(pieces[pieces > 0][order], return_index=True)
    split = dict(zip(number.tolist(), np.split(shown[order], begin[1:]), strict=True))
    points = {piece: split[piece] for piece in {first, *others.tolist()}}
    own, new, left = [first], [first], [piece for piece in points if piece != first]
    low, high = points[first].min(0), points[first].max(0)
    while new:
        tree = KDTree(np.concatenate([_some(points[piece]) for piece in own]))
        size, new = float(np.linalg.norm(high - low)), list[int]()
        for piece in left:
            other = float(np.linalg.norm(np.ptp(points[piece], 0)))
            reach = REACH * max(size, min(other, LARGER * size))
            if tree.query(_some(points[piece]), distance_upper_bound=reach)[0].min() < reach:
                new.append(piece)
        own += new
        left = [piece for piece in left if piece not in new]
        ends = np.concatenate([np.stack([low, high]), *(points[piece] for piece in new)])
        low, high = ends.min(0), ends.max(0)
    return own


def _some(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "K 3"]:
    return points[:: max(1, len(points) // SAMPLE_GAP)]


def _dominant_plane(
    depth: Float[np.ndarray, "H W"], left: Bool[np.ndarray, "H W"], camera: Intrinsics
) -> Bool[np.ndarray, "H W"] | None:
    """Pixels of the plane with the most points that reaches the border (RANSAC); None: none."""
    rng = np.random.default_rng(0)
    points = back_project(depth, left, camera)
    if len(points) < SAMPLE // 10:
        return None
    border = np.ones(depth.shape, bool)
    border[1:-1, 1:-1] = False
    some = points[rng.integers(0, len(points), SAMPLE)]
    corners = points[rng.integers(0, len(points), (DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    offset = (normals * corners[:, 0]).sum(1)
    share = (np.abs(some @ normals.T - offset) < NEAR_PLANE * some[:, 2:]).mean(0)
    for index in np.argsort(-share):
        if share[index] < LEAST_PLANE:
            return None
        inside = np.abs(points @ normals[index] - offset[index]) < NEAR_PLANE * points[:, 2]
        plane = np.zeros(depth.shape, bool)
        plane[left] = inside
        if (plane & border).sum() >= LEAST_BORDER * border.sum():
            return plane
    return None


def _pieces(depth: Float[np.ndarray, "H W"], left: Bool[np.ndarray, "H W"]) -> np.ndarray:
    """A number per pixel, 0 where none is left: equal where depths follow each other."""
    number = np.cumsum(left).reshape(left.shape) - 1
    edges = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near = np.abs(depth[a] - depth[b]) < STEP * np.minimum(depth[a], depth[b])
        both = left[a] & left[b] & near
        edges.append((number[a][both], number[b][both]))
    first, second = (np.concatenate(side) for side in zip(*edges, strict=True))
    size = int(left.sum())
    graph = coo_array((np.ones(len(first), bool), (first, second)), (size, size))
    _, label = connected_components(graph, directed=False)
    pieces = np.zeros(left.shape, int)
    pieces[left] = label + 1
    return pieces
