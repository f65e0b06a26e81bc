# SPDX-License-Identifier: MIT
"""Structured-light sensor noise measured on a Kinect, by distance and incidence angle.

C. V. Nguyen, S. Izadi, D. Lovell: Modeling Kinect Sensor Noise for Improved 3D Reconstruction and
Tracking. 3DIMPVT 2012. z in m, theta the angle between the surface's normal and the ray, in rad:

    axial    sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 / sqrt(z) * (theta / (pi/2 - theta))^2 m
    lateral  sigma_L = 0.8 + 0.035 theta / (pi/2 - theta) pixels of the Kinect (f = 585 pixels)

The lateral noise was measured at the edges of a plate: it says which surface a pixel sees, not how
deep a slanted one is, which the axial noise has. So a pixel here takes the surface seen up to
sigma_L away, continued along its slope to the pixel itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import numpy as np
from jaxtyping import Float, Int, UInt8

from scapo.geometry.camera import Intrinsics
from sim_assets.sensors.surface import Surface, incidence, surface

FOCAL = 585.0
"""Of the Kinect's depth camera, pixels at 640 x 480."""
STEEPEST = radians(85.0)
"""Larger angles count as this one: the formulas have a pole at 90 degrees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinect:
    """Coefficients of the two formulas."""

    axial: float = 0.0012
    axial_square: float = 0.0019
    nearest: float = 0.4
    axial_angle: float = 0.0001
    lateral: float = 0.8
    lateral_angle: float = 0.035


PUBLISHED = Kinect()


def axial_sigma(
    z: Float[np.ndarray, "*S"], theta: Float[np.ndarray, "*S"], model: Kinect = PUBLISHED
) -> Float[np.ndarray, "*S"]:
    """Standard deviation along z, m (Nguyen et al., Eq. 3).

    Args:
        z: Depth, m, positive.
        theta: Incidence angle, rad.
        model: Coefficients.
    """
    ratio = _ratio(theta)
    base = model.axial + model.axial_square * (z - model.nearest) ** 2
    return base + model.axial_angle / np.sqrt(z) * ratio * ratio


def lateral_sigma(
    theta: Float[np.ndarray, "*S"], model: Kinect = PUBLISHED
) -> Float[np.ndarray, "*S"]:
    """Standard deviation across the image, pixels of the Kinect (Nguyen et al., Eq. 1)."""
    return model.lateral + model.lateral_angle * _ratio(theta)


def _ratio(theta: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """The ratio of both formulas, theta / (pi/2 - theta)."""
    angle = np.minimum(theta, STEEPEST)
    return angle / (np.pi / 2 - angle)


def kinect(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    camera: Intrinsics,
    rng: np.random.Generator,
    model: Kinect = PUBLISHED,
) -> tuple[Float[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]:
    """Depth and part of the surface that a Kinect measures at each pixel; see `kinect_at`."""
    shown = surface(depth)
    measured, label = kinect_at(depth, part, camera, rng, shown, model)
    return measured.reshape(depth.shape), label.reshape(depth.shape)


def kinect_at(
    depth: Float[np.ndarray, "H W"],
    part: UInt8[np.ndarray, "H W"],
    camera: Intrinsics,
    rng: np.random.Generator,
    shown: Surface,
    model: Kinect = PUBLISHED,
) -> tuple[Float[np.ndarray, " K"], UInt8[np.ndarray, " K"]]:
    """Depth and part of the surface that a Kinect measures at some pixels.

    Args:
        depth: z, m; 0 where there is nothing.
        part: Part index; 255 for what is no part.
        camera: Intrinsics of this image.
        rng: Three numbers are drawn for each pixel.
        shown: The surface at these pixels.
        model: Coefficients.

    Returns:
        Depth with noise, 0 where there is nothing, and the part whose surface was measured.
    """
    look, du, dv = _look(shown, camera, rng, model)
    there = surface(depth, look)
    q = there.inverse
    moved = np.clip(q - du * there.slope_u - dv * there.slope_v, q / 2, q * 2)
    clean = np.divide(1, moved, out=np.zeros_like(moved), where=moved > 0)
    clean = np.where(look == shown.at, depth.take(look), clean)
    sigma = axial_sigma(np.maximum(clean, np.float32(0.1)), incidence(there, camera), model)
    noisy = clean + sigma * rng.standard_normal(len(look), np.float32)
    measured = (clean > 0) & (noisy > 0)
    return np.where(measured, noisy, 0), np.where(measured, part.take(look), np.uint8(255))


def _look(
    shown: Surface, camera: Intrinsics, rng: np.random.Generator, model: Kinect
) -> tuple[Int[np.ndarray, " K"], Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Flat index of the pixel whose surface each pixel sees, and how far right and down it is."""
    v, u = np.divmod(shown.at, camera.width)
    sigma = lateral_sigma(incidence(shown, camera), model)
    right = np.rint(sigma * (camera.fx / FOCAL) * rng.standard_normal(len(u), np.float32))
    down = np.rint(sigma * (camera.fy / FOCAL) * rng.standard_normal(len(u), np.float32))
    seen_u = np.clip(u + right.astype(np.intp), 0, camera.width - 1)
    seen_v = np.clip(v + down.astype(np.intp), 0, camera.height - 1)
    du, dv = (seen_u - u).astype(np.float32), (seen_v - v).astype(np.float32)
    return seen_v * camera.width + seen_u, du, dv
