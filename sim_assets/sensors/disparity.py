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
from jaxtyping import Float, Int, UInt8

from scapo.geometry.camera import Intrinsics

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


def depth_step(z: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """Distance in depth between neighbouring disparities as published, m."""
    return z * z / PUBLISHED.scale


def depth_sigma(z: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """Standard deviation of z head-on, averaged over z, m: disturbance and rounding together."""
    return depth_step(z) * np.sqrt(PUBLISHED.sigma**2 + 1 / 12)


def disparity(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    camera: Intrinsics,
    rng: np.random.Generator,
    model: Disparity = PUBLISHED,
) -> tuple[Float[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]:
    """Depth and part that the sensor measures at each pixel; see `disparity_at`."""
    measured, label = disparity_at(depth, part, camera, rng, np.arange(depth.size), model)
    return measured.reshape(depth.shape), label.reshape(depth.shape)


def disparity_at(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    camera: Intrinsics,
    rng: np.random.Generator,
    at: Int[np.ndarray, " K"],
    model: Disparity = PUBLISHED,
) -> tuple[Float[np.ndarray, " K"], UInt8[np.ndarray, " K"]]:
    """Depth and part that the sensor measures at some pixels.

    Depth between pixels is interpolated, so pixels beside a depth edge measure what is between the
    two surfaces.

    Args:
        depth: z, m; 0 where there is nothing.
        part: Part index; 255 for what is no part.
        camera: Intrinsics of this image.
        rng: Three numbers are drawn for each pixel.
        at: Flat indices of the pixels.
        model: Coefficients.

    Returns:
        Depth with noise, 0 where there is nothing, and the part nearest to where it was measured.
    """
    right, down, disturbance = rng.standard_normal((3, len(at)), np.float32)
    v, u = np.divmod(at, camera.width)
    u = np.clip(u + np.float32(model.shift * camera.fx / FOCAL) * right, 0, camera.width - 1)
    v = np.clip(v + np.float32(model.shift * camera.fy / FOCAL) * down, 0, camera.height - 1)
    shifted, seen = _interpolate(depth, part, u.astype(np.float32), v.astype(np.float32))
    if not (model.sigma or model.rounded):
        return shifted, seen
    there = shifted > 0
    steps = np.divide(model.scale, shifted, out=np.zeros_like(shifted), where=there)
    steps += np.float32(model.sigma) * disturbance
    steps = np.rint(steps) if model.rounded else steps
    there &= steps > 0
    noisy = np.divide(model.scale, steps, out=np.zeros_like(shifted), where=there)
    return noisy, np.where(there, seen, np.uint8(255))


def _interpolate(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    u: Float[np.ndarray, " K"],
    v: Float[np.ndarray, " K"],
) -> tuple[Float[np.ndarray, " K"], UInt8[np.ndarray, " K"]]:
    """Bilinear depth and nearest part; nearest depth where one of the four pixels has none."""
    height, width = depth.shape
    left = np.minimum(u.astype(np.intp), max(width - 2, 0))
    top = np.minimum(v.astype(np.intp), max(height - 2, 0))
    a, b = (u - left).astype(np.float32), (v - top).astype(np.float32)
    first = top * width + left
    next_u, next_v = min(width - 1, 1), width * min(height - 1, 1)
    corners = [depth.take(first + step) for step in (0, next_u, next_v, next_u + next_v)]
    above = corners[0] + a * (corners[1] - corners[0])
    below = corners[2] + a * (corners[3] - corners[2])
    mixed = above + b * (below - above)
    nearest = first + np.where(a >= 0.5, next_u, 0) + np.where(b >= 0.5, next_v, 0)
    least = np.minimum(np.minimum(*corners[:2]), np.minimum(*corners[2:]))
    return np.where(least > 0, mixed, depth.take(nearest)), part.take(nearest)
