# SPDX-License-Identifier: MIT
"""Depth images of flat plates, computed from the plane's equation."""

from __future__ import annotations

import numpy as np

from scapo.geometry.camera import Intrinsics


def camera(size: int = 160, focal: float = 585.0) -> Intrinsics:
    return Intrinsics(fx=focal, fy=focal, cx=size / 2, cy=size / 2, width=size, height=size)


def plate(seen_by: Intrinsics, z: float, degrees: float, turn: float = 0.3) -> np.ndarray:
    """A plane that meets the optical axis at z, its normal tilted by `degrees` from that axis."""
    tilt = np.radians(degrees)
    normal = [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)]
    x = (np.arange(seen_by.width) + 0.5 - seen_by.cx) / seen_by.fx
    y = (np.arange(seen_by.height)[:, None] + 0.5 - seen_by.cy) / seen_by.fy
    return (normal[2] * z / (normal[0] * x + normal[1] * y + normal[2])).astype(np.float32)


def angles(seen_by: Intrinsics, degrees: float, turn: float = 0.3) -> np.ndarray:
    """Between the plate's normal and each ray, rad."""
    tilt = np.radians(degrees)
    x = (np.arange(seen_by.width) + 0.5 - seen_by.cx) / seen_by.fx
    y = (np.arange(seen_by.height)[:, None] + 0.5 - seen_by.cy) / seen_by.fy
    along = np.sin(tilt) * (np.cos(turn) * x + np.sin(turn) * y) - np.cos(tilt)
    return np.arccos(-along / np.sqrt(x * x + y * y + 1))


def disc(seen_by: Intrinsics, share: float = 0.35) -> np.ndarray:
    """Pixels within this share of the image's side from its centre."""
    u, v = np.arange(seen_by.width)[None], np.arange(seen_by.height)[:, None]
    radius = np.hypot(u + 0.5 - seen_by.cx, v + 0.5 - seen_by.cy)
    return radius < share * min(seen_by.width, seen_by.height)


def parts_of(depth: np.ndarray) -> np.ndarray:
    return np.where(depth > 0, 0, 255).astype(np.uint8)
