# SPDX-License-Identifier: MIT
"""A table as Markdown for people, as CSV for programs and as a LaTeX document of one page.

Names of methods, variants and notes may come from anybody's files: in each form they are text,
never markup, formulas or commands.
"""

from __future__ import annotations

import re

from bench.tables.model import DASH, UNCALIBRATED, Cell, Row, Table
from scapo.text import as_cell, as_markdown, csv_text


def to_markdown(table: Table) -> str:
    """A GitHub table with its notes."""
    heads = (table.first, "Method", "Source", *MARKS, *table.columns)
    lines = [
        f"**Table {table.number}.** {table.title}.",
        "",
        _line([as_markdown(head) for head in heads]),
        _line(["---"] * (3 + len(MARKS)) + ["---:"] * len(table.columns)),
    ]
    for block in table.blocks:
        first = f"**{as_markdown(block.heading)}**"
        for row in block.rows:
            names = [first, as_markdown(row.method), row.source]
            lines.append(_line([*names, *_checks(row, "✓", DASH), *map(_markdown, row.cells)]))
            first = ""
    return "\n".join([*lines, "", *(f"- {as_markdown(note)}" for note in table.notes), ""])


def _line(fields: list[str]) -> str:
    return "| " + " | ".join(fields) + " |"


MARKS = ("Pose", "Seg.", "Joint", "Camera")
"""Headings of what a row used."""


def _checks(row: Row, check: str, unknown: str) -> list[str]:
    used = (*(row.marks or (False, False, False)), row.camera)
    return [unknown if mark is None else check if mark else "" for mark in used]


def _markdown(cell: Cell) -> str:
    text = f"**{cell.shown}**" if cell.best else cell.shown
    text += "†" * cell.flag + UNCALIBRATED * cell.uncalibrated
    if cell.deviation is not None:
        text += f" ± {cell.deviation:.{cell.decimals}f}"
    if cell.low is not None and cell.high is not None:
        text += f" [{cell.low:.{cell.decimals}f}, {cell.high:.{cell.decimals}f}]"
    return text


COLUMNS = (
    "table", "block", "method", "source", "pose", "segmentation", "joint", "camera", "column",
    "value", "low", "high", "deviation", "seeds", "n", "k", "undefined", "best",
    "printed_mean_mismatch", "uncalibrated",
)  # fmt: skip


def to_csv(table: Table) -> str:
    """One row per cell, values unrounded; empty where there is none."""
    columns, rows = [as_cell(name) for name in _column_names(table)], list[tuple[object, ...]]()
    for block in table.blocks:
        for row in block.rows:
            marks = ("", "", "") if row.marks is None else tuple(map(int, row.marks))
            marks = (*marks, "" if row.camera is None else int(row.camera))
            names = (as_cell(block.heading), as_cell(row.method), row.source)
            rows += [
                (table.number, *names, *marks, column, *_values(cell, row.seeds))
                for column, cell in zip(columns, row.cells, strict=True)
            ]
    return csv_text(COLUMNS, rows)


def _column_names(table: Table) -> list[str]:
    over = [name for name, width in table.groups for _ in range(width)] or [""] * len(table.columns)
    return [
        f"{group} {name}".strip() if table.number == "2" else name
        for group, name in zip(over, table.columns, strict=True)
    ]


def _values(cell: Cell, seeds: int) -> tuple[object, ...]:
    return (
        cell.text if cell.text is not None else _number(cell.value),
        _number(cell.low),
        _number(cell.high),
        _number(cell.deviation),
        seeds or "",
        "" if cell.count is None else cell.count,
        "" if cell.passed is None else cell.passed,
        cell.undefined or "",
        int(cell.best),
        int(cell.flag),
        int(cell.uncalibrated),
    )


def _number(value: float | None) -> str:
    return "" if value is None else repr(value)


_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "°": r"$^\circ$", "†": r"$^\dagger$",
    "‡": r"$^\ddagger$",
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
    return re.sub(r"[^\x20-\x7e]", "?", out)


def to_latex(table: Table) -> str:
    """A document of one page as large as the table, with the notes below."""
    rows = [row for block in table.blocks for row in block.rows]
    wide = any(cell.low is not None for row in rows for cell in row.cells)
    width = 90 + len(table.columns) * (26 if wide else 13)
    height = 45 + 3 * (len(rows) + len(table.blocks)) + 3 * len(table.blocks)
    height += sum(3 + 3 * len(note) // width for note in table.notes)
    names = ("Method", "", *MARKS, *table.columns)
    lines = [
        PREAMBLE.format(width=width, height=height),
        rf"\textbf{{Table {table.number}.}} {escape(table.title)}.\par\medskip",
        rf"\begin{{tabular}}{{@{{}}ll{'c' * len(MARKS)}{'r' * len(table.columns)}@{{}}}}",
        r"\toprule",
        *_over(table),
        " & ".join(map(escape, names)) + r" \\",
    ]
    for block in table.blocks:
        heading = rf"{{\textbf{{{escape(block.heading)}}}}} \\"
        lines += [r"\midrule", rf"\multicolumn{{{len(names)}}}{{@{{}}l@{{}}}}{heading}"]
        lines += map(_latex_row, block.rows)
    lines += [r"\bottomrule", r"\end{tabular}\par\medskip"]
    lines += [rf"{escape(note)}\par" for note in table.notes]
    return "\n".join([*lines, r"\end{document}", ""])


def _over(table: Table) -> list[str]:
    if not table.groups:
        return []
    cells = [r"& & \multicolumn{3}{c}{Supervision} &"]  # nothing over the camera
    rules, column = [r"\cmidrule(lr){3-5}"], 3 + len(MARKS)
    for name, width in table.groups:
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(name)}}}")
        if name:
            rules.append(rf"\cmidrule(lr){{{column}-{column + width - 1}}}")
        column += width
    return [" & ".join(cells) + r" \\", " ".join(rules)]


def _latex_row(row: Row) -> str:
    checks = _checks(row, r"$\checkmark$", "--")
    name = re.sub(r"^(?=[\[*])", "{}", escape(row.method))  # else an argument of the row before
    return " & ".join([name, row.source, *checks, *map(_latex, row.cells)]) + r" \\"


def _latex(cell: Cell) -> str:
    text = "--" if cell.shown == DASH else escape(cell.shown)
    if cell.best:
        text = rf"\textbf{{{text}}}"
    if cell.flag:
        text += r"$^\dagger$"
    if cell.uncalibrated:
        text += r"$^\ddagger$"
    if cell.deviation is not None:
        text += rf"\,$\pm$\,{cell.deviation:.{cell.decimals}f}"
    if cell.low is not None and cell.high is not None:
        text += rf" {{\tiny[{cell.low:.{cell.decimals}f}, {cell.high:.{cell.decimals}f}]}}"
    return text
