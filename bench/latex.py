# SPDX-License-Identifier: MIT
"""Tables as LaTeX documents of one page (booktabs)."""

from __future__ import annotations

import re

from bench.table_model import DASH, Block, Cell, Marks, Row, Table

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
    fields = [escape(row.method), row.source, *_checks(row.marks), *map(_cell, row.cells)]
    return " & ".join(fields) + r" \\"


def _checks(marks: Marks | None) -> list[str]:
    return ["", "", ""] if marks is None else [r"$\checkmark$" if mark else "" for mark in marks]


def _cell(cell: Cell) -> str:
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
