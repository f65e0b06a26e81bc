# SPDX-License-Identifier: MIT
"""Sensor noise as disparity: pixels shifted at random, disparity disturbed and rounded.

J. T. Barron, J. Malik: Intrinsic Scene Properties from a Single RGB-D Image. CVPR 2013; used for
the ICL-NUIM data of A. Handa, T. Whelan, J. McDonald, A. J. Davison: A Benchmark for RGB-D Visual
Odometry, 3D Reconstruction and SLAM. ICRA 2014. With z in cm and s ~ N(0, (1/2 pixel)^2):

    z'(x) = 35130 / round(35130 / z(x + s) + N(0, (1/6)^2))

The constant is the Kinect's: 1/35130 = 2.85e-5 per cm is the depth step over z^2 that K.
Khoshelham and S. Oude Elberink measured (Sensors 12(2), 2012). The simulator released with S. Choi,
Q.-Y. Zhou, V. Koltun: Robust Reconstruction of Indoor Scenes, CVPR 2015 (`REDWOOD`), has 35.130 / z
with z in m, N(0, (1/36)^2), steps of 1/8 and shifts of 1/4 pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from scapo.camera import Intrinsics

FOCAL = 585.0
"""Of the Kinect's depth camera, pixels at 640 x 480: what the shift is measured in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Disparity:
    """Coefficients of the formula, for z in m."""

    scale: float = 351.30
    """Disparity steps times m."""
    sigma: float = 1 / 6
    """Of the disparity, in steps."""
    shift: float = 1 / 2
    """Standard deviation along each axis, pixels of the Kinect."""
    rounded: bool = True
    """To whole steps."""


PUBLISHED = Disparity()
REDWOOD = Disparity(scale=35.130 * 8, sigma=8 / 36, shift=1 / 4)


def depth_step(z: Float[np.ndarray, "*S"], model: Disparity = PUBLISHED) -> Float[np.ndarray, "*S"]:
    """Distance in depth between neighbouring disparities, m."""
    return z * z / model.scale


def depth_sigma(
    z: Float[np.ndarray, "*S"], model: Disparity = PUBLISHED
) -> Float[np.ndarray, "*S"]:
    """Standard deviation of z head-on, averaged over z, m: disturbance and rounding together."""
    steps = np.sqrt(model.sigma**2 + (1 / 12 if model.rounded else 0))
    return depth_step(z, model) * steps


def disparity(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    camera: Intrinsics,
    rng: np.random.Generator,
    model: Disparity = PUBLISHED,
) -> tuple[Float[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]:
    """Depth and part that the sensor measures at each pixel.

    Depth between pixels is interpolated, so pixels beside a depth edge measure what is between the
    two surfaces.

    Args:
        depth: z, m; 0 where there is nothing.
        part: Part index; 255 for what is no part.
        camera: Intrinsics of this image.
        rng: Three numbers are drawn for each pixel.
        model: Coefficients.

    Returns:
        Depth with noise, 0 where there is nothing, and the part nearest to where it was measured.
    """
    right = rng.standard_normal(depth.shape, np.float32)
    down = rng.standard_normal(depth.shape, np.float32)
    u = _shifted(np.arange(depth.shape[1], dtype=np.float32)[None], right, camera.fx, model)
    v = _shifted(np.arange(depth.shape[0], dtype=np.float32)[:, None], down, camera.fy, model)
    shifted, seen = _interpolate(depth, part, u, v) if model.shift else (depth, part)
    disturbance = np.float32(model.sigma) * rng.standard_normal(depth.shape, np.float32)
    if not (model.sigma or model.rounded):
        return shifted, seen
    there = shifted > 0
    steps = np.divide(model.scale, shifted, out=np.zeros_like(shifted), where=there) + disturbance
    steps = np.rint(steps) if model.rounded else steps
    there &= steps > 0
    noisy = np.divide(model.scale, steps, out=np.zeros_like(shifted), where=there)
    return noisy, np.where(there, seen, np.uint8(255))


def _shifted(
    place: Float[np.ndarray, "_ _"],
    normal: Float[np.ndarray, "H W"],
    focal: float,
    model: Disparity,
) -> Float[np.ndarray, "H W"]:
    """Where each pixel is measured along one axis, inside the image."""
    last = np.float32(place.size - 1)
    return np.clip(place + np.float32(model.shift * focal / FOCAL) * normal, 0, last)


def _interpolate(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    u: Float[np.ndarray, "H W"],
    v: Float[np.ndarray, "H W"],
) -> tuple[Float[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]:
    """Bilinear depth and nearest part; nearest depth where one of the four pixels has none."""
    height, width = depth.shape
    left = np.minimum(np.floor(u), np.float32(max(width - 2, 0)))
    top = np.minimum(np.floor(v), np.float32(max(height - 2, 0)))
    a, b = u - left, v - top
    first = (top * width + left).astype(np.intp)
    next_u, next_v = min(width - 1, 1), width * min(height - 1, 1)
    corners = [depth.take(first + step) for step in (0, next_u, next_v, next_u + next_v)]
    above = corners[0] + a * (corners[1] - corners[0])
    below = corners[2] + a * (corners[3] - corners[2])
    mixed = above + b * (below - above)
    nearest = first + np.where(a >= 0.5, next_u, 0) + np.where(b >= 0.5, next_v, 0)
    least = np.minimum(np.minimum(*corners[:2]), np.minimum(*corners[2:]))
    return np.where(least > 0, mixed, depth.take(nearest)), part.take(nearest)
