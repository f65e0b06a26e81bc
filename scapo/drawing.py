# SPDX-License-Identifier: MIT
"""Clouds and joint axes drawn as the camera sees them, with matplotlib (extras `sim`, `bench`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from matplotlib.axes import Axes


PART_COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")
"""Per part, told apart also by colour-blind readers (Tol's bright scheme)."""
BACKGROUND = "#bbbbbb"


def draw_cloud(
    axes: Axes, points: Float[np.ndarray, "N 3"], part: Int[np.ndarray, " N"], *, size: float = 2.0
) -> None:
    """Points of the camera frame in perspective, far ones first, coloured by part (-1 grey)."""
    order = np.argsort(-points[:, 2])
    palette = np.array([*PART_COLORS, BACKGROUND])
    flat = project(points[order])
    axes.scatter(
        flat[:, 0], flat[:, 1], s=size, c=palette[part[order]], linewidths=0, rasterized=True
    )
    axes.set_aspect("equal")
    axes.set_axis_off()
    low, high = flat.min(0), flat.max(0)
    centre, half = (low + high) / 2, 0.62 * float((high - low).max())
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] + half, centre[1] - half)


def draw_axis(
    axes: Axes,
    points: Float[np.ndarray, "N 3"],
    pivot: Float[np.ndarray, " 3"],
    axis: Float[np.ndarray, " 3"],
    *,
    color: str,
    dashed: bool = False,
) -> None:
    """A joint axis of the camera frame through the part of the line nearest to the cloud."""
    direction = axis / np.linalg.norm(axis)
    along = (points - pivot) @ direction
    middle = float(np.median(along))
    reach = 0.35 * float(np.ptp(points, axis=0).max())
    ends = pivot + direction * np.array([[middle - reach], [middle + reach]])
    if (ends[:, 2] <= 0).any():
        return
    flat = project(ends)
    style = (0, (3, 2)) if dashed else "solid"
    axes.plot(flat[:, 0], flat[:, 1], color="white", linewidth=3.2, solid_capstyle="round")
    axes.plot(flat[:, 0], flat[:, 1], color=color, linewidth=1.6, linestyle=style)


def project(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """Image points of the camera frame."""
    return points[:, :2] / points[:, 2:]
