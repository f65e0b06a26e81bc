# SPDX-License-Identifier: MIT
"""Tables as Markdown for people and as CSV, one row per cell, for programs.

Tables as LaTeX documents of one page (booktabs).
"""

from __future__ import annotations

import csv
import io
import re

from bench.tables.model import DASH, Block, Cell, Marks, Row, Table

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


_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "°": r"$^\circ$", "†": r"$^\dagger$",
    "±": r"$\pm$", "–": "--", "×": r"$\times$", "<": r"$<$", ">": r"$>$", "|": r"$|$",
}  # fmt: skip

PREAMBLE = r"""\documentclass{{article}}
\usepackage[paperwidth={width}mm,paperheight={height}mm,margin=12mm]{{geometry}}
\usepackage{{amssymb,booktabs}}
\usepackage[T1]{{fontenc}}
\pagestyle{{empty}}
\setlength{{\tabcolsep}}{{3pt}}
\setlength{{\parindent}}{{0pt}}
\begin{{document}}
\scriptsize"""


def escape(text: str) -> str:
    """Text without LaTeX's special characters; what the fonts lack becomes `?`."""
    out = "".join(_ESCAPES.get(char, char) for char in text)
    return re.sub(r"[^\x00-\x7f]", "?", out)


def to_latex(table: Table) -> str:
    """A document of one page as large as the table, with the notes below."""
    rows = [row for block in table.blocks for row in block.rows]
    wide = any(cell.low is not None for row in rows for cell in row.cells)
    width = 80 + len(table.columns) * (26 if wide else 13)
    height = 45 + 3 * (len(rows) + len(table.blocks)) + 3 * len(table.blocks)
    height += sum(3 + 3 * len(note) // width for note in table.notes)
    lines = [
        PREAMBLE.format(width=width, height=height),
        rf"\textbf{{Table {table.number}.}} {escape(table.title)}.\par\medskip",
        rf"\begin{{tabular}}{{@{{}}ll{'c' * 3}{'r' * len(table.columns)}@{{}}}}",
        r"\toprule",
        *_over(table),
        _heads(table) + r" \\",
    ]
    for block in table.blocks:
        lines += [r"\midrule", *_block(block, 5 + len(table.columns))]
    lines += [r"\bottomrule", r"\end{tabular}\par\medskip"]
    lines += [rf"{escape(note)}\par" for note in table.notes]
    return "\n".join([*lines, r"\end{document}", ""])


def _over(table: Table) -> list[str]:
    if not table.groups:
        return []
    cells = [r"& & \multicolumn{3}{c}{Supervision}"]
    rules, column = [r"\cmidrule(lr){3-5}"], 6
    for name, width in table.groups:
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(name)}}}")
        if name:
            rules.append(rf"\cmidrule(lr){{{column}-{column + width - 1}}}")
        column += width
    return [" & ".join(cells) + r" \\", " ".join(rules)]


def _heads(table: Table) -> str:
    names = ("Method", "", "Pose", "Seg.", "Joint", *table.columns)
    return " & ".join(escape(name) for name in names)


def _block(block: Block, width: int) -> list[str]:
    heading = rf"\multicolumn{{{width}}}{{@{{}}l@{{}}}}{{\textbf{{{escape(block.heading)}}}}} \\"
    return [heading, *(_row(row) for row in block.rows)]


def _row(row: Row) -> str:
    fields = [
        escape(row.method),
        row.source,
        *_latex_checks(row.marks),
        *map(_latex_cell, row.cells),
    ]
    return " & ".join(fields) + r" \\"


def _latex_checks(marks: Marks | None) -> list[str]:
    return ["", "", ""] if marks is None else [r"$\checkmark$" if mark else "" for mark in marks]


def _latex_cell(cell: Cell) -> str:
    text = "--" if cell.shown == DASH else escape(cell.shown)
    if cell.best:
        text = rf"\textbf{{{text}}}"
    if cell.flag:
        text += r"$^\dagger$"
    if cell.deviation is not None:
        text += rf"\,$\pm$\,{cell.deviation:.{cell.decimals}f}"
    if cell.low is not None and cell.high is not None:
        text += rf" {{\tiny[{cell.low:.{cell.decimals}f}, {cell.high:.{cell.decimals}f}]}}"
    return text
