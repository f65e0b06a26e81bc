# SPDX-License-Identifier: MIT
"""A reliability diagram: how often answers were right, over how sure the model was of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from bench.figures.drawing import LINE, save
from scapo.drawing import BACKGROUND, PART_COLORS

TITLES = {"joint": "axis within 5 degrees", "part": "rotation within 10 degrees"}


class Binned(Protocol):
    """Answers by equal bins of probability (`bench.infer.calibration.Reliability`)."""

    @property
    def count(self) -> tuple[int, ...]:
        """Answers in each bin."""
        ...

    @property
    def predicted(self) -> tuple[float, ...]:
        """Mean probability."""
        ...

    @property
    def right(self) -> tuple[float, ...]:
        """Share that was right."""
        ...

    @property
    def error(self) -> float:
        """Expected calibration error."""
        ...


def reliability_picture(kinds: Mapping[str, Binned], out: Path, title: str) -> None:
    """One diagram a kind, the diagonal what perfect confidences would give, as a PNG file.

    Args:
        kinds: `joint` and `part`.
        out: FILE.png.
        title: Of the figure.
    """
    figure = Figure(figsize=(4.2 * len(kinds), 4.4), layout="constrained")
    figure.suptitle(title)
    for axes, (kind, one) in zip(
        np.atleast_1d(figure.subplots(1, len(kinds))), kinds.items(), strict=True
    ):
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
        axes.legend(loc="upper left", frameon=False)
    save(figure, out)
