# SPDX-License-Identifier: MIT
"""The page of a study: five metrics with intervals and medians, rates, stability, origins."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.ladder import COLUMNS
from bench.scoring.score_files import read_scores, side_file
from scapo.store import write_bytes
from scapo.store.provenance import commit

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


def write_page(out: Path, entries: Iterable[Entry], command: str) -> Path:
    """Write the page from the files of the study; returns its path."""
    entries = list(entries)
    headings = [COLUMNS[key][0] for key in METRICS]
    lines = ["# Results", "", f"`{command}`, code {commit()}", "",
             "Mean [95 % interval, resampled by instance] and median; C, t in 4 x mean radius. "
             "Clouds per second in batches on the machine named below.", "",
             _row(["run", "mode", *headings, "clouds/s"]),
             _row(["---", "---", *("---:" for _ in headings), "---:"])]  # fmt: skip
    lines += [_row(_scores_row(entry)) for entry in entries]
    lines += ["", *_stability(out), "", "## Where the numbers come from", "",
              _row(["run", "mode", "seed", "training", "data", "code of the run", "machine"]),
              _row(["---"] * 7)]  # fmt: skip
    lines += [_row(_origin(entry)) for entry in entries]
    for entry in entries:
        lines += ["", f"## {entry.name}", "", *_figures(out, entry)]
        if entry.ladder.is_file():
            lines += ["", entry.ladder.read_text().strip()]
    write_bytes(out / PAGE, ("\n".join(lines) + "\n").encode())
    return out / PAGE


def _scores_row(entry: Entry) -> list[str]:
    report = _json(side_file(entry.scores))
    (scores,) = read_scores(entry.scores)
    cells = []
    for key in METRICS:
        _, factor, decimals = COLUMNS[key]
        row, values = report["summary"]["_".join(key)], scores.errors[key]
        if row["mean"] is None:
            cells.append("–")
            continue
        mean, low, high, median = (
            f"{factor * value:.{decimals}f}"
            for value in (row["mean"], row["low"], row["high"], np.nanmedian(values))
        )
        cells.append(f"{mean} [{low}, {high}] {median}")
    seconds = report["budget"].get("seconds_per_cloud")
    return [_run(entry), entry.mode, *cells, f"{1 / seconds:.1f}" if seconds else "–"]


def _origin(entry: Entry) -> list[str]:
    report = _json(side_file(entry.scores))
    run, budget = report.get("run") or {}, report["budget"]
    trained = budget.get("training_seconds")
    device = run.get("machine") or {}
    return [
        _run(entry), entry.mode, str(report["seed"]),
        "–" if trained is None else f"{trained / 60:.1f} min, {budget.get('parameters', 0):,} "
        "parameters",
        str(report["data"]), str(run.get("commit", "–")),
        f"{device.get('cpu', '–')}, {device.get('cores', '–')} cores, {budget.get('device', '–')}",
    ]  # fmt: skip


def _stability(out: Path) -> list[str]:
    rows = []
    for path in sorted((out / "stability").glob("*.json")):
        for mode, found in _json(path)["modes"].items():
            moved, drawn = found["equivariance"]["both"], found.get("resampling", {})
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


def _pair(row: dict[str, Any] | None) -> str:
    if row is None or "median" not in row:
        return "–"
    return f"{row['median']['value']:.3g} / {row['p95']['value']:.3g}"


def _figures(out: Path, entry: Entry) -> list[str]:
    paths = [(name, entry.pictures / f"{name}.png") for name in FIGURES]
    return [f"![{name}]({Path(os.path.relpath(path, out)).as_posix()})"
            for name, path in paths if path.is_file()]  # fmt: skip


def _run(entry: Entry) -> str:
    return entry.name.removesuffix(f"-{entry.mode}")


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
