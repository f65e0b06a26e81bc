# SPDX-License-Identifier: MIT
"""Errors of the mask that tells the object from the rest: what a segmentation network does.

Published depth noise says nothing of these; the sizes are choices, in pixels of a camera with a
focal length of 600 pixels, and scale with the camera's. On narrow objects outlines err by less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scapo.geometry.camera import Intrinsics
from sim_assets.sensors.clutter import outline

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
    size: tuple[float, float] = (0.06, 0.16)
    """Its radius, in sides of the square with the area of the object's image."""
    narrow: float = 20.0
    """Mean width of the object's image below which outlines err in proportion to it, pixels."""


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
    error = min(pixel, mean_width(mask) / model.narrow)
    grow = round(rng.uniform(*model.grow) * error)
    made = shrink(mask, -grow) if grow < 0 else grow_mask(mask, grow)
    made = _wave(made, model.waves * error, model.wavelength * pixel, rng)
    return made & ~_piece(mask, rng, model)


def mean_width(mask: Bool[np.ndarray, "H W"]) -> float:
    """Of a shape, pixels: twice its area over the length of its outline; the width of a bar."""
    return 2 * np.count_nonzero(mask) / max(np.count_nonzero(outline(mask)), 1)


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


def _wave(
    mask: Bool[np.ndarray, "H W"], size: float, length: float, rng: np.random.Generator
) -> Bool[np.ndarray, "H W"]:
    """Take each pixel from a place nearby that changes smoothly, by up to three deviations.

    The displacement is normal on a coarse grid and interpolated between. Only the pixels near the
    outline can change.
    """
    cell = max(length, 2.0)
    grid = rng.standard_normal((2, *(int(side / cell) + 2 for side in mask.shape)))
    reach = math.ceil(3 * size)
    if not reach:
        return mask
    near = _square(mask, reach) & _square(~mask, reach)
    v, u = np.nonzero(near)
    fields = np.clip(size * grid, -reach, reach)
    dv, du = (np.rint(_between(field, v / cell, u / cell)).astype(np.intp) for field in fields)
    height, width = mask.shape
    made = mask.copy()
    made[v, u] = mask[np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)]
    return made


def _between(
    grid: Float[np.ndarray, "h w"], v: Float[np.ndarray, " K"], u: Float[np.ndarray, " K"]
) -> Float[np.ndarray, " K"]:
    """Bilinear interpolation, element by element: the same on every machine."""
    i, j = v.astype(np.intp), u.astype(np.intp)
    a, b = v - i, u - j
    above = grid[i, j] * (1 - b) + grid[i, j + 1] * b
    below = grid[i + 1, j] * (1 - b) + grid[i + 1, j + 1] * b
    return above * (1 - a) + below * a


def _square(mask: Bool[np.ndarray, "H W"], reach: int) -> Bool[np.ndarray, "H W"]:
    """Dilated by a square of side 2 reach + 1, in a logarithmic number of steps."""
    done = 0
    while done < reach:
        step = min(done + 1, reach - done)
        wider = mask.copy()
        wider[step:] |= mask[:-step]
        wider[:-step] |= mask[step:]
        mask = wider.copy()
        mask[:, step:] |= wider[:, :-step]
        mask[:, :-step] |= wider[:, step:]
        done += step
    return mask


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
    radius = np.sqrt(len(places)) * (model.size[0] + size * (model.size[1] - model.size[0]))
    u, v = np.arange(width)[None] - column, np.arange(height)[:, None] - row
    return u * u + v * v < radius * radius
