# SPDX-License-Identifier: MIT
"""Errors of the mask that tells the object from the rest: what a segmentation network does.

Published depth noise says nothing of these; the sizes are choices, in pixels of a camera with a
focal length of 600 pixels, and scale with the camera's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scapo.camera import Intrinsics

FOCAL = 600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskErrors:
    """How wrong the mask is."""

    grow: tuple[float, float] = (-2.0, 4.0)
    """Least and largest growth (dilation; negative: erosion) of the whole outline, pixels."""
    waves: float = 1.5
    """Standard deviation of the outline's local displacement along each axis, pixels."""
    wavelength: float = 24.0
    """Over which it changes, pixels."""
    missed: float = 0.3
    """Chance of a missing piece."""
    size: tuple[float, float] = (0.04, 0.1)
    """Its radius, as a share of the diagonal of the object's image."""


CHOSEN = MaskErrors()


def wrong_mask(
    mask: Bool[np.ndarray, "H W"],
    camera: Intrinsics,
    rng: np.random.Generator,
    model: MaskErrors = CHOSEN,
) -> Bool[np.ndarray, "H W"]:
    """The mask grown or shrunk, its outline moved by smooth waves, with a piece missing.

    Args:
        mask: Where the object is.
        camera: Intrinsics of this image.
        rng: What it draws depends on the size of the image alone.
        model: Kinds and sizes.
    """
    pixel = camera.fx / FOCAL
    grow = round(rng.uniform(*model.grow) * pixel)
    made = shrink(mask, -grow) if grow < 0 else grow_mask(mask, grow)
    du, dv = (
        model.waves * pixel * _smooth(mask.shape, model.wavelength * pixel, rng) for _ in range(2)
    )
    made = _displaced(made, du, dv)
    return made & ~_piece(mask, rng, model)


def grow_mask(mask: Bool[np.ndarray, "H W"], pixels: int) -> Bool[np.ndarray, "H W"]:
    """Dilated by a cross, or by a square at every other step, which together are near a disc."""
    for step in range(pixels):
        wider = mask.copy()
        wider[1:] |= mask[:-1]
        wider[:-1] |= mask[1:]
        rows = wider if step % 2 else mask
        wider[:, 1:] |= rows[:, :-1].copy()
        wider[:, :-1] |= rows[:, 1:].copy()
        mask = wider
    return mask


def shrink(mask: Bool[np.ndarray, "H W"], pixels: int) -> Bool[np.ndarray, "H W"]:
    """Eroded likewise; the image's border does not erode."""
    return ~grow_mask(~mask, pixels)


def _smooth(
    shape: tuple[int, ...], wavelength: float, rng: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """Standard normal numbers on a coarse grid, interpolated between."""
    cell = max(wavelength, 2.0)
    grid = rng.standard_normal([int(size / cell) + 2 for size in shape]).astype(np.float32)
    for axis, size in enumerate(shape):
        place = np.arange(size, dtype=np.float32) / np.float32(cell)
        low = place.astype(np.intp)
        part = (place - low).reshape([-1 if i == axis else 1 for i in range(2)])
        grid = grid.take(low, axis) * (1 - part) + grid.take(low + 1, axis) * part
    return grid


def _displaced(
    mask: Bool[np.ndarray, "H W"], du: Float[np.ndarray, "H W"], dv: Float[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    height, width = mask.shape
    u = np.clip(np.arange(width)[None] + np.rint(du).astype(np.intp), 0, width - 1)
    v = np.clip(np.arange(height)[:, None] + np.rint(dv).astype(np.intp), 0, height - 1)
    return mask.ravel()[v * width + u]


def _piece(
    mask: Bool[np.ndarray, "H W"], rng: np.random.Generator, model: MaskErrors
) -> Bool[np.ndarray, "H W"]:
    """A disc around a pixel of the object, or nothing."""
    chance, at, size = rng.uniform(size=3)
    places = np.flatnonzero(mask)
    if chance >= model.missed or not len(places):
        return np.zeros_like(mask)
    height, width = mask.shape
    row, column = divmod(int(places[int(at * len(places))]), width)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    diagonal = np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1)
    radius = diagonal * (model.size[0] + size * (model.size[1] - model.size[0]))
    u, v = np.arange(width)[None] - column, np.arange(height)[:, None] - row
    return u * u + v * v < radius * radius
