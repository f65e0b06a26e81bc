# SPDX-License-Identifier: MIT
"""Tables as Markdown for people and as CSV, one row per cell, for programs."""

from __future__ import annotations

import csv
import io

from bench.table_model import Cell, Marks, Table

_CHECK = "✓"


def to_markdown(table: Table) -> str:
    """A GitHub table with its notes."""
    heads = (table.first, "Method", "Source", "Pose", "Seg.", "Joint", *table.columns)
    lines = [
        f"**Table {table.number}.** {table.title}.",
        "",
        _line(heads),
        _line(["---"] * 6 + ["---:"] * len(table.columns)),
    ]
    for block in table.blocks:
        for number, row in enumerate(block.rows):
            first = f"**{block.heading}**" if number == 0 else ""
            lines.append(
                _line([first, row.method, row.source, *_checks(row.marks), *map(_cell, row.cells)])
            )
    return "\n".join([*lines, "", *(f"- {note}" for note in table.notes), ""])


def _line(fields: list[str] | tuple[str, ...]) -> str:
    return "| " + " | ".join(field.replace("|", "\\|") for field in fields) + " |"


def _checks(marks: Marks | None) -> list[str]:
    return ["", "", ""] if marks is None else [_CHECK if mark else "" for mark in marks]


def _cell(cell: Cell) -> str:
    text = cell.shown
    if cell.best:
        text = f"**{text}**"
    if cell.flag:
        text += "†"
    if cell.deviation is not None:
        text += f" ± {cell.deviation:.{cell.decimals}f}"
    if cell.low is not None and cell.high is not None:
        text += f" [{cell.low:.{cell.decimals}f}, {cell.high:.{cell.decimals}f}]"
    return text


COLUMNS = (
    "table", "block", "method", "source", "pose", "segmentation", "joint", "column", "value",
    "low", "high", "deviation", "seeds", "n", "k", "undefined", "best", "printed_mean_mismatch",
)  # fmt: skip


def to_csv(table: Table) -> str:
    """One row per cell, values unrounded; empty where there is none."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    names = _column_names(table)
    for block in table.blocks:
        for row in block.rows:
            marks = ("", "", "") if row.marks is None else map(int, row.marks)
            start = (table.number, block.heading, row.method, row.source, *marks)
            for name, cell in zip(names, row.cells, strict=True):
                writer.writerow((*start, name, *_values(cell, row.seeds)))
    return buffer.getvalue()


def _column_names(table: Table) -> list[str]:
    over = [name for name, width in table.groups for _ in range(width)] or [""] * len(table.columns)
    return [
        f"{group} {name}".strip() if table.number == 2 else name
        for group, name in zip(over, table.columns, strict=True)
    ]


def _values(cell: Cell, seeds: int) -> tuple[object, ...]:
    value = cell.text if cell.text is not None else _number(cell.value)
    return (
        value,
        _number(cell.low),
        _number(cell.high),
        _number(cell.deviation),
        seeds or "",
        "" if cell.count is None else cell.count,
        "" if cell.passed is None else cell.passed,
        cell.undefined or "",
        int(cell.best),
        int(cell.flag),
    )


def _number(value: float | None) -> str:
    return "" if value is None else repr(value)
