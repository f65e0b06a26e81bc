# SPDX-License-Identifier: MIT
"""All tables from scores per sample.

Tables 1, 2 and 3 have the paper's printed numbers beside ours, Table 1 stands on each kind of data,
and 4 to 7 are ours alone (`bench.tables.means`, `bench.tables.actuation`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from bench.metrics import ApRule
from bench.tables.actuation import load_actuations, table_7
from bench.tables.leaderboard import PAGE, to_html
from bench.tables.means import table_1, table_4, table_5, table_6
from bench.tables.model import Block, Cell, Row, Table, mark_best, noted
from bench.tables.paper import MEAN, Cells, mean_mismatches, printed_cells
from bench.tables.precision import table_2
from bench.tables.render import to_csv, to_latex, to_markdown
from bench.tables.results import TABLE_SPLIT, Place, Results, averaged, load, measured
from bench.tables.rows import Line, budget_notes, general_notes, line_row, lines_of
from bench.tables.significance import significance_csv
from bench.tables.spec import ABLATION_NAMES, ABLATIONS, TABLE_1_CATEGORIES, TABLE_3
from scapo.store import StoreError, write_bytes


def build(results: Results, rule: ApRule = "mean") -> tuple[Table, ...]:
    """The paper's three tables, and those of ours alone."""
    cells = printed_cells()
    wrong = mean_mismatches(cells)
    return (
        table_1(results, "clean", cells, wrong),
        table_2(results, cells, wrong, rule),
        table_3(results, cells),
        table_4(results),
        table_1(results, "complete", cells, wrong),
        table_1(results, "isolated", cells, wrong),
        table_5(results),
        table_6(results),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """Scores, and the tables that are made of them."""

    scores: Path
    results: Results
    tables: tuple[Table, ...]
    rule: ApRule

    def with_ours(self) -> Iterator[Table]:
        """The tables that have a row of ours."""
        for table in self.tables:
            if any(row.source == "ours" for block in table.blocks for row in block.rows):
                yield table

    def write(self, out: Path, *, page: bool = False) -> list[Path]:
        """Write `tableNUMBER.{md,csv,tex}` and `significance.csv`, and the leaderboard if wanted.

        Returns:
            Their paths.
        """
        written: dict[Path, str] = {}
        for table in self.tables:
            stem = f"table{table.number}"
            written[out / f"{stem}.md"] = to_markdown(table)
            written[out / f"{stem}.csv"] = to_csv(table)
            written[out / f"{stem}.tex"] = to_latex(table)
        written[out / "significance.csv"] = significance_csv(self.results, self.rule)
        if page:
            written[out / PAGE] = to_html(self.tables, self.results, self.scores, out)
        for path, text in written.items():
            write_bytes(path, text.encode())
        return list(written)


def make_tables(
    scores: Path, rule: ApRule = "mean", split: str = TABLE_SPLIT, *, only_ours: bool = False
) -> Made:
    """All tables from scores.

    Args:
        scores: Folder that is searched for them.
        rule: Of the average precision.
        split: Of all tables but 6.
        only_ours: Leave the paper's printed rows out.

    Raises:
        StoreError: No such folder, none in it, or scores that are damaged or do not fit together.
    """
    results, actuations = load(scores, split), load_actuations(scores, split)
    if not results.all_runs() and not actuations:
        there = results.splits
        found = "none; `scapo-bench evaluate` writes them"
        if there:
            found = f"those on {', '.join(there)}; --split {there[0]} makes tables of these"
        raise StoreError(f"{scores}: expected scores on {split} (NAME.csv.gz), found {found}")
    tables = (*build(results, rule), table_7(actuations))
    tables = tuple(map(ours_of, tables)) if only_ours else tables
    return Made(scores=scores, results=results, tables=tuple(map(noted, tables)), rule=rule)


def ours_of(table: Table) -> Table:
    """The table without the paper's rows, and without blocks that are then empty."""
    blocks = [
        replace(block, rows=tuple(row for row in block.rows if row.source == "ours"))
        for block in table.blocks
    ]
    return replace(table, blocks=tuple(block for block in blocks if block.rows))


def table_3(results: Results, cells: Cells) -> Table:
    """The ablations: means over the five categories of Table 1, single views."""
    rows: list[Row] = []
    for ablation in ABLATIONS:
        printed = [cells["3", measure.key, ablation, MEAN] for measure in TABLE_3]
        rows.append(Row(
            method=ABLATION_NAMES[ablation], source="paper", marks=(False, False, False),
            cells=tuple(Cell(value=cell.value, text=cell.text) for cell in printed),
        ))  # fmt: skip
        rows += [
            _ablation_row(results, line, ablation)
            for line in lines_of(results, "clean")
            if line.series.method == "scapo"
            and not line.series.switches
            and ablation_of(line.series.variant) == ablation
        ]
    block = Block(
        heading="Loss",
        rows=tuple(row for row in rows if not row.empty),
        higher=tuple(measure.higher for measure in TABLE_3),
    )
    missing = [row.method for row in rows if row.empty]
    note = f"Without a mean, as not every category was run: {', '.join(missing)}."
    return Table(
        number="3",
        title="Ablation of SCAPO's regularisers, means over the categories of Table 1",
        first="",
        groups=(),
        columns=tuple(f"{m.symbol} {'↑' if m.higher else '↓'}" for m in TABLE_3),
        blocks=(mark_best(block),),
        notes=(
            *general_notes(),
            *([note] if missing else []),
            *budget_notes(results, "clean", TABLE_1_CATEGORIES),
        ),
    )


def ablation_of(variant: str) -> str:
    """Which ablation a variant is: the one whose name it ends in, else `full`."""
    name = variant.replace("-", "_")
    return next((a for a in ABLATIONS[1:] if name.endswith(a)), ABLATIONS[0])


def _ablation_row(results: Results, line: Line, ablation: str) -> Row:
    runs = [line.runs(results, Place("clean", name)) for name in TABLE_1_CATEGORIES]
    columns = [
        [measured(found, measure, seed) for seed, found in enumerate(runs)] for measure in TABLE_3
    ]
    cells = [averaged(parts) for parts in columns]
    variant = line.series.variant
    suffix = f" ({variant})" if variant not in ("", "default") else ""
    row = line_row(results, line, cells, [part for parts in columns for part in parts])
    return replace(row, method=ABLATION_NAMES[ablation] + suffix)
