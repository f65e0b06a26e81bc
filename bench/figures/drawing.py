# SPDX-License-Identifier: MIT
"""What all figures share: shapes seen from a chosen side, legends, text, PNG files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D

from scapo.drawing import BACKGROUND, PART_COLORS, project
from scapo.store import write_bytes
from scapo.text import one_line

PALETTE = np.array([to_rgb(name) for name in (*PART_COLORS, BACKGROUND)])
"""RGB per part; the last row, index -1, is background."""
LINE = "#222222"
DISTANCE = 5.0
"""Of the camera, in the unit of the shapes: little perspective."""


def look(azimuth: float, elevation: float) -> Float[np.ndarray, "4 4"]:
    """camera_T_object of a camera that looks at the origin, its x axis level.

    Args:
        azimuth: Degrees about the object's z axis, 0 = from its front (-x), counter-clockwise
            seen from above.
        elevation: Degrees above the horizon.
    """
    a, e = np.radians([azimuth, elevation])
    away = np.array([-np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-away, right), -away])
    pose[:3, 3] = [0, 0, DISTANCE]
    return pose


def draw_points(
    axes: Axes,
    points: Float[np.ndarray, "N 3"],
    color: Float[np.ndarray, "N 3"],
    *,
    size: float,
    alpha: float = 1.0,
) -> None:
    """Points of the camera frame, far ones first and paler, so that depth can be read."""
    order = np.argsort(-points[:, 2])
    near, far = points[:, 2].min(), points[:, 2].max()
    depth = (points[order, 2:] - near) / max(far - near, 1e-9)
    shade = color[order] * (1 - 0.45 * depth) + 0.45 * depth
    flat = project(points[order])
    axes.scatter(*flat.T, s=size, c=shade, alpha=alpha, linewidths=0, rasterized=True)


def draw_line(
    axes: Axes,
    middle: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
    *,
    reach: float,
    width: float = 1.8,
    alpha: float = 1.0,
) -> None:
    """A line of the camera frame, `reach` long on both sides of its middle.

    An opaque one lies on a white seam; one seen end on is a dot.
    """
    ends = project(middle + reach * np.array([[-1.0], [1.0]]) * direction)
    style: dict[str, Any] = {"solid_capstyle": "round", "zorder": 4}
    if alpha == 1:
        axes.plot(*ends.T, color="white", linewidth=width + 2, **style)
    axes.plot(*ends.T, color=LINE, linewidth=width, alpha=alpha, **style)


def window(axes: Axes, half: float) -> None:
    """A square view of half side `half` about the origin, y down, without ticks."""
    axes.set_xlim(-half / DISTANCE, half / DISTANCE)
    axes.set_ylim(half / DISTANCE, -half / DISTANCE)
    axes.set_aspect("equal")
    axes.set_axis_off()


def part_legend(figure: Figure, parts: Sequence[str], y: float) -> None:
    """The parts' colours and names in a row, centred at height `y` of the figure."""
    handles = [
        Line2D(
            [],
            [],
            marker="o",
            linestyle="",
            markersize=5,
            color=tuple(PALETTE[p]),
            label=plain(name),
        )
        for p, name in enumerate(parts)
    ]
    handles.append(Line2D([], [], color=LINE, linewidth=1.4, label="joint axis"))
    figure.legend(
        handles=handles, loc="center", bbox_to_anchor=(0.5, y), ncols=len(handles),
        frameon=False, fontsize=8, handletextpad=0.4, columnspacing=1.4,
    )  # fmt: skip


def plain(name: str, longest: int = 200) -> str:
    """A name from a file as text of a figure: one line, no formula, boxes for unknown signs."""
    font = get_font(findfont(FontProperties()))
    line = "".join(c if font.get_char_index(ord(c)) else "□" for c in one_line(name, longest))
    return line.replace("$", r"\$")


def to_png(figure: Figure, **options: Any) -> bytes:  # noqa: ANN401 - of `savefig`
    """The figure as PNG; the same figure is the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None}, **options)
    return buffer.getvalue()


def save(figure: Figure, out: Path) -> None:
    """Write a PNG under its final name only when complete."""
    write_bytes(out, to_png(figure))
