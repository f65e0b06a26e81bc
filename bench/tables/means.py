# SPDX-License-Identifier: MIT
"""Tables of mean errors, a block per metric: Table 1 on each kind of data, and those of ours alone.

Table 1 stands twice, on single views (`clean`) and on whole surfaces (`complete`), and without the
paper's numbers as 1b on parts seen alone (`isolated`). Table 4 has the metrics of Table 1 where the
paper prints average precision only, 5 real models, 6 objects unlike those of training, by what sets
them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import get_args

from bench.scoring.score_files import Scores
from bench.tables.model import Block, Cell, Row, Table, mark_best
from bench.tables.paper import MEAN, Cells, Mismatch
from bench.tables.results import Kind, Place, Results, Sampled, measured
from bench.tables.results import seconds_per_cloud as seconds_of
from bench.tables.rows import (
    Line,
    budget_notes,
    display_name,
    general_notes,
    kept,
    left_out,
    line_row,
    lines_of,
    our_row,
    printed_rows,
)
from bench.tables.spec import (
    REFERENCE,
    SECONDS,
    SWAPPED,
    TABLE_1,
    TABLE_1_CATEGORIES,
    TABLE_1_GROUPS,
    TABLE_2_CATEGORIES,
    Measure,
)

TITLE_1 = (
    "Synthetic objects, {}: segmentation (S), joint direction (D) and pivot (C), part rotation (R) "
    "and translation (t)"
)
SEEN = {
    "clean": "single views",
    "complete": "whole surfaces",
    "isolated": "parts seen alone",
}
"""What the kinds of Table 1's data are."""
OPTIONAL = ("reconstruction", "swapped")
"""Measures that no method is asked for."""
Printed = Callable[[Measure], list[Row]]
"""The paper's rows of a metric."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """What a table of mean errors is over."""

    results: Results
    lines: Sequence[Line]
    places: Sequence[Place]
    mean: bool = False
    """A last column with the mean over the places."""
    measures: Sequence[Measure] = TABLE_1
    printed: Printed = lambda measure: []

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Of its data."""
        return tuple(dict.fromkeys(place.kind for place in self.places))


def table_1(results: Results, kind: Kind, cells: Cells, wrong: Sequence[Mismatch]) -> Table:
    """Mean errors on synthetic objects; the paper's beside them but for parts seen alone."""

    def printed(measure: Measure) -> list[Row]:
        columns = [(measure.key, name) for name in (*TABLE_1_CATEGORIES, MEAN)]
        rows = printed_rows(cells, wrong, "1", columns)
        return [row for row in rows if measure.printed or not row.empty]

    grid = Grid(
        results=results,
        lines=lines_of(results, kind),
        places=[Place(kind, name) for name in TABLE_1_CATEGORIES],
        mean=True,
        printed=(lambda measure: []) if kind == "isolated" else printed,
    )
    table = _table(grid, {"clean": "1", "complete": "1-complete"}.get(kind, "1b"),
                   TITLE_1.format(SEEN[kind]))  # fmt: skip
    columns = (*(name.capitalize() for name in TABLE_1_CATEGORIES), "Mean")
    return replace(table, groups=(*TABLE_1_GROUPS, ("", 1)), columns=columns)


def table_4(results: Results) -> Table:
    """Mean errors on `sensor`, and on the `clean` categories that Table 1 has not, if any."""
    places = [Place("sensor", name) for name in TABLE_2_CATEGORIES]
    places += [place for place in _places(results, "clean")
               if place.category not in TABLE_1_CATEGORIES]  # fmt: skip
    grid = Grid(results=results, lines=lines_of(results, "sensor", "clean"), places=places)
    title = "Mean errors on sensor data, and without noise on categories that Table 1 has not"
    return _table(grid, "4", title)


def table_5(results: Results) -> Table:
    """Mean errors on models of real objects."""
    grid = Grid(
        results=results, lines=lines_of(results, "real"), places=_places(results, "real"), mean=True
    )
    return _table(grid, "5", "Models of real objects")


def table_6(results: Results) -> Table:
    """Mean errors on objects unlike those of training, by trait, beside those like them."""
    kinds: tuple[Kind, ...] = get_args(Kind)
    places = [place for kind in kinds for place in _places(results, kind, unseen=True)]
    lines: list[Line] = []
    for series in sorted({s for kind in kinds for s in results.series(kind, unseen=True)}):
        if series.switches:
            continue
        name = display_name(series)
        traits = {trait for place in places
                  for run in results.runs(series, replace(place, unseen=True))
                  for trait in run.traits}  # fmt: skip
        lines.append(Line(series=series, name=f"{name}, test", ranked=False))
        lines.append(Line(series=series, name=f"{name}, test-ood", unseen=True, ranked=False))
        lines += [
            Line(series=series, name=f"{name}, {trait}", unseen=True, trait=trait, ranked=False)
            for trait in sorted(traits)
        ]
    grid = Grid(results=results, lines=lines, places=places, measures=TABLE_1[:6])
    table = _table(grid, "6", "Objects unlike those of training (test-ood), by what sets them "
                   "apart, beside those like them (test)")  # fmt: skip
    nothing = () if lines else ("Nothing was run on test-ood.",)
    return replace(table, notes=(*general_notes(), *nothing))


def _places(results: Results, kind: Kind, *, unseen: bool = False) -> list[Place]:
    """Places of a kind that have scores, as places of objects like those of training."""
    return [Place(kind, name) for name in results.categories(kind, unseen=unseen)]


def _table(grid: Grid, number: str, title: str) -> Table:
    """The blocks that have rows, and the notes."""
    candidates = [(measure, _rows(grid, measure)) for measure in (*grid.measures, SWAPPED)]
    blocks = [
        Block(heading=_heading(measure, grid), rows=kept(rows),
              higher=(_better(measure),) * (len(grid.places) + grid.mean))
        for measure, rows in candidates
    ]  # fmt: skip
    blocks.append(_seconds(grid))
    kinds = grid.kinds
    columns = [f"{place.category.capitalize()} ({place.kind})" for place in grid.places]
    notes = [budget_notes(results=grid.results, kind=kind, categories=[
        place.category for place in grid.places if place.kind == kind
    ]) for kind in kinds]  # fmt: skip
    asked = [(m.symbol, rows) for m, rows in candidates if m.key not in OPTIONAL]
    missing = left_out(grid.results, asked, *kinds)
    return Table(
        number=number,
        title=title,
        first="Metric",
        groups=(),
        columns=(*columns, "Mean") if grid.mean else tuple(columns),
        blocks=tuple(mark_best(block) for block in blocks if block.rows),
        notes=(*general_notes(), *missing, *(note for lines in notes for note in lines)),
    )


def _better(measure: Measure) -> bool | None:
    return None if measure is SWAPPED else measure.higher


def _heading(measure: Measure, grid: Grid) -> str:
    arrow = "" if measure is SWAPPED else " ↑" if measure.higher else " ↓"
    slides = measure.metric == "joint_state" and any(p.category == "drawer" for p in grid.places)
    unit = measure.heading.replace("deg", "deg or cm") if slides else measure.heading
    return f"{measure.symbol}{arrow} ({unit})"


def _rows(grid: Grid, measure: Measure) -> list[Row]:
    """Every row of a block, printed or not."""
    rows = grid.printed(measure)
    for line in grid.lines:
        if measure is SWAPPED and line.series.switches:
            continue
        parts = [
            measured_in(line.runs(grid.results, place), measure, seed)
            for seed, place in enumerate(grid.places)
        ]
        rows.append(our_row(grid.results, line, parts, mean=grid.mean))
    return rows


def measured_in(runs: Sequence[Scores], measure: Measure, seed: int) -> Sampled | None:
    """`measured`; the state of a joint that slides is in centimetres."""
    found = measured(runs, measure, seed)
    if found is None and measure.metric == "joint_state":
        return measured(runs, replace(measure, unit="m", factor=100), seed)
    return found


def _seconds(grid: Grid) -> Block:
    """Seconds per cloud, as the predictions say."""
    rows = []
    for line in grid.lines:
        if line.series.switches or line.unseen or line.series.method in REFERENCE:
            continue
        cells = [seconds_of(line.runs(grid.results, place)) for place in grid.places]
        known = [cell.value for cell in cells if cell.value is not None]
        if grid.mean:
            whole = len(known) == len(cells) > 0
            cells.append(Cell(value=sum(known) / len(known), decimals=4) if whole else Cell())
        rows.append(line_row(grid.results, line, cells))
    higher = (None,) * (len(grid.places) + grid.mean)
    return Block(heading=SECONDS, rows=kept(rows), higher=higher)
