# SPDX-License-Identifier: MIT
"""The object of a depth image without a mask: the nearest thing that is neither floor nor wall.

Planes that reach the image's border are taken away, then pixels are joined whose depths follow
each other; of the pieces that are large enough the nearest is the object.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

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
    large = np.flatnonzero(count >= max(LEAST_PIECE * total, 1))
    large = large[large > 0]
    if not len(large):
        return depth > 0, ("no --mask: no single object found, all of the image is taken",)
    middles = [float(np.median(depth[pieces == piece])) for piece in large]
    chosen = pieces == large[int(np.argmin(middles))]
    words = (
        f"no --mask: {planes} plane(s) at the border left out as floor or wall, the nearest of "
        f"{len(large)} thing(s) is taken, {int(chosen.sum()):,} of {total:,} pixels"
    )
    return chosen, (words,)


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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

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
