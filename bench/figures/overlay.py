# SPDX-License-Identifier: MIT
"""Test clouds moved back by their base poses and drawn over each other: are they aligned?"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.analysis.answered import Answered
from bench.analysis.ladder import Pieces
from bench.figures.drawing import (
    PALETTE,
    draw_line,
    draw_points,
    look,
    part_legend,
    plain,
    save,
    window,
)
from scapo.geometry.matrices import moved

VIEWS = {"from the front, above": (35.0, 28.0), "from the side": (90.0, 0.0),
         "from above": (0.0, 89.9)}  # fmt: skip
DRAWN = 12_000
"""Points of a panel, evenly thinned over the clouds."""


def overlay_picture(answered: Answered, out: Path, samples: Int[np.ndarray, " K"]) -> None:
    """Rows: predicted and true base poses; columns: three sides. Lengths in 4 x mean radius.

    Parts are coloured by slot, predicted above and true below; thin lines are the joint axes.
    Without calibration the predicted frame is the method's own and is not upright.
    """
    rows = (
        ("predicted base pose, parts, axes", answered.mine, answered.part),
        ("true base pose, parts, axes", answered.true, answered.part_true),
    )
    known = samples[np.isfinite(answered.mine.pose[samples, 0]).all((1, 2))]
    figure = Figure(figsize=(3.0 * len(VIEWS), 6.5), dpi=200)
    grid = figure.subplots(2, len(VIEWS), squeeze=False)
    shapes = [canonical(answered, pieces, part, known) for _, pieces, part in rows]
    for line, shape in enumerate(shapes):
        points = shape[0]
        middle = (np.quantile(points, 0.02, axis=0) + np.quantile(points, 0.98, axis=0)) / 2
        half = float(np.quantile(np.abs(points - middle).max(1), 0.99))
        for axes, (side, angles) in zip(grid[line], VIEWS.items(), strict=True):
            camera = look(*angles)
            camera[:3, 3] -= camera[:3, :3] @ middle
            _panel(axes, shape, camera, 1.25 * half)
            if line == 0:
                axes.set_title(side, fontsize=9, pad=2)
    figure.subplots_adjust(left=0.035, right=0.995, bottom=0.04, top=0.88, wspace=0.02, hspace=0.02)
    for line, (title, _, _) in enumerate(rows):
        figure.text(0.012, 0.67 - 0.42 * line, title, rotation=90, va="center", fontsize=9)
    figure.suptitle(caption(answered, known), fontsize=10, y=0.985)
    part_legend(figure, answered.split.manifest.parts, 0.02)
    save(figure, out)


def caption(answered: Answered, samples: Int[np.ndarray, " K"]) -> str:
    """What is drawn, and how well the bases of all answered samples agree with the truth."""
    error = answered.errors["part_rotation", "deg"][:, 0]
    error = error[np.isfinite(error)]
    words = plain(f"{answered.header.method} {answered.header.variant}".strip())
    first = f"{words}: {len(samples)} {plain(answered.header.category)} clouds in one frame"
    if answered.fitted.record is None and "pose" not in answered.header.supervision:
        return f"{first} (not calibrated)"
    share = 100 * float((error <= 15).mean()) if len(error) else float("nan")
    return (
        f"{first}\nbase rotation error over all {len(error)}: median {np.median(error):.1f}°, "
        f"{share:.0f} % within 15°"
    )


Shape = tuple[
    Float[np.ndarray, "M 3"], Int[np.ndarray, " M"], Float[np.ndarray, "A 3"],
    Float[np.ndarray, "A 3"],
]  # fmt: skip
"""Points, their parts, places and directions of the joint axes."""


def canonical(
    answered: Answered, pieces: Pieces, part: Int[np.ndarray, "S N"], samples: np.ndarray
) -> Shape:
    """Points and axes in the base frame of each sample, in units of 4 x mean radius, joined."""
    stride = max(1, len(samples) * part.shape[1] // DRAWN)
    points, places, directions = [], [], []
    for i in samples:
        base_T_camera = np.linalg.inv(pieces.pose[i, 0])
        cloud = moved(answered.points[i, ::stride], base_T_camera) / answered.scale[i]
        axis = pieces.axis[i] @ base_T_camera[:3, :3].T
        pivot = moved(pieces.pivot[i], base_T_camera) / answered.scale[i]
        points.append(cloud)
        # The axis beside the cloud, wherever along it the pivot was put.
        places.append(pivot + axis * ((cloud.mean(0) - pivot) * axis).sum(-1, keepdims=True))
        directions.append(axis)
    joined = np.concatenate(points)
    return (
        joined,
        part[samples][:, ::stride].ravel(),
        np.concatenate(places),
        np.concatenate(directions),
    )


def _panel(axes: Axes, shape: Shape, camera: np.ndarray, half: float) -> None:
    points, part, places, directions = shape
    draw_points(axes, moved(points, camera), PALETTE[part], size=1.3, alpha=0.6)
    for place, direction in zip(moved(places, camera), directions @ camera[:3, :3].T, strict=True):
        if np.isfinite(place).all() and np.isfinite(direction).all():
            draw_line(axes, place, direction, reach=0.45, width=0.8, alpha=0.5)
    window(axes, half)
