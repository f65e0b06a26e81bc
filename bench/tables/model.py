# SPDX-License-Identifier: MIT
"""A table between numbers and text: blocks of rows of cells, and which cells are best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

DASH = "–"
"""A cell that does not exist or was not run."""

Marks = tuple[bool, bool, bool]
"""Pose, segmentation, joint supervision."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One number, or none."""

    value: float | None = None
    """In printed units, not rounded."""
    decimals: int = 2
    low: float | None = None
    high: float | None = None
    """Ends of the 95 % interval."""
    deviation: float | None = None
    """Over training seeds."""
    count: int | None = None
    """n: what the number was taken over."""
    passed: int | None = None
    """k of an average precision k/n."""
    undefined: int = 0
    """Values left out because they could not be computed."""
    text: str | None = None
    """As printed in the paper."""
    flag: bool = False
    """A printed mean that its own row does not give."""
    best: bool = False
    uncalibrated: bool = False
    """It needs a calibration and some of its runs got none."""

    @property
    def shown(self) -> str:
        """The number as printed, rounded; a dash where there is none."""
        if self.text is not None:
            return self.text
        return DASH if self.value is None else f"{self.value:.{self.decimals}f}"


Source = Literal["paper", "ours"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One method in one block."""

    method: str
    source: Source
    marks: Marks | None
    """None: not known, or the row is no method."""
    cells: tuple[Cell, ...]
    camera: bool | None = None
    """Whether it uses where the camera stands; None: not said."""
    ranked: bool = True
    """Takes part in the choice of the best."""
    seeds: int = 0
    plain: str = ""
    """The method of the row that this one is another reading of."""

    @property
    def empty(self) -> bool:
        """No cell has a number."""
        return all(cell.value is None for cell in self.cells)

    def repeats(self, other: Row) -> bool:
        """Whether another row of the same source prints all that this one does."""
        pairs = zip(self.cells, other.cells, strict=True)
        return self.source == other.source and all(
            mine.value is None or mine.shown == its.shown for mine, its in pairs
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Rows under one heading, with which direction is better in each column."""

    heading: str
    rows: tuple[Row, ...]
    higher: tuple[bool | None, ...]
    """None: neither is better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A whole table."""

    number: str
    """Also of its files: `1b` is in `table1b.md`."""
    title: str
    first: str
    """Heading of the block column."""
    groups: tuple[tuple[str, int], ...]
    """Headings over the columns, with their widths; may be empty."""
    columns: tuple[str, ...]
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]


UNCALIBRATED = "‡"
UNCALIBRATED_NOTE = (
    "‡ Not calibrated: the method saw no poses, and its answers were compared in frames of its own "
    "(scapo-bench evaluate --calibration, or training data with labels)."
)


def noted(table: Table) -> Table:
    """The table with a line on the scores that lack a calibration, where there are any."""
    cells = (cell for block in table.blocks for row in block.rows for cell in row.cells)
    if not any(cell.uncalibrated for cell in cells):
        return table
    return replace(table, notes=(UNCALIBRATED_NOTE, *table.notes))


def mark_best(block: Block) -> Block:
    """Per column, the best of the self-supervised rows, printed and ours apart.

    As the paper groups them, a method is self-supervised if it has fewer than all three marks.
    What is equal after rounding is best alike.
    """
    rows = list(block.rows)
    for source in ("paper", "ours"):
        members = [
            i
            for i, row in enumerate(rows)
            if row.source == source and row.ranked and row.marks is not None and not all(row.marks)
        ]
        for column, higher in enumerate(block.higher):
            if higher is not None:
                _mark(rows, members, column, higher=higher)
    return replace(block, rows=tuple(rows))


def _mark(rows: list[Row], members: Sequence[int], column: int, *, higher: bool) -> None:
    known = {
        i: float(rows[i].cells[column].shown)
        for i in members
        if rows[i].cells[column].value is not None
    }
    if not known:
        return
    best = max(known.values()) if higher else min(known.values())
    for i, value in known.items():
        if value == best:
            cells = list(rows[i].cells)
            cells[column] = replace(cells[column], best=True)
            rows[i] = replace(rows[i], cells=tuple(cells))
