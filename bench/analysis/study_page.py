# SPDX-License-Identifier: MIT
"""The page of a study: five metrics with intervals and medians, rates, stability, origins."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from bench.analysis.ladder import COLUMNS
from bench.scoring.score_files import read_report, read_scores
from scapo.store import write_bytes
from scapo.store.json_records import from_json, read_json
from scapo.store.provenance import commit
from scapo.text import as_markdown, one_line

PAGE = "README.md"
METRICS = (
    ("iou", "1"),
    ("joint_direction", "deg"),
    ("joint_pivot", "r4"),
    ("part_rotation", "deg"),
    ("part_translation", "r4"),
)
FIGURES = ("overlay", "template", "ranking", "training")
MOVED = {"base rotation, deg": "base_rotation_deg", "axis, deg": "axis_deg", "pivot": "pivot_r4"}
SCATTERED = {"axis, deg": "axis_deg_mad", "pivot": "pivot_r4_mad"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One run in one mode, and where its results lie."""

    name: str
    mode: str
    scores: Path
    ladder: Path
    pictures: Path
    stability: Path | None = None
    """Report of the run, in all modes; None: not asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """One number of a stability report; its interval is left alone."""

    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """Changes of one quantity; None where nothing is defined."""

    median: Point | None = None
    p95: Point | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeStability:
    """One inference mode in a stability report."""

    equivariance: dict[str, dict[str, Statistic]]
    resampling: dict[str, Statistic] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stability:
    """What the page takes from a stability report."""

    modes: dict[str, ModeStability]


def write_page(out: Path, entries: Iterable[Entry], command: str) -> Path:
    """Write the page from the files of the study; returns its path."""
    entries = list(entries)
    headings = [COLUMNS[key][0] for key in METRICS]
    lines = ["# Results", "", f"`{one_line(command).replace('`', '')}`, code {commit()}", "",
             "Mean [95 % interval, resampled by instance] and median; C, t in 4 x mean radius. "
             "Clouds per second in batches on the machine named below.", "",
             _row(["run", "mode", *headings, "clouds/s"]),
             _row(["---", "---", *("---:" for _ in headings), "---:"])]  # fmt: skip
    lines += [_row(_scores_row(entry)) for entry in entries]
    lines += ["", *_stability(entries), "", "## Where the numbers come from", "",
              _row(["run", "mode", "seed", "training", "data", "code of the run", "machine"]),
              _row(["---"] * 7)]  # fmt: skip
    lines += [_row(_origin(entry)) for entry in entries]
    for entry in entries:
        lines += ["", f"## {as_markdown(entry.name)}", "", *_figures(out, entry)]
        if entry.ladder.is_file():
            lines += ["", entry.ladder.read_text().strip()]
    write_bytes(out / PAGE, ("\n".join(lines) + "\n").encode())
    return out / PAGE


def _scores_row(entry: Entry) -> list[str]:
    scores = read_scores(entry.scores)[0]
    cells = []
    for key in METRICS:
        _, factor, decimals = COLUMNS[key]
        row, values = scores.report.summary.get("_".join(key)), scores.errors.get(key)
        if row is None or row.mean is None or values is None or not np.isfinite(values).any():
            cells.append("–")
            continue
        mean, low, high, median = (
            "–" if value is None else f"{factor * value:.{decimals}f}"
            for value in (row.mean, row.low, row.high, np.nanmedian(values))
        )
        cells.append(f"{mean} [{low}, {high}] {median}")
    seconds = scores.report.cost("seconds_per_cloud")
    return [_run(entry), entry.mode, *cells, f"{1 / seconds:.1f}" if seconds else "–"]


def _origin(entry: Entry) -> list[str]:
    report = read_report(entry.scores)
    run, budget = report.run, report.budget
    trained = report.cost("training_seconds")
    found = run.get("machine")
    device: dict[str, Any] = found if isinstance(found, dict) else {}
    size = int(report.cost("parameters") or 0)
    return [
        _run(entry), entry.mode, str(report.seed),
        "–" if trained is None else f"{trained / 60:.1f} min, {size:,} parameters",
        report.data, str(run.get("commit", "–")),
        f"{device.get('cpu', '–')}, {device.get('cores', '–')} cores, {budget.get('device', '–')}",
    ]  # fmt: skip


def _stability(entries: Iterable[Entry]) -> list[str]:
    rows = []
    for path in dict.fromkeys(one.stability for one in entries if one.stability is not None):
        for mode, found in from_json(Stability, read_json(path), str(path)).modes.items():
            moved, drawn = found.equivariance.get("both", {}), found.resampling
            cells = [_pair(moved.get(name)) for name in MOVED.values()]
            cells += [_pair(drawn.get(name)) for name in SCATTERED.values()]
            rows.append(_row([path.stem, mode, *cells]))
    if not rows:
        return []
    headings = [*(f"moved: {name}" for name in MOVED), *(f"drawn: {name}" for name in SCATTERED)]
    return ["## Stability", "",
            "Median / 95th percentile. Moved: change of the answer when the cloud is turned and "
            "shifted and the answer moved back. Drawn: median absolute deviation over subsets of "
            "the points. Pivot in 4 x mean radius.", "",
            _row(["run", "mode", *headings]), _row(["---", "---", *("---:" for _ in headings)]),
            *rows]  # fmt: skip


def _pair(row: Statistic | None) -> str:
    if row is None or row.median is None or row.p95 is None:
        return "–"
    return f"{row.median.value:.3g} / {row.p95.value:.3g}"


def _figures(out: Path, entry: Entry) -> list[str]:
    paths = [(name, entry.pictures / f"{name}.png") for name in FIGURES]
    return [f"![{name}]({quote(Path(os.path.relpath(path, out)).as_posix())})"
            for name, path in paths if path.is_file()]  # fmt: skip


def _run(entry: Entry) -> str:
    return entry.name.removesuffix(f"-{entry.mode}")


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(map(as_markdown, cells))} |"
