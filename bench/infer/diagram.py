# SPDX-License-Identifier: MIT
"""A reliability diagram: how often answers were right, over how sure the model was of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from bench.figures.drawing import LINE, save
from bench.infer.calibration import Reliability
from scapo.drawing import BACKGROUND, PART_COLORS

IN_A_ROW = 5
TITLES = {"joint": "axis within 5 degrees", "part": "rotation within 10 degrees"}


def reliability_picture(kinds: Mapping[str, Reliability], out: Path, title: str) -> None:
    """One diagram a kind, the diagonal what perfect confidences would give, as a PNG file.

    Args:
        kinds: `joint` and `part`.
        out: FILE.png.
        title: Of the figure.
    """
    columns = min(IN_A_ROW, len(kinds))
    rows = math.ceil(len(kinds) / columns)
    figure = Figure(figsize=(2.6 * columns, 3.0 * rows + 0.4), layout="constrained")
    figure.suptitle(title)
    for place, (kind, one) in enumerate(kinds.items(), start=1):
        axes = figure.add_subplot(rows, columns, place)
        count = np.array(one.count)
        some, edges = count > 0, np.linspace(0, 1, len(count) + 1)
        axes.bar(
            edges[:-1], count / max(count.sum(), 1), width=edges[1], align="edge", color=BACKGROUND,
            edgecolor="white", label="share of the answers",
        )  # fmt: skip
        axes.plot([0, 1], [0, 1], color=LINE, linestyle="--", linewidth=1)
        axes.plot(
            np.array(one.predicted)[some], np.array(one.right)[some], marker="o",
            color=PART_COLORS[0], label="right",
        )  # fmt: skip
        axes.set(
            xlim=(0, 1), ylim=(0, 1.02), aspect="equal", xlabel="confidence",
            ylabel="share that is right",
            title=f"{TITLES.get(kind, kind)}\n{count.sum()} answers, off by {one.error:.1%}",
        )  # fmt: skip
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    save(figure, out)
