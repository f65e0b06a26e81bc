# SPDX-License-Identifier: MIT
"""Table 2: average precision on sensor data, a block per category."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.metrics import ApRule
from bench.tables.means import measured_in
from bench.tables.model import Block, Cell, Row, Table, mark_best
from bench.tables.paper import MEAN, Cells, Mismatch
from bench.tables.results import (
    Place,
    Results,
    Sampled,
    averaged,
    check_monotone,
    measured,
    precise,
    seconds_per_cloud,
)
from bench.tables.rows import (
    Line,
    budget_notes,
    general_notes,
    kept,
    left_out,
    line_row,
    lines_of,
    printed_rows,
)
from bench.tables.spec import (
    PRECISION_GROUPS,
    PRECISION_HEADINGS,
    PRECISION_KEYS,
    REFERENCE,
    SWAPPED,
    TABLE_1,
    TABLE_2_CATEGORIES,
)

MORE = ("State", "Other order", "s/cloud")
"""Columns of ours beside the paper's."""


def table_2(results: Results, cells: Cells, wrong: Sequence[Mismatch], rule: ApRule) -> Table:
    """Average precision on `sensor`, a block per category, and the mean over categories."""
    ours: list[tuple[Line, list[list[Sampled | Cell | None]]]] = [
        (line, [_precision_row(results, line, name, rule, number)
                for number, name in enumerate(TABLE_2_CATEGORIES)])
        for line in lines_of(results, "sensor")
    ]  # fmt: skip
    candidates: list[tuple[str, list[Row]]] = []
    for number, name in enumerate((*TABLE_2_CATEGORIES, MEAN)):
        printed = printed_rows(cells, wrong, "2", [(key, name) for key in PRECISION_KEYS])
        rows = [replace(row, cells=(*row.cells, *(Cell() for _ in MORE))) for row in printed]
        for line, found in ours:
            parts = [part for row in found for part in row] if name == MEAN else found[number]
            columns = zip(*found, strict=True)
            row = [_mean(part) for part in columns] if name == MEAN else [_cell(p) for p in parts]
            rows.append(line_row(results, line, row, parts))
        candidates.append((name.capitalize(), rows))
    higher = (True,) * len(PRECISION_KEYS) + (False, None, None)
    blocks = [Block(heading=name, rows=kept(rows), higher=higher) for name, rows in candidates]
    return Table(
        number="2",
        title=f"Sensor data: average precision in percent, rule {rule}, the joint state error "
        "(deg, for the drawer cm), and the share of samples whose parts were taken in another "
        "order, in percent",
        first="Category",
        groups=(*PRECISION_GROUPS, ("", len(MORE))),
        columns=(*PRECISION_HEADINGS, *MORE),
        blocks=tuple(mark_best(block) for block in blocks),
        notes=(
            *general_notes(),
            *left_out(results, candidates, "sensor"),
            *budget_notes(results, "sensor", TABLE_2_CATEGORIES),
        ),
    )


def _precision_row(
    results: Results, line: Line, category: str, rule: ApRule, seed: int
) -> list[Sampled | Cell | None]:
    runs = line.runs(results, Place("sensor", category))
    values = {key: precise(runs, key, rule, seed) for key in PRECISION_KEYS}
    check_monotone(values)
    state = next(measure for measure in TABLE_1 if measure.metric == "joint_state")
    further, reference = line.series.switches != "", line.series.method in REFERENCE
    return [
        *values.values(),
        measured_in(runs, state, seed),
        None if further else measured(runs, SWAPPED, seed),
        None if further or reference else seconds_per_cloud(runs),
    ]


def _cell(part: Sampled | Cell | None) -> Cell:
    return Cell() if part is None else part if isinstance(part, Cell) else part.cell


def _mean(column: Sequence[Sampled | Cell | None]) -> Cell:
    """Over categories; of seconds, which have no interval, the plain mean."""
    cells = [part for part in column if isinstance(part, Cell)]
    if not cells:
        return averaged([part for part in column if not isinstance(part, Cell)])
    known = [cell.value for cell in cells if cell.value is not None]
    if len(known) < len(column):
        return Cell()
    return Cell(value=sum(known) / len(known), decimals=cells[0].decimals)
