# SPDX-License-Identifier: MIT
"""What a depth image shows of a surface: slope, incidence angle, depth edges; and what edges do.

All in inverse depth q = 1/z, which is linear in the pixel coordinates on a plane: slopes and angles
of flat surfaces are exact, and a plane has no edges, however steep it is. Everything is computed at
a list of pixels (`at`, flat indices), as a cloud needs only some of them.

`flying_pixels` and `holes` are what depth sensors do at edges and at grazing angles. The published
depth models (`kinect`, `disparity`) say nothing of these: the shares here are choices that look
like real depth images, and are named as such.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from scapo.geometry.camera import Intrinsics

EDGE = 0.02
"""A depth edge: the step of q to the next pixel exceeds that on the other side by this share of q.
It is far above what creases and curved surfaces show from one pixel to the next."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """What pixels show of the surface; zeros where nothing was measured."""

    at: Int[np.ndarray, " K"]
    """Flat indices of the pixels."""
    inverse: Float[np.ndarray, " K"]
    """q = 1/z, 1/m."""
    slope_u: Float[np.ndarray, " K"]
    """Change of q over one pixel to the right, on the pixel's own surface."""
    slope_v: Float[np.ndarray, " K"]
    """Change of q over one pixel down."""
    across: Float[np.ndarray, " K"]
    """Change of q to the neighbour beyond a depth edge; 0 where there is no edge."""


def surface(depth: Float[np.ndarray, "H W"], at: Int[np.ndarray, " K"] | None = None) -> Surface:
    """Slopes and edges, by differences to the four neighbours.

    Of the two differences along a row or column the smaller one is on the pixel's own surface.

    Args:
        depth: z in m; 0 where nothing was measured.
        at: Flat indices of pixels; default: of all.
    """
    height, width = depth.shape
    at = np.arange(depth.size) if at is None else at
    v, u = np.divmod(at, width)
    q = _inverse(depth, at)
    ends = (u == width - 1, u == 0, v == height - 1, v == 0)
    steps = []
    for move, end in zip((1, -1, width, -width), ends, strict=True):
        other = _inverse(depth, np.where(end, at, at + move))
        step = (other - q) * (1 if move > 0 else -1)
        step[end | (other == 0) | (q == 0)] = np.inf
        steps.append(step)
    slope_u, jump_u = _choose(q, steps[0], steps[1])
    slope_v, jump_v = _choose(q, steps[2], steps[3])
    across = np.where(np.abs(jump_u) >= np.abs(jump_v), jump_u, jump_v)
    return Surface(at=at, inverse=q, slope_u=slope_u, slope_v=slope_v, across=across)


def _inverse(depth: Float[np.ndarray, "H W"], at: Int[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    z = depth.take(at).astype(np.float32, copy=False)
    return np.divide(1, z, out=np.zeros(z.shape, np.float32), where=z > 0)


def _choose(
    q: Float[np.ndarray, " K"], after: Float[np.ndarray, " K"], before: Float[np.ndarray, " K"]
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Of the changes per pixel on both sides: the one on the own surface, the one over an edge."""
    size_after, size_before = np.abs(after), np.abs(before)
    own = size_after <= size_before
    slope = np.where(own, after, before)
    small, large = np.minimum(size_after, size_before), np.maximum(size_after, size_before)
    edge = (large > small + np.float32(EDGE) * q) & (large < np.inf)
    across = np.where(edge, np.where(own, -before, after), np.float32(0))
    slope[small == np.inf] = 0
    return slope, across


def edges(shown: Surface) -> Bool[np.ndarray, " K"]:
    """Pixels beside a depth edge."""
    return shown.across != 0


def rays(
    shape: tuple[int, int], camera: Intrinsics
) -> tuple[Float[np.ndarray, "1 W"], Float[np.ndarray, "H 1"]]:
    """x/z of each column and y/z of each row, at the pixel centres."""
    x = (np.arange(shape[1], dtype=np.float32) + np.float32(0.5 - camera.cx)) / camera.fx
    y = (np.arange(shape[0], dtype=np.float32) + np.float32(0.5 - camera.cy)) / camera.fy
    return x[None].astype(np.float32), y[:, None].astype(np.float32)


def incidence(shown: Surface, camera: Intrinsics) -> Float[np.ndarray, " K"]:
    """Angle between the surface's normal and the ray to the camera, rad, 0 where head-on.

    On the plane n . X = d the inverse depth is q = n . (x, y, 1) / d, so the slopes give n / d, and
    cos(angle) = q / (|n / d| |(x, y, 1)|).

    Args:
        shown: The surface.
        camera: Intrinsics of its image.
    """
    q = shown.inverse
    v, u = np.divmod(shown.at, camera.width)
    x = ((u + (0.5 - camera.cx)) / camera.fx).astype(np.float32)
    y = ((v + (0.5 - camera.cy)) / camera.fy).astype(np.float32)
    a = shown.slope_u * np.float32(camera.fx)
    b = shown.slope_v * np.float32(camera.fy)
    c = q - x * a - y * b
    size = (a * a + b * b + c * c) * (x * x + y * y + 1)
    cosine = np.minimum(q / np.sqrt(np.maximum(size, np.float32(1e-12))), 1)
    # Single precision has other last bits with AVX-512, and a pixel in millions is then lost.
    return np.arccos(cosine.astype(np.float64)).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeEffects:
    """How often a pixel at an edge or at a grazing angle is wrong or missing."""

    flying: float = 0.15
    """Share of the pixels beside a depth edge that measure something between both surfaces."""
    lost: float = 0.25
    """Share of the pixels beside a depth edge that measure nothing."""
    grazing: tuple[float, float] | None = (70.0, 85.0)
    """Degrees of incidence from which on pixels are lost, and from which on all are."""


CHOSEN = EdgeEffects()


def flying_pixels(
    depth: Float[np.ndarray, " K"],
    shown: Surface,
    rng: np.random.Generator,
    model: EdgeEffects = CHOSEN,
) -> Float[np.ndarray, " K"]:
    """Move some pixels beside depth edges to a place between the two surfaces.

    The place is uniform in inverse depth, up to the middle; the pixel beyond the edge covers the
    other half.

    Args:
        depth: z as measured at some pixels, m.
        shown: The surface there without noise.
        rng: Two numbers are drawn for each pixel.
        model: Shares.
    """
    chance = rng.random(depth.shape, np.float32)
    place = rng.random(depth.shape, np.float32) / 2
    chosen = edges(shown) & (chance < model.flying) & (depth > 0)
    q = shown.inverse + place * shown.across
    return np.divide(1, q, out=depth.copy(), where=chosen)


def holes(
    shown: Surface,
    camera: Intrinsics,
    rng: np.random.Generator,
    model: EdgeEffects = CHOSEN,
) -> Bool[np.ndarray, " K"]:
    """Pixels that measure nothing, beside depth edges and on surfaces seen at a grazing angle.

    Args:
        shown: The surface without noise.
        camera: Intrinsics of this image.
        rng: One number is drawn for each pixel.
        model: Shares and angles.
    """
    share = np.where(edges(shown), np.float32(model.lost), np.float32(0))
    if model.grazing is not None:
        low, high = np.radians(np.array(model.grazing, np.float32))
        x = np.clip((incidence(shown, camera) - low) / (high - low), 0, 1)
        share = np.maximum(share, x * x * (3 - 2 * x))
    return rng.random(share.shape, np.float32) < share
