# SPDX-License-Identifier: MIT
"""What stands around the object in a real picture: a surface behind it, and things beside it.

A sensor needs it at the object's outline, and an imperfect mask lets some of it into the cloud.
Nothing of it hides the object, so labels and visibility stay as rendered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from scapo.geometry.camera import Intrinsics
from sim_assets.sensors.surface import rays

FARTHEST = 8.0
"""m; what is beyond measures nothing."""
MOST_TILT = np.radians(50.0)
"""Of the surface behind, against the image plane."""
TOUCHING = 0.5
"""Chance that the object touches it, as on a table."""
GAP = 0.5
"""Largest distance of the surface from the object where it does not, m."""


def put_behind(
    depth: Float[np.ndarray, "H W"], camera: Intrinsics, rng: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """The depth image with a plane behind everything that it shows.

    The plane's tilt, direction and distance are drawn; all measured points are in front of it.

    Args:
        depth: z, m; 0 where there is nothing; something must be there.
        camera: Intrinsics of this image.
        rng: Five numbers are drawn.
    """
    tilt, turn = np.arccos(rng.uniform(np.cos(MOST_TILT), 1)), rng.uniform(-np.pi, np.pi)
    normal = np.array(
        [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)], np.float32
    )  # towards the camera
    touching, gap = rng.uniform() < TOUCHING, rng.uniform(0, GAP)
    x, y = rays((depth.shape[0], depth.shape[1]), camera)
    along = normal[0] * x + normal[1] * y + normal[2]
    level = (along * depth)[depth > 0].min() - np.float32(0 if touching else gap)
    facing = along < -0.05
    plane = np.divide(level, along, out=np.zeros(depth.shape, np.float32), where=facing)
    plane[plane > FARTHEST] = 0
    return np.where(depth > 0, depth, plane)


@dataclass(frozen=True, slots=True, kw_only=True)
class Clutter:
    """How often and how large things beside the object are."""

    chance: float = 0.5
    """Of a thing."""
    size: tuple[float, float] = (0.1, 0.22)
    """Its half axes, in sides of the square with the area of the object's image."""
    depth: float = 0.05
    """Standard deviation of its distance from the object's point beside it, m."""


BESIDE = Clutter()


def put_beside(
    depth: Float[np.ndarray, "H W"],
    seen: Bool[np.ndarray, "H W"],
    rng: np.random.Generator,
    model: Clutter = BESIDE,
) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """The depth image with an elliptic slanted thing at the object's outline, and where it shows.

    Args:
        depth: z, m; 0 where there is nothing.
        seen: Where the object shows; the thing does not cover it.
        rng: Eight numbers are drawn.
        model: Chance, size and distance.
    """
    height, width = depth.shape
    draws, normal = rng.uniform(size=5), rng.standard_normal(3)
    rows, columns = np.nonzero(outline(seen))
    if draws[0] >= model.chance or not len(rows):
        return depth, np.zeros_like(seen)
    at = int(draws[1] * len(rows))
    size = float(np.sqrt(np.count_nonzero(seen)))
    a, b = (size * (model.size[0] + float(x) * (model.size[1] - model.size[0])) for x in draws[2:4])
    cos, sin = float(np.cos(np.pi * draws[4])), float(np.sin(np.pi * draws[4]))
    du = np.arange(width, dtype=np.float32)[None] - columns[at]
    dv = np.arange(height, dtype=np.float32)[:, None] - rows[at]
    along = (cos * du + sin * dv) / a
    across = (cos * dv - sin * du) / b
    z = float(depth[rows[at], columns[at]] + model.depth * normal[0])
    slope_u, slope_v = (0.5 / size * float(x) for x in normal[1:])
    inverse = (1 + slope_u * du + slope_v * dv) / max(z, 0.1)
    there = (along**2 + across**2 < 1) & ~seen & (inverse > 1 / FARTHEST)
    there &= (depth == 0) | (inverse * depth > 1)
    return np.where(there, 1 / np.maximum(inverse, 1e-3), depth).astype(np.float32), there


def outline(seen: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Pixels of the object with a neighbour that is not."""
    inner = seen.copy()
    inner[1:] &= seen[:-1]
    inner[:-1] &= seen[1:]
    inner[:, 1:] &= seen[:, :-1]
    inner[:, :-1] &= seen[:, 1:]
    return seen & ~inner
