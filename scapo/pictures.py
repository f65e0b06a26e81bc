# SPDX-License-Identifier: MIT
"""What a method shows of its training: clouds with parts and joints, side by side, in one frame.

Data alone; `render` makes an image of it where matplotlib is installed.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from scapo.drawing import BACKGROUND, PART_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One cloud of a picture; lengths in the units of the picture's other panels."""

    points: Float[Tensor, "N 3"]
    part: Int[Tensor, " N"] | None = None
    """Colours the points; None: all alike."""
    pivot: Float[Tensor, "J 3"] | None = None
    """Of the joints whose axes are drawn."""
    axis: Float[Tensor, "J 3"] | None = None
    beneath: Float[Tensor, "M 3"] | None = None
    """A second cloud drawn in grey, such as the observed one beneath its reconstruction."""
    title: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureData:
    """Panels in a row."""

    panels: tuple[Panel, ...]
    caption: str = ""
    view: Literal["oblique", "camera"] = "oblique"
    """oblique: parallel projection of an arbitrary frame, the same direction and scale for all
    panels; camera: as the camera sees it (x right, y down), without perspective."""


OBLIQUE = np.array([[0.82, -0.57, 0.0], [0.2, 0.29, -0.94], [0.53, 0.77, 0.35]])
"""Rows: right, down and away of the picture, in a frame whose z axis is up."""
TURN = {"oblique": OBLIQUE, "camera": np.eye(3)}


def render(picture: PictureData) -> tuple[bytes, UInt8[np.ndarray, "H W 3"]]:
    """The picture as PNG, and as pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = draw_picture(picture)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue(), pixels


def draw_picture(picture: PictureData) -> Figure:
    """The panels in a row, all with the same direction of view and the same scale."""
    from matplotlib.figure import Figure

    panels, turn = picture.panels, TURN[picture.view]
    figure = Figure(figsize=(2.1 * max(len(panels), 1), 2.5), dpi=110)
    grid = figure.subplots(1, max(len(panels), 1), squeeze=False)[0]
    flat = [_array(panel.points) @ turn.T for panel in panels]
    half = max([0.56 * float(np.ptp(points[:, :2], axis=0).max()) for points in flat], default=1)
    for axes, panel, points in zip(grid, panels, flat, strict=False):
        _draw_panel(axes, panel, turn)
        middle = (points.min(0) + points.max(0)) / 2
        axes.set_xlim(middle[0] - half, middle[0] + half)
        axes.set_ylim(middle[1] + half, middle[1] - half)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(panel.title, fontsize=7, parse_math=False)
    figure.suptitle(picture.caption, fontsize=8, parse_math=False)
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    return figure


def _draw_panel(axes: Axes, panel: Panel, turn: Float[np.ndarray, "3 3"]) -> None:
    """Far points first; joint axes as long as the cloud is wide."""
    points = _array(panel.points) @ turn.T
    if panel.beneath is not None:
        below = _array(panel.beneath) @ turn.T
        axes.scatter(below[:, 0], below[:, 1], s=3, c=BACKGROUND, linewidths=0)
    part = np.zeros(len(points), int) if panel.part is None else panel.part.cpu().numpy()
    order = np.argsort(-points[:, 2])
    colors = np.array([*PART_COLORS, BACKGROUND])[part[order]]
    axes.scatter(points[order, 0], points[order, 1], s=2, c=colors, linewidths=0)
    if panel.pivot is None or panel.axis is None:
        return
    for pivot, axis in zip(_array(panel.pivot) @ turn.T, _array(panel.axis) @ turn.T, strict=True):
        middle = pivot + axis * np.median((points - pivot) @ axis)
        ends = middle + 0.35 * float(np.ptp(points, axis=0).max()) * np.array([[-1], [1]]) * axis
        axes.plot(ends[:, 0], ends[:, 1], color="white", linewidth=3.2)
        axes.plot(ends[:, 0], ends[:, 1], color="black", linewidth=1.4)


def _array(points: Tensor) -> Float[np.ndarray, "N 3"]:
    return points.detach().cpu().numpy().astype(np.float64)
