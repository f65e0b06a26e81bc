# SPDX-License-Identifier: MIT
"""Table 7, ours alone: of how many joints the prediction is good enough to move the true one.

From the CSV files of `scapo-data actuate` (docs/actuate.md), wherever they lie among the scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.statistics import interval
from bench.tables.model import Block, Cell, Marks, Row, Table, mark_best
from bench.tables.results import Place, Series, kind_of
from bench.tables.rows import display_name, in_order
from bench.tables.spec import REFERENCE
from scapo.store import StoreError
from scapo.store.actuations import Actuation, is_actuations, read_actuations

TITLE = "Joints of the true object that moved when pulled, in simulation, as the prediction says"
NOTES = (
    "Moved: the joint went at least 30 degrees or half of the travel left, whichever is less, "
    "before the hand slipped off; a drawer half of the travel left. A sample without an answer is "
    "a failure. In brackets: 95 % bootstrap interval, resampled by instance.",
    "Force: across the true path, mean over a pull, median over joints (docs/actuate.md).",
    "Pose, Seg., Joint: labels that training used.",
)
Rows = list[Actuation]
Runs = dict[Series, dict[Place, Rows]]


def load_actuations(folder: Path, split: str) -> Runs:
    """The rows of every file of actuations below a folder, on one split, by method and place.

    Raises:
        StoreError: A broken file, a joint that was tried twice, or two data sets at one place.
    """
    found: Runs = {}
    seen: dict[tuple[object, ...], Path] = {}
    data: dict[Place, str] = {}
    for path in sorted(folder.rglob("*.csv")):
        for row in read_actuations(path) if is_actuations(path) else ():
            if row.split != split:
                continue
            place = Place(kind_of(row.data), row.category)
            if data.setdefault(place, row.data) != row.data:
                raise StoreError(f"{path}: expected rows on {data[place]}, found {row.data}")
            key = (row.method, row.variant, row.seed, row.data, row.category, row.sample, row.joint)
            if key in seen:
                raise StoreError(
                    f"{path}: expected each joint once, found sample {row.sample}, joint "
                    f"{row.joint} of {row.method} also in {seen[key]}"
                )
            seen[key] = path
            series = Series(row.method, row.variant, "")
            found.setdefault(series, {}).setdefault(place, []).append(row)
    return found


def table_7(runs: Runs) -> Table:
    """The share that moved and the force across the path, per method and category."""
    places = sorted(
        {place for by in runs.values() for place in by}, key=lambda p: (p.kind, p.category)
    )
    wanted = (("Moved ↑ (%)", _moved, True), ("Force ↓ (N)", _force, False))
    blocks = []
    for heading, measure, higher in wanted:
        rows = [_row(series, by, [measure(by.get(place, ())) for place in places])
                for series, by in sorted(runs.items())]  # fmt: skip
        blocks.append(
            Block(heading=heading, rows=tuple(in_order(rows)), higher=(higher,) * len(places))
        )
    nothing = () if runs else ("No actuations were found.",)
    return Table(
        number="7",
        title=TITLE,
        first="Metric",
        groups=(),
        columns=tuple(f"{place.category.capitalize()} ({place.kind})" for place in places),
        blocks=tuple(mark_best(block) for block in blocks if block.rows),
        notes=(*NOTES, *nothing),
    )


def _row(series: Series, by: dict[Place, Rows], cells: Sequence[Cell]) -> Row:
    rows = [row for found in by.values() for row in found]
    return Row(
        method=display_name(series),
        source="ours",
        marks=_marks(rows[0].supervision),
        cells=tuple(cells),
        ranked=series.method not in REFERENCE,
        seeds=len({row.seed for row in rows}),
    )


def _marks(supervision: str) -> Marks:
    labels = supervision.split()
    return ("pose" in labels, "segmentation" in labels, "joint" in labels)


def _moved(rows: Sequence[Actuation]) -> Cell:
    tried = [row for row in rows if row.success is not None]
    if not tried:
        return Cell(undefined=len(rows))
    found = interval(
        np.array([100.0 * bool(row.success) for row in tried]),
        np.array([row.instance for row in tried]),
    )
    return Cell(
        value=found.mean, decimals=1, low=found.low, high=found.high, count=len(tried),
        passed=sum(bool(row.success) for row in tried), undefined=len(rows) - len(tried),
    )  # fmt: skip


def _force(rows: Sequence[Actuation]) -> Cell:
    forces = [row.off_path_mean for row in rows if row.off_path_mean is not None]
    if not forces:
        return Cell(undefined=len(rows))
    return Cell(
        value=float(np.median(forces)), decimals=2, count=len(forces),
        undefined=len(rows) - len(forces),
    )  # fmt: skip
