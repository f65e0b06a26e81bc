# SPDX-License-Identifier: MIT
"""Slope, incidence angle and depth edges of the surface that a depth image shows.

All in inverse depth q = 1/z, which is linear in the pixel coordinates on a plane: slopes and angles
of flat surfaces are exact, and a plane has no edges, however steep it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scapo.camera import Intrinsics

EDGE = 0.02
"""A depth edge: the step of q to the next pixel exceeds that on the other side by this share of q.
It is far above what creases and curved surfaces show from one pixel to the next."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """What each pixel of a depth image shows of the surface; zeros where nothing was measured."""

    inverse: Float[np.ndarray, "H W"]
    """q = 1/z, 1/m."""
    slope_u: Float[np.ndarray, "H W"]
    """Change of q over one pixel to the right, on the pixel's own surface."""
    slope_v: Float[np.ndarray, "H W"]
    """Change of q over one pixel down."""
    across: Float[np.ndarray, "H W"]
    """Change of q to the neighbour beyond a depth edge; 0 where there is no edge."""


def surface(depth: Float[np.ndarray, "H W"]) -> Surface:
    """Slopes and edges, by differences to the four neighbours.

    Of the two differences along a row or column the smaller one is on the pixel's own surface.

    Args:
        depth: z in m; 0 where nothing was measured.
    """
    q = np.divide(1, depth, out=np.zeros(depth.shape, np.float32), where=depth > 0)
    slope_u, jump_u = _differences(q, axis=1)
    slope_v, jump_v = _differences(q, axis=0)
    across = np.where(np.abs(jump_u) >= np.abs(jump_v), jump_u, jump_v)
    return Surface(inverse=q, slope_u=slope_u, slope_v=slope_v, across=across)


def _differences(
    q: Float[np.ndarray, "H W"], axis: int
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Along an axis: change per pixel on the own surface, and change across an edge or 0."""
    first: tuple[slice, ...] = (slice(None),) * axis + (slice(None, -1),)
    last: tuple[slice, ...] = (slice(None),) * axis + (slice(1, None),)
    step = q[last] - q[first]
    step[(q[last] == 0) | (q[first] == 0)] = np.inf
    after, before = np.full(q.shape, np.inf, np.float32), np.full(q.shape, np.inf, np.float32)
    after[first] = step
    before[last] = step
    size_after, size_before = np.abs(after), np.abs(before)
    own = size_after <= size_before
    slope = np.where(own, after, before)
    small, large = np.minimum(size_after, size_before), np.maximum(size_after, size_before)
    edge = (large > small + np.float32(EDGE) * q) & (large < np.inf)
    across = np.where(edge, np.where(own, -before, after), np.float32(0))
    slope[small == np.inf] = 0
    return slope, across


def edges(shown: Surface) -> Bool[np.ndarray, "H W"]:
    """Pixels beside a depth edge."""
    return shown.across != 0


def rays(
    shape: tuple[int, int], camera: Intrinsics
) -> tuple[Float[np.ndarray, "1 W"], Float[np.ndarray, "H 1"]]:
    """x/z of each column and y/z of each row, at the pixel centres."""
    x = (np.arange(shape[1], dtype=np.float32) + np.float32(0.5 - camera.cx)) / camera.fx
    y = (np.arange(shape[0], dtype=np.float32) + np.float32(0.5 - camera.cy)) / camera.fy
    return x[None].astype(np.float32), y[:, None].astype(np.float32)


def incidence(shown: Surface, camera: Intrinsics) -> Float[np.ndarray, "H W"]:
    """Angle between the surface's normal and the ray to the camera, rad, 0 where head-on.

    On the plane n . X = d the inverse depth is q = n . (x, y, 1) / d, so the slopes give n / d, and
    cos(angle) = q / (|n / d| |(x, y, 1)|).

    Args:
        shown: The surface.
        camera: Intrinsics of this image.
    """
    q = shown.inverse
    x, y = rays((q.shape[0], q.shape[1]), camera)
    a = shown.slope_u * np.float32(camera.fx)
    b = shown.slope_v * np.float32(camera.fy)
    c = q - x * a - y * b
    size = (a * a + b * b + c * c) * (x * x + y * y + 1)
    return np.arccos(np.minimum(q / np.sqrt(np.maximum(size, np.float32(1e-12))), 1))
