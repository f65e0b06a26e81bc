# SPDX-License-Identifier: MIT
"""Pinhole camera in the OpenCV frame: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Focal lengths and principal point in pixels; image size."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @staticmethod
    def from_fov(fov_y: float, width: int, height: int) -> Intrinsics:
        """Square pixels, principal point at the centre, vertical field of view in radians.

        Raises:
            ValueError: A field of view outside (0, pi), or an image without pixels.
        """
        if not (0 < fov_y < math.pi and width > 0 and height > 0):
            raise ValueError(
                "camera: expected a field of view between 0 and pi and an image of 1 x 1 or more, "
                f"found {fov_y} and {width} x {height}"
            )
        focal = height / 2 / math.tan(fov_y / 2)
        return Intrinsics(
            fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height
        )

    def row(self) -> tuple[float, ...]:
        """fx, fy, cx, cy, width, height: the `camera` tensor of a sample."""
        return (self.fx, self.fy, self.cx, self.cy, float(self.width), float(self.height))


def project(points: Float[np.ndarray, "N 3"], camera: Intrinsics) -> Float[np.ndarray, "N 2"]:
    """Pixel coordinates (u right, v down) of camera-frame points with z > 0."""
    scale = np.array([camera.fx, camera.fy])
    return points[:, :2] / points[:, 2:] * scale + np.array([camera.cx, camera.cy])


def back_project(
    depth: Float[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"], camera: Intrinsics
) -> Float[np.ndarray, "K 3"]:
    """Camera-frame points in metres of the masked pixels, row by row; depth is z in metres."""
    v, u = np.nonzero(mask)
    z = depth[v, u]
    x = (u + 0.5 - camera.cx) / camera.fx * z
    y = (v + 0.5 - camera.cy) / camera.fy * z
    return np.stack([x, y, z], -1)
