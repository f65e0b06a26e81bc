# SPDX-License-Identifier: MIT
"""Flying pixels and holes: what depth sensors do at depth edges and at grazing angles.

The published depth models (`noise_kinect`, `noise_disparity`) say nothing of these; the shares
here are choices that look like real depth images, and are named as such.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scapo.camera import Intrinsics
from sim_assets.noise_surface import Surface, edges, incidence


@dataclass(frozen=True, slots=True, kw_only=True)
class Edges:
    """How often what happens."""

    flying: float = 0.15
    """Share of the pixels beside a depth edge that measure something between both surfaces."""
    lost: float = 0.25
    """Share of the pixels beside a depth edge that measure nothing."""
    grazing: tuple[float, float] | None = (70.0, 85.0)
    """Degrees of incidence from which on pixels are lost, and from which on all are."""


CHOSEN = Edges()


def flying_pixels(
    depth: Float[np.ndarray, " K"],
    shown: Surface,
    rng: np.random.Generator,
    model: Edges = CHOSEN,
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
    model: Edges = CHOSEN,
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
