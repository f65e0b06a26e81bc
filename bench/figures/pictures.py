# SPDX-License-Identifier: MIT
"""Predictions beside the truth, from the best to the worst, and the curves of a training."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.analysis.answered import Answered
from bench.figures.drawing import plain, save
from bench.metrics import sample_errors
from bench.run_files import read_metrics
from bench.scoring.scores import Errors
from scapo import store
from scapo.drawing import draw_axis, draw_cloud
from scapo.store.predictions import read_prediction_header
from scapo.store.samples import UNLABELLED

TRUE_AXIS, PREDICTED_AXIS = "black", "#cc3311"

PER_ROW = 5
"""Samples side by side."""

NAMES = ("points", "part", "camera_T_part", "joint_pivot", "joint_axis")


def predictions_picture(
    split: store.Split,
    predictions: Path,
    out: Path,
    samples: Sequence[int],
    *,
    titles: Sequence[str] | None = None,
    heading: str | None = None,
) -> None:
    """The truth above the prediction, one column per sample, in rows of `PER_ROW`.

    Parts are coloured by the true part that the evaluator compares each predicted one with;
    the true axis is drawn dashed and black in both rows, the predicted one red.

    Args:
        split: The data.
        predictions: Made on it.
        out: PNG.
        samples: Columns.
        titles: Above each column; the sample's number by default.
        heading: Of the figure; category and method by default.

    Raises:
        StoreError: The predictions are not readable or belong to other data.
    """
    index = np.asarray(samples)
    truth = {name: array[index] for name, array in split.arrays(*NAMES).items()}
    header = read_prediction_header(predictions)
    predicted, _ = store.read(predictions, store.PREDICTIONS)
    predicted = {name: array[index] for name, array in predicted.items()}
    part_true = np.where(truth["part"] == UNLABELLED, -1, truth["part"].astype(np.int64))
    part_shown = as_compared(truth, part_true, hard_parts(predicted))
    lines, columns = -(-len(index) // PER_ROW), min(PER_ROW, len(index))
    figure = Figure(figsize=(0.3 + 1.8 * columns, 0.5 + 3.8 * lines), dpi=160)
    grid = figure.subplots(2 * lines, columns, squeeze=False)
    for number, sample in enumerate(index):
        points = truth["points"][number].astype(np.float64)
        line, column = divmod(number, PER_ROW)
        above, below = grid[2 * line : 2 * line + 2, column]
        draw_cloud(above, points, part_true[number], size=2.5)
        draw_cloud(below, points, part_shown[number], size=2.5)
        for axes in (above, below):
            draw_joints(axes, points, truth, number, color=TRUE_AXIS)
        draw_joints(below, points, predicted, number, color=PREDICTED_AXIS)
        above.set_title(titles[number] if titles else f"#{sample}", fontsize=8)
    words = f"{header.method} {header.variant}".strip()
    _finish(figure, grid, plain(heading or f"{words}, {header.category}"))
    save(figure, out)


def _finish(figure: Figure, grid: np.ndarray, heading: str) -> None:
    """Titles, the names of the rows, and nothing where there is no sample."""
    for axes in grid.flat:
        axes.set_axis_off()
    figure.suptitle(f"{heading}\njoint axis: true dashed, predicted red", fontsize=9)
    figure.tight_layout(rect=(0.02, 0, 1, 1), w_pad=0.2, h_pad=0.4)
    left = 0.06 / figure.get_figwidth()
    for number, axes in enumerate(grid[:, 0]):
        box = axes.get_position()
        name = ("truth", "prediction")[number % 2]
        figure.text(left, (box.y0 + box.y1) / 2, name, rotation=90, va="center", fontsize=9)


def as_compared(truth: store.Arrays, part_true: np.ndarray, part_pred: np.ndarray) -> np.ndarray:
    """Predicted parts (B, N) renamed to the true parts that the evaluator compares them with."""
    order = sample_errors(
        part_true=part_true,
        camera_T_part_true=truth["camera_T_part"],
        pivot_true=truth["joint_pivot"],
        axis_true=truth["joint_axis"],
        part_pred=part_pred,
        camera_T_part_pred=None,
        pivot_pred=None,
        axis_pred=None,
    )["order"]
    return np.take_along_axis(order, part_pred, axis=1)


def draw_joints(
    axes: Axes, points: np.ndarray, arrays: store.Arrays, sample: int, *, color: str
) -> None:
    """The axes of one sample's joints where the arrays have any; the true ones dashed."""
    if "joint_axis" not in arrays or "joint_pivot" not in arrays:
        return
    pairs = zip(arrays["joint_pivot"][sample], arrays["joint_axis"][sample], strict=True)
    for pivot, axis in pairs:
        draw_axis(axes, points, pivot, axis, color=color, dashed=color == TRUE_AXIS)


def hard_parts(predicted: store.Arrays) -> np.ndarray:
    """The part of each point (B, N), int64, from `part` or the largest `part_weight`."""
    if "part" in predicted:
        return predicted["part"].astype(np.int64)
    return predicted["part_weight"].argmax(-1)


def training_curve(metrics: Path, out: Path) -> None:
    """Loss terms of a run's metrics.jsonl against the step, one panel per stage."""
    stages: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for row in read_metrics(metrics):
        for name, value in row.items():
            if name.startswith("loss"):
                stages[row["stage"]][name].append((row["step"], value))
    figure = Figure(figsize=(5 * max(1, len(stages)), 4.4), dpi=130)
    panels = figure.subplots(1, max(1, len(stages)), squeeze=False)[0]
    for panel, (stage, terms) in zip(panels, stages.items(), strict=False):
        for number, (name, pairs) in enumerate(sorted(terms.items())):
            steps, values = zip(*pairs, strict=True)
            total = name == "loss"
            panel.plot(
                steps, values, linewidth=2 if total else 1.1,
                color="black" if total else f"C{(number - 1) % 10}",
                linestyle="-" if number <= 10 else "--",
                label=plain(name.removeprefix("loss/"), 40),
            )  # fmt: skip
        panel.set_yscale("symlog", linthresh=1e-3)
        panel.set_title(plain(stage, 40), fontsize=10)
        panel.set_xlabel("step", fontsize=9)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(
            fontsize=7, ncols=4, frameon=False, loc="upper center", bbox_to_anchor=(0.48, -0.15),
            columnspacing=1.0, handlelength=1.6,
        )  # fmt: skip
    figure.tight_layout()
    save(figure, out)


SHARES = {
    ("iou", "1"): 0.15,
    ("joint_direction", "deg"): 4.0,
    ("joint_pivot", "r4"): 0.08,
    ("part_rotation", "deg"): 6.0,
    ("part_translation", "r4"): 0.09,
}
"""The error that counts as 1 in the badness of a prediction; that of `iou` is 1 - IoU."""
SHOWN = 10


def badness(errors: Errors) -> Float[np.ndarray, " S"]:
    """Mean over the five metrics of the sample's mean error by `SHARES`; inf without an answer.

    An error counts at most ten times its share: a wrong pose is wrong, whether by 90 or by 180
    degrees, and leaves the other four their say.
    """
    rows = []
    for key, share in SHARES.items():
        if key not in errors:
            continue
        error = 1 - errors[key] if key[0] == "iou" else errors[key]
        known = np.isfinite(error)
        count = known.sum(1)
        mean = np.where(known, error, 0).sum(1) / np.maximum(count, 1)
        rows.append(np.where(count > 0, np.minimum(mean / share, 10.0), np.nan))
    table = np.stack(rows)
    known = np.isfinite(table)
    total = np.where(known, table, 0).sum(0)
    return np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.inf)


def ranked(value: Float[np.ndarray, " S"], count: int = SHOWN) -> Int[np.ndarray, " K"]:
    """Samples at `count` even steps of the rank, best and worst among them."""
    order = np.argsort(value, kind="stable")
    order = order[np.isfinite(value[order])]
    place = np.linspace(0, len(order) - 1, min(count, len(order)))
    return order[np.round(place).astype(int)]


def ranking_picture(answered: Answered, predictions: Path, out: Path) -> None:
    """Ten predictions, each with its rank and its errors above it."""
    value = badness(answered.errors)
    samples = ranked(value)
    place = np.argsort(np.argsort(value, kind="stable"), kind="stable")
    last = int(np.isfinite(value).sum()) - 1
    titles = [
        _title(answered.errors, i, float(100 * place[i] / max(last, 1))) for i in samples.tolist()
    ]
    header = answered.header
    words = f"{header.method} {header.variant}".strip()
    predictions_picture(
        answered.split, predictions, out, samples.tolist(), titles=titles,
        heading=f"{words}, {header.category}: {len(samples)} of {last + 1} predictions, best to "
        "worst",
    )  # fmt: skip


def _title(errors: Errors, sample: int, rank: float) -> str:
    def mean(*key: str) -> float:
        values = errors[key[0], key[1]][sample]
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) else float("nan")

    name = "best" if rank == 0 else "worst" if rank == 100 else f"{rank:.0f} %"
    first = f"S {100 * mean('iou', '1'):.0f}  D {mean('joint_direction', 'deg'):.1f}°"
    second = f"C {mean('joint_pivot', 'r4'):.2f}  R {mean('part_rotation', 'deg'):.1f}°"
    return f"{name}\n{first}\n{second}".replace("nan°", "–").replace("nan", "–")
