# SPDX-License-Identifier: MIT
"""Rows of the tables: the paper's as printed, ours from the scores, and their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.paper import MEAN, Cells, Mismatch
from bench.results import Kind, Results, Sampled, Series, averaged
from bench.table_data import METHODS, ORDER, PAPER_METHODS, REFERENCE, TABLE_1
from bench.table_model import Cell, Marks, Row

DATASET_ORDER = "label-order=dataset"


def printed_rows(
    cells: Cells, wrong: Sequence[Mismatch], table: str, metric: str, columns: Sequence[str]
) -> list[Row]:
    """The paper's rows of one metric over categories; a cell that it has not is a dash."""
    flagged = {(m.table, m.metric, m.method) for m in wrong}
    methods = dict.fromkeys(key[2] for key in cells if key[0] == table)
    rows = []
    for method in methods:
        found = [cells.get((table, metric, method, name)) for name in columns]
        marks = next(cell.marks for key, cell in cells.items() if key[::2] == (table, method))
        row = tuple(
            Cell() if cell is None else Cell(
                value=cell.value, text=cell.text,
                flag=name == MEAN and (table, metric, method) in flagged,
            )
            for name, cell in zip(columns, found, strict=True)
        )  # fmt: skip
        if any(cell.value is not None for cell in row) or metric in {m.key for m in TABLE_1[:5]}:
            rows.append(
                Row(
                    method=PAPER_METHODS.get(method, method), source="paper", marks=marks, cells=row
                )
            )
    return rows


def listed_series(results: Results, kind: Kind, *, with_order: bool) -> list[Series]:
    """Rows of ours: every method and variant, the references, and S with one order per data set."""
    plain = [series for series in results.series(kind) if not series.switches]
    plain += [
        Series(name, "", "") for name in REFERENCE if all(series.method != name for series in plain)
    ]
    others = [
        series for series in results.series(kind) if series.switches not in ("", DATASET_ORDER)
    ]
    if with_order:
        others += [
            replace(series, switches=DATASET_ORDER)
            for series in plain
            if series.method not in REFERENCE
        ]
    return sorted(plain + others)


def our_row(
    results: Results, series: Series, parts: Sequence[Sampled | None], *, mean: bool = True
) -> Row:
    """A cell per category and, if wanted, their mean."""
    cells = [Cell() if part is None else part.cell for part in parts]
    seeds = max((len(part.per_seed) for part in parts if part is not None), default=0)
    return Row(
        method=display_name(series),
        source="ours",
        marks=marks_of(results, series),
        cells=(*cells, averaged(parts)) if mean else tuple(cells),
        ranked=series.method not in REFERENCE and not series.switches,
        seeds=seeds,
    )


def display_name(series: Series) -> str:
    """What a table calls a series."""
    name = METHODS.get(series.method, series.method)
    if series.variant not in ("", "default"):
        name += f" ({series.variant})"
    if series.switches == DATASET_ORDER:
        name += ", one part order"
    elif series.switches:
        name += f", {series.switches}"
    return name


def marks_of(results: Results, series: Series) -> Marks | None:
    """The labels that training used, from the reports beside the scores."""
    for run in results.all_runs():
        same = (run.run.method, run.run.variant.partition("[")[0]) == (
            series.method, series.variant)  # fmt: skip
        if same and "supervision" in run.report and series.method not in REFERENCE:
            labels = run.report["supervision"]
            return ("pose" in labels, "segmentation" in labels, "joint" in labels)
    return None


def in_order(rows: Sequence[Row]) -> list[Row]:
    """In the paper's order of methods, each printed row before ours of that method."""

    def rank(row: Row) -> tuple[int, int]:
        known = [i for i, name in enumerate(ORDER) if row.method.startswith(name)]
        reference = any(row.method.startswith(METHODS[name]) for name in REFERENCE)
        return (known[-1] if known else len(ORDER) + reference, row.source != "paper")

    return sorted(rows, key=rank)
