# SPDX-License-Identifier: MIT
"""`explain`: the strata and the oracle ladder of a predictions file, drawn and written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.analysis.explain import Ladder, ladder_csv, measure, strata_csv
from bench.analysis.ladder import PIECES, Rung, ladder_markdown
from bench.analysis.strata import FACTORS, Stratum
from bench.figures.drawing import plain, to_png
from bench.requests import Request
from bench.statistics import Interval
from scapo.store import write_bytes

LABELS = {
    ("iou", "1"): "IoU",
    ("joint_direction", "deg"): "joint direction, deg",
    ("joint_pivot", "r4"): "joint pivot, r4",
    ("joint_state", "deg"): "joint state, deg",
    ("joint_state", "r4"): "joint state, r4",
    ("part_rotation", "deg"): "part rotation, deg",
    ("part_translation", "r4"): "part translation, r4",
}
"""What is plotted, in this order."""

BAR, EDGE, BEST, PLAIN = "#4477aa", "#222222", "#cc3311", "#bbbbbb"


def plot_strata(strata: Sequence[Stratum], title: str) -> bytes:
    """A row per metric, a column per factor; bars with 95 % intervals and numbers of values."""
    metrics = [key for key in LABELS if any((s.metric, s.unit) == key for s in strata)]
    names = [name for name in FACTORS if any(s.factor == name for s in strata)]
    height = 2.3 * len(metrics) + 0.8
    figure = Figure(figsize=(3.2 * len(names), height))
    figure.subplots_adjust(
        left=0.06, right=0.99, bottom=0.5 / height, top=1 - 0.8 / height, wspace=0.25, hspace=0.5
    )
    grid = figure.subplots(len(metrics), len(names), squeeze=False, sharey="row")
    for row, key in enumerate(metrics):
        for column, name in enumerate(names):
            axes: Axes = grid[row][column]
            bins = [s for s in strata if s.factor == name and (s.metric, s.unit) == key]
            _bars(
                axes,
                [s.value for s in bins],
                [f"{s.lower:.2g} to\n{s.upper:.2g}\nn={s.value.count}" for s in bins],
            )
            if column == 0:
                axes.set_ylabel(LABELS[key])
            if row == 0:
                axes.set_title(FACTORS[name], fontsize=9)
        grid[row][0].set_ylim(bottom=0)  # of the whole row, once all its bars are there
    return _png(figure, title)


def plot_ladder(ladder: Ladder, title: str) -> bytes:
    """A panel per metric, a bar per rung; red is the piece whose truth helps most."""
    metrics = [key for key in LABELS if key in ladder["predicted"]]
    columns = -(-len(metrics) // 2)
    figure = Figure(figsize=(3.1 * columns, 5.6))
    figure.subplots_adjust(left=0.06, right=0.99, bottom=0.145, top=0.87, wspace=0.22, hspace=0.62)
    grid = figure.subplots(2, columns, squeeze=False)
    for axes in grid.flat[len(metrics) :]:
        axes.set_axis_off()
    for axes, key in zip(grid.flat, metrics, strict=False):
        values: dict[Rung, Interval] = {rung: found[key] for rung, found in ladder.items()}
        colors = {rung: BAR if rung in PIECES else PLAIN for rung in values}
        best = helps_most(values, higher=key[0] == "iou")
        if best is not None:
            colors[best] = BEST
        _bars(axes, list(values.values()), list(values), colors=list(colors.values()), turned=True)
        if values["predicted"].count:
            axes.axhline(values["predicted"].mean, color=EDGE, linewidth=0.7, linestyle=":")
        axes.set_title(LABELS[key], fontsize=9)
        axes.set_ylim(bottom=0)
    return _png(figure, f"{title}: one piece replaced by the truth")


def helps_most(values: dict[Rung, Interval], *, higher: bool) -> Rung | None:
    """The piece whose truth improves the mean most, None where none improves it."""
    sign = 1 if higher else -1
    start = sign * values["predicted"].mean
    known: list[Rung] = [rung for rung in PIECES if values[rung].count]
    best = max(known, key=lambda rung: sign * values[rung].mean, default=None)
    if best is None or sign * values[best].mean - start <= 1e-9:
        return None
    return best


def _bars(
    axes: Axes,
    values: Sequence[Interval],
    labels: Sequence[str],
    *,
    colors: Sequence[str] | None = None,
    turned: bool = False,
) -> None:
    known = [place for place, value in enumerate(values) if value.count]
    some = [values[place] for place in known]
    means = [value.mean for value in some]
    reach = [
        [max(0.0, value.mean - value.low) for value in some],
        [max(0.0, value.high - value.mean) for value in some],
    ]
    axes.bar(known, means, color=[colors[place] for place in known] if colors else BAR)
    axes.errorbar(known, means, reach, fmt="none", ecolor=EDGE, capsize=2, elinewidth=1)
    for place in sorted({*range(len(values))} - {*known}):
        axes.text(place, 0, "–", ha="center", va="bottom")
    axes.set_xticks(range(len(labels)), labels, fontsize=7, rotation=60 if turned else 0)
    axes.tick_params(axis="y", labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(y=0.1)


def _png(figure: Figure, title: str) -> bytes:
    figure.suptitle(plain(title))
    return to_png(figure, dpi=110)


def explain(request: Request) -> list[Path]:
    """Write `ladder.{md,csv,png}` and `strata.{csv,png}` to the folder `request.out`.

    Raises:
        StoreError: As `evaluate`.
    """
    found = measure(request)
    contents = {
        "ladder.md": ladder_markdown(
            found.ladder, found.medians, found.title, found.facts
        ).encode(),
        "ladder.csv": ladder_csv(found.ladder).encode(),
        "ladder.png": plot_ladder(found.ladder, found.title),
        "strata.csv": strata_csv(found.strata).encode(),
        "strata.png": plot_strata(found.strata, found.title),
    }
    for name, data in contents.items():
        write_bytes(request.out / name, data)
    return [request.out / name for name in contents]
