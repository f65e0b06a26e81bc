# SPDX-License-Identifier: MIT
"""A page of all tables that a browser opens from disk: one row a method, sortable by every column.

A name leads to the method's values by category and to its score files, ladders, strata and pictures
where they lie beside the scores. Nothing is loaded from elsewhere; names are text, never markup.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

from bench.scoring.score_files import SUFFIX, side_file
from bench.tables.model import DASH, UNCALIBRATED, UNCALIBRATED_NOTE, Cell, Row, Table
from bench.tables.render import MARKS
from bench.tables.results import Results, series_of
from bench.tables.rows import display_name, in_order

PAGE = "index.html"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; margin: 1.5rem auto;
       max-width: 80rem; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; } h3 { font-size: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: #555; padding-bottom: 0.4rem; }
td, th { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child { text-align: left; }
th button { all: unset; cursor: pointer; font-weight: 600; white-space: nowrap; }
th button:focus-visible { outline: 2px solid #1456a0; outline-offset: 2px; }
th[aria-sort=ascending] button::after { content: " \\25b2"; }
th[aria-sort=descending] button::after { content: " \\25bc"; }
tbody tr:hover { background: #f3f6fa; }
.paper { color: #666; } .range { color: #666; font-size: 0.85em; }
details { margin: 0.5rem 0; } summary { cursor: pointer; }
img { max-width: 100%; height: auto; border: 1px solid #ddd; }
a { color: #1456a0; }
"""
SCRIPT = """
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.parentElement, row = head.parentElement;
    const body = head.closest("table").tBodies[0];
    const column = [...row.children].indexOf(head);
    const up = head.getAttribute("aria-sort") !== "ascending";
    for (const one of row.children) one.setAttribute("aria-sort", "none");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = (line) => line.children[column].dataset.value;
    const order = (a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x === "" || y === "") return (x === "") - (y === "");
      const by = isNaN(x) || isNaN(y) ? x.localeCompare(y) : x - y;
      return up ? by : -by;
    };
    body.append(...[...body.rows].sort(order));
  });
}
const open = () => {
  const goal = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (goal && goal.tagName === "DETAILS") { goal.open = true; goal.scrollIntoView(); }
};
addEventListener("hashchange", open);
open();
"""
"""What is empty stands last either way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A method in a table: what its row shows, and all its values."""

    row: Row
    cells: tuple[Cell, ...]
    """Of the leaderboard."""
    blocks: tuple[tuple[str, Row], ...]
    """Its row in each block, by the block's heading."""

    @property
    def name(self) -> str:
        """With the source where it is the paper."""
        return f"{self.row.method}, as printed" if self.row.source == "paper" else self.row.method


def lines_of(table: Table) -> tuple[tuple[str, ...], list[Line]]:
    """The columns and lines of the leaderboard of a table; none of a table without means.

    A block is a metric over categories with the mean last, or (Table 2) a category with the means
    in the last block, or all there is (Table 3).
    """
    transposed = table.columns[-1:] == ("Mean",)
    if not transposed and table.number not in ("2", "3"):
        return (), []
    rows: dict[tuple[str, str], list[tuple[str, Row]]] = {}
    for block in table.blocks:
        for row in block.rows:
            rows.setdefault((row.method, row.source), []).append((block.heading, row))
    lines: list[Line] = []
    for blocks in rows.values():
        found = dict(blocks)
        if transposed:
            cells = tuple(found[block.heading].cells[-1] if block.heading in found else Cell()
                          for block in table.blocks)  # fmt: skip
        else:
            last = found.get(table.blocks[-1].heading)
            cells = last.cells if last is not None else (Cell(),) * len(table.columns)
        lines.append(Line(row=blocks[0][1], cells=cells, blocks=tuple(blocks)))
    columns = tuple(block.heading for block in table.blocks) if transposed else table.columns
    order = {id(row): place for place, row in enumerate(in_order([line.row for line in lines]))}
    return columns, sorted(lines, key=lambda line: order[id(line.row)])


def to_html(tables: Sequence[Table], results: Results, scores: Path, out: Path) -> str:
    """The page.

    Args:
        tables: Whose rows it shows.
        results: Of the same scores: which files a row comes from.
        scores: Their folder.
        out: Folder of the page, for links.
    """
    files = _Files(results, scores, out)
    sections, shown = [], []
    for table in tables:
        columns, lines = lines_of(table)
        if not any(line.row.source == "ours" for line in lines):
            continue
        shown.append(f'<li><a href="#table{table.number}">Table {table.number}: '
                     f"{escape(table.title)}</a></li>")  # fmt: skip
        sections.append(_section(table, columns, lines, files))
    others = "".join(
        f'<li><a href="table{table.number}.md">Table {table.number}</a>: {escape(table.title)} '
        f'(<a href="table{table.number}.csv">CSV</a>, '
        f'<a href="table{table.number}.tex">LaTeX</a>)</li>'
        for table in tables
    )
    body = "".join(sections) or "<p>No scores yet.</p>"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width"><title>Leaderboard</title>'
        f"<style>{STYLE}</style></head><body><main><h1>Category-level articulated pose</h1>"
        "<p>One row a method: means over categories. A heading sorts by its column; a name leads "
        "to the values by category and, below them, to the files. Arrows say which way is better, "
        "the best of the self-supervised rows is bold. A method that was not run in every category "
        "stands below alone, as do other readings of the same answers. Grey rows are the paper's "
        f"printed numbers, on other data.</p><ul>{''.join(shown)}</ul>{body}"
        f"<h2>All tables</h2><ul>{others}</ul></main><script>{SCRIPT}</script></body></html>\n"
    )


def _section(table: Table, columns: Sequence[str], lines: Sequence[Line], files: _Files) -> str:
    heads = ("Method", *MARKS, "Seeds", *columns)
    head = "".join(_heading(name) for name in heads)
    body, details = [], []
    for number, line in enumerate(lines):
        name = f"table{table.number}-{number}"
        if not line.row.plain and any(cell.value is not None for cell in line.cells):
            body.append(_row(line, name))
        details.append(_details(table, line, name, files))
    notes = "".join(f"<li>{escape(note)}</li>" for note in table.notes)
    told = f"<p>{escape(UNCALIBRATED_NOTE)}</p>" if UNCALIBRATED_NOTE in table.notes else ""
    return (
        f'<h2 id="table{table.number}">Table {table.number}</h2><div class="wide"><table>'
        f"<caption>{escape(table.title)}.</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>{told}<h3>By category</h3>{''.join(details)}"
        f"<details><summary>Notes</summary><ul>{notes}</ul></details>"
    )


def _heading(name: str) -> str:
    """A heading that sorts, in short: what stands in brackets is shown at a touch."""
    short, _, rest = name.partition(" (")
    told = f' title="{escape(rest.removesuffix(")"))}"' if rest else ""
    button = f'<button type="button">{escape(short)}</button>'
    return f'<th scope="col" aria-sort="none"{told}>{button}</th>'


def _row(line: Line, name: str) -> str:
    row = line.row
    used = (*(row.marks or (None, None, None)), row.camera)
    marks = "".join(_datum("" if mark is None else int(mark), _mark(mark)) for mark in used)
    seeds = _datum(row.seeds or "", str(row.seeds or ""))
    kind = ' class="paper"' if row.source == "paper" else ""
    link = f'<a href="#{name}">{escape(line.name)}</a>'
    values = "".join(_datum("" if c.value is None else c.value, _cell(c)) for c in line.cells)
    return f"<tr{kind}>{_datum(line.name, link)}{marks}{seeds}{values}</tr>"


def _datum(value: object, text: str) -> str:
    return f'<td data-value="{escape(str(value))}">{text}</td>'


def _mark(mark: bool | None) -> str:
    return DASH if mark is None else "✓" if mark else ""


def _cell(cell: Cell) -> str:
    text = f"<b>{escape(cell.shown)}</b>" if cell.best else escape(cell.shown)
    text += UNCALIBRATED * cell.uncalibrated
    if cell.low is None or cell.high is None:
        return text
    places = cell.decimals
    return f'{text} <span class="range">{cell.low:.{places}f} to {cell.high:.{places}f}</span>'


def _details(table: Table, line: Line, name: str, files: _Files) -> str:
    over = [group for group, width in table.groups for _ in range(width)]
    over = over if table.number == "2" else [""] * len(table.columns)
    head = "".join(f'<th scope="col">{escape(f"{group} {column}".strip())}</th>'
                   for group, column in zip(over, table.columns, strict=True))  # fmt: skip
    body = "".join(
        f'<tr><th scope="row">{escape(heading)}</th>'
        + "".join(f"<td>{_cell(cell)}</td>" for cell in row.cells) + "</tr>"
        for heading, row in line.blocks
    )  # fmt: skip
    links = files.of(line.row) if line.row.source == "ours" else ""
    return (
        f'<details id="{name}"><summary>{escape(line.name)}</summary><div class="wide"><table>'
        f'<thead><tr><th scope="col">{escape(table.first)}</th>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>{links}</details>"
    )


class _Files:
    """What lies on disk of each row, as links from the page."""

    def __init__(self, results: Results, scores: Path, out: Path) -> None:
        self.scores, self.out = scores.resolve(), out.resolve()
        self.paths: dict[str, list[Path]] = {}
        for run in results.all_runs():
            path = self.scores / run.path.relative_to(scores)  # which may be a link to elsewhere
            self.paths.setdefault(display_name(series_of(run)), []).append(path)

    def of(self, row: Row) -> str:
        """The files of a row: reports, then what lies in ladders/ and pictures/ beside scores/."""
        items = []
        for path in dict.fromkeys(self.paths.get(row.method, [])):
            name = path.relative_to(self.scores).as_posix().removesuffix(SUFFIX)
            found = [self._link(side_file(path), "report"), self._link(path, "scores")]
            found += [self._link(file, file.name) for file in self._beside(name)]
            items.append(f"<li>{escape(name)}: {', '.join(found)}</li>")
        return f"<ul>{''.join(items)}</ul>" if items else ""

    def _beside(self, name: str) -> Iterable[Path]:
        for folder in ("ladders", "pictures"):
            yield from sorted(self.scores.parent.joinpath(folder, name).glob("*.*"))

    def _link(self, path: Path, text: str) -> str:
        return f'<a href="{quote(os.path.relpath(path, self.out))}">{escape(text)}</a>'
