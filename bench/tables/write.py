# SPDX-License-Identifier: MIT
"""Tables 1, 2 and 3 from scores per sample, the paper's printed numbers beside ours.

Table 4 is ours: the metrics of Table 1 on the categories that the paper scores by precision alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.metrics import ApRule
from bench.tables.means import table_4
from bench.tables.model import Block, Cell, Row, Table, mark_best
from bench.tables.paper import MEAN, Cells, Mismatch, mean_mismatches, printed_cells
from bench.tables.precision import table_2
from bench.tables.render import to_csv, to_latex, to_markdown
from bench.tables.results import Place, Results, Series, averaged, load, measured
from bench.tables.rows import (
    budget_notes,
    general_notes,
    in_order,
    listed_series,
    our_row,
    printed_rows,
)
from bench.tables.significance import significance_csv
from bench.tables.spec import (
    ABLATION_NAMES,
    ABLATIONS,
    TABLE_1,
    TABLE_1_CATEGORIES,
    TABLE_1_GROUPS,
    TABLE_3,
    Measure,
)
from scapo.store import write_bytes


def build(results: Results, rule: ApRule = "mean") -> tuple[Table, Table, Table, Table]:
    """The paper's three tables, and the mean errors that they leave out."""
    cells = printed_cells()
    wrong = mean_mismatches(cells)
    return (
        table_1(results, cells, wrong),
        table_2(results, cells, wrong, rule),
        table_3(results, cells),
        table_4(results),
    )


def make_tables(scores: Path, out: Path, rule: ApRule = "mean") -> list[Path]:
    """Write `table{1,2,3,4}.{md,csv,tex}` and `significance.csv` from a folder of scores.

    Returns:
        Their paths.

    Raises:
        StoreError: No such folder, or scores that are damaged or do not fit together.
    """
    results = load(scores)
    written: dict[Path, str] = {}
    for table in build(results, rule):
        stem = f"table{table.number}"
        written[out / f"{stem}.md"] = to_markdown(table)
        written[out / f"{stem}.csv"] = to_csv(table)
        written[out / f"{stem}.tex"] = to_latex(table)
    written[out / "significance.csv"] = significance_csv(results, rule)
    for path, text in written.items():
        write_bytes(path, text.encode())
    return list(written)


def table_1(results: Results, cells: Cells, wrong: Sequence[Mismatch]) -> Table:
    """Mean errors on `clean`, a block per metric."""
    blocks = [_block_1(results, cells, wrong, measure) for measure in TABLE_1]
    return Table(
        number=1,
        title="Synthetic objects: segmentation (S), joint direction (D) and pivot (C), part "
        "rotation (R) and translation (t)",
        first="Metric",
        groups=(*TABLE_1_GROUPS, ("", 1)),
        columns=(*(name.capitalize() for name in TABLE_1_CATEGORIES), "Mean"),
        blocks=tuple(mark_best(block) for block in blocks),
        notes=(*general_notes(), *budget_notes(results, "clean", TABLE_1_CATEGORIES)),
    )


def _block_1(results: Results, cells: Cells, wrong: Sequence[Mismatch], measure: Measure) -> Block:
    rows = printed_rows(cells, wrong, "1", measure.key, (*TABLE_1_CATEGORIES, MEAN))
    rows += [
        our_row(results, series, [
            measured(results.runs(series, Place("clean", name)), measure, seed)
            for seed, name in enumerate(TABLE_1_CATEGORIES)
        ])
        for series in listed_series(results, "clean", with_order=measure.metric == "iou")
    ]  # fmt: skip
    arrow = "↑" if measure.higher else "↓"
    return Block(
        heading=f"{measure.symbol} {arrow} ({measure.heading})",
        rows=tuple(in_order(rows)),
        higher=(measure.higher,) * (len(TABLE_1_CATEGORIES) + 1),
    )


def table_3(results: Results, cells: Cells) -> Table:
    """The ablations: means over the five categories of Table 1."""
    rows: list[Row] = []
    for ablation in ABLATIONS:
        printed = [cells["3", measure.key, ablation, MEAN] for measure in TABLE_3]
        rows.append(Row(
            method=ABLATION_NAMES[ablation], source="paper", marks=(False, False, False),
            cells=tuple(Cell(value=cell.value, text=cell.text) for cell in printed),
        ))  # fmt: skip
        rows += [
            _ablation_row(results, series, ablation)
            for series in results.series("clean")
            if series.method == "scapo"
            and not series.switches
            and ablation_of(series.variant) == ablation
        ]
    block = Block(
        heading="Loss", rows=tuple(rows), higher=tuple(measure.higher for measure in TABLE_3)
    )
    return Table(
        number=3,
        title="Ablation of SCAPO's regularisers, means over the categories of Table 1",
        first="",
        groups=(),
        columns=tuple(f"{m.symbol} {'↑' if m.higher else '↓'}" for m in TABLE_3),
        blocks=(mark_best(block),),
        notes=(*general_notes(), *budget_notes(results, "clean", TABLE_1_CATEGORIES)),
    )


def ablation_of(variant: str) -> str:
    """Which ablation a variant is: the one whose name it ends in, else `full`."""
    name = variant.replace("-", "_")
    return next((a for a in ABLATIONS[1:] if name.endswith(a)), ABLATIONS[0])


def _ablation_row(results: Results, series: Series, ablation: str) -> Row:
    cells: list[Cell] = []
    for measure in TABLE_3:
        runs = [results.runs(series, Place("clean", name)) for name in TABLE_1_CATEGORIES]
        parts = [measured(found, measure, seed) for seed, found in enumerate(runs)]
        cells.append(averaged(parts))
    suffix = f" ({series.variant})" if series.variant not in ("", "default") else ""
    return Row(
        method=ABLATION_NAMES[ablation] + suffix,
        source="ours",
        marks=(False, False, False),
        cells=tuple(cells),
    )
