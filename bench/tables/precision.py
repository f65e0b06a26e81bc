# SPDX-License-Identifier: MIT
"""Table 2: average precision on sensor data, a block per category."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.metrics import ApRule
from bench.tables.model import Block, Cell, Row, Table, mark_best
from bench.tables.paper import MEAN, Cells, Mismatch
from bench.tables.results import (
    Place,
    Results,
    Sampled,
    Series,
    averaged,
    check_monotone,
    measured,
    precise,
)
from bench.tables.rows import (
    budget_notes,
    display_name,
    general_notes,
    in_order,
    listed_series,
    marks_of,
)
from bench.tables.spec import (
    PAPER_METHODS,
    PRECISION_GROUPS,
    PRECISION_HEADINGS,
    PRECISION_KEYS,
    REFERENCE,
    TABLE_1,
    TABLE_2_CATEGORIES,
    Measure,
)

STATE = "State"


def table_2(results: Results, cells: Cells, wrong: Sequence[Mismatch], rule: ApRule) -> Table:
    """Average precision on `sensor`, a block per category, and the mean over categories."""
    state = next(measure for measure in TABLE_1 if measure.metric == "joint_state")
    ours: dict[Series, list[list[Sampled | None]]] = {}
    for series in listed_series(results, "sensor", with_order=True):
        ours[series] = [
            _precision_row(results, series, name, rule, state, number)
            for number, name in enumerate(TABLE_2_CATEGORIES)
        ]
    blocks = []
    for number, name in enumerate((*TABLE_2_CATEGORIES, MEAN)):
        rows = _printed_precision(cells, wrong, name)
        for series, found in ours.items():
            parts = list(zip(*found, strict=True))
            row = [averaged(column) for column in parts] if name == MEAN else [
                Cell() if part is None else part.cell for part in found[number]
            ]  # fmt: skip
            rows.append(_row_2(results, series, row))
        blocks.append(
            Block(
                heading=name.capitalize(),
                rows=tuple(in_order(rows)),
                higher=(True,) * len(PRECISION_KEYS) + (False,),
            )
        )
    return Table(
        number=2,
        title=f"Sensor data: average precision in percent, rule {rule}, and the joint state error "
        "(deg, for the drawer cm)",
        first="Category",
        groups=(*PRECISION_GROUPS, ("", 1)),
        columns=(*PRECISION_HEADINGS, STATE),
        blocks=tuple(mark_best(block) for block in blocks),
        notes=(*general_notes(), *budget_notes(results, "sensor", TABLE_2_CATEGORIES)),
    )


def _row_2(results: Results, series: Series, cells: Sequence[Cell]) -> Row:
    return Row(
        method=display_name(series),
        source="ours",
        marks=marks_of(results, series),
        cells=tuple(cells),
        ranked=series.method not in REFERENCE and not series.switches,
    )


def _precision_row(
    results: Results, series: Series, category: str, rule: ApRule, state: Measure, seed: int
) -> list[Sampled | None]:
    runs = results.runs(series, Place("sensor", category))
    values = {key: precise(runs, key, rule, seed) for key in PRECISION_KEYS}
    check_monotone(values)
    slide = replace(state, unit="m", factor=100)
    return [*values.values(), measured(runs, state, seed) or measured(runs, slide, seed)]


def _printed_precision(cells: Cells, wrong: Sequence[Mismatch], category: str) -> list[Row]:
    flagged = {(m.metric, m.method) for m in wrong if m.table == "2"}
    rows = []
    for method in dict.fromkeys(key[2] for key in cells if key[0] == "2"):
        found = [cells["2", key, method, category] for key in PRECISION_KEYS]
        row = [
            Cell(
                value=cell.value, text=cell.text, flag=category == MEAN and (key, method) in flagged
            )
            for key, cell in zip(PRECISION_KEYS, found, strict=True)
        ]
        rows.append(
            Row(
                method=PAPER_METHODS.get(method, method),
                source="paper",
                marks=found[0].marks,
                cells=(*row, Cell()),
            )
        )
    return rows
