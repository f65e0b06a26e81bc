# SPDX-License-Identifier: MIT
"""Rows of the tables, the paper's as printed and ours from the scores, and their order.

Below them the notes of every table: how to read it, and what each row cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bench.methods import all_methods
from bench.scoring.score_files import Counts, Report, Scores
from bench.tables.model import DASH, Cell, Marks, Row
from bench.tables.paper import MEAN, Cells, Mismatch
from bench.tables.results import (
    Kind,
    Place,
    Results,
    Sampled,
    Series,
    averaged,
    kind_of,
    series_of,
)
from bench.tables.spec import (
    PAPER_METHODS,
    PUBLISHED,
    READINGS,
    REFERENCE,
)
from scapo.text import one_line


def printed_rows(
    cells: Cells, wrong: Sequence[Mismatch], table: str, columns: Sequence[tuple[str, str]]
) -> list[Row]:
    """The paper's rows of a table, by metric and category of each column; what it lacks is a dash.

    Args:
        cells: All that is printed.
        wrong: Printed means to be flagged.
        table: Its number.
        columns: Metric and category of each.
    """
    flagged = {(m.table, m.metric, m.method) for m in wrong}
    rows = []
    for method in dict.fromkeys(key[2] for key in cells if key[0] == table):
        marks = next(cell.marks for key, cell in cells.items() if key[::2] == (table, method))
        row = list[Cell]()
        for metric, category in columns:
            cell = cells.get((table, metric, method, category))
            flag = category == MEAN and (table, metric, method) in flagged
            row.append(
                Cell() if cell is None else Cell(value=cell.value, text=cell.text, flag=flag)
            )
        name = PAPER_METHODS.get(method, method)
        rows.append(Row(method=name, source="paper", marks=marks, cells=tuple(row)))
    return rows


def our_row(
    results: Results, line: Line, parts: Sequence[Sampled | None], *, mean: bool = True
) -> Row:
    """A cell per category and, if wanted, their mean."""
    cells = [Cell() if part is None else part.cell for part in parts]
    return line_row(results, line, (*cells, averaged(parts)) if mean else cells, parts)


def line_row(
    results: Results, line: Line, cells: Sequence[Cell], parts: Sequence[object] = ()
) -> Row:
    """A row of ours with these cells.

    Args:
        results: For what methods say of themselves.
        line: What the row is of.
        cells: Its values.
        parts: What they are made of, to count training seeds.
    """
    series = line.series
    seeds = [len(part.per_seed) for part in parts if isinstance(part, Sampled)]
    return Row(
        method=line.name,
        source="ours",
        marks=marks_of(results, series),
        camera=camera_of(results, series),
        cells=tuple(cells),
        seeds=max(seeds, default=0),
        ranked=series.method not in REFERENCE and not series.switches and line.ranked,
        plain=display_name(replace(series, switches="")) if series.switches else "",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A row to be: a series on all samples of its places, or on some."""

    series: Series
    name: str
    unseen: bool = False
    """On the objects unlike those of training."""
    trait: str = ""
    """Of these alone, if any."""
    ranked: bool = True

    def runs(self, results: Results, place: Place) -> list[Scores]:
        """Its runs at a place, by seed."""
        found = results.runs(self.series, replace(place, unseen=self.unseen))
        if not self.trait:
            return found
        return [few for run in found if len((few := run.of_trait(self.trait)).samples)]


def lines_of(results: Results, *kinds: Kind) -> list[Line]:
    """Every series scored on data of these kinds, further readings too."""
    found = sorted({series for kind in kinds for series in results.series(kind)})
    return [Line(series=series, name=display_name(series)) for series in found]


def kept(rows: Sequence[Row]) -> tuple[Row, ...]:
    """The rows to print, in order.

    None without a number, and none of a further reading that only repeats the row it belongs to.
    """
    plain = {row.method: row for row in rows if row.source == "ours" and not row.plain}
    return tuple(
        row
        for row in in_order(rows)
        if not row.empty and not (row.plain in plain and row.repeats(plain[row.plain]))
    )


def titles() -> dict[str, tuple[str, int]]:
    """Names of methods in scores -> what a table calls them, and their rank."""
    return PUBLISHED | {name: (one.title, one.rank) for name, one in all_methods().items()}


def _ranked() -> list[str]:
    """What tables call the methods, by rank."""
    return [name for name, _ in sorted(titles().values(), key=lambda one: one[1])]


def title(method: str) -> str:
    """What a table calls a method."""
    return REFERENCE.get(method) or titles().get(method, (method, 0))[0]


def display_name(series: Series) -> str:
    """What a table calls a series."""
    name = title(series.method)
    if series.variant not in ("", "default"):
        name += f" ({series.variant})"
    if series.switches:
        name += f", {READINGS.get(series.switches, series.switches)}"
    return name


def _runs_of(results: Results, series: Series) -> list[Scores]:
    """Every run of a method in a variant, whatever its reading."""
    return [
        run
        for run in results.all_runs()
        if (run.run.method, run.run.variant.partition("[")[0]) == (series.method, series.variant)
    ]


def marks_of(results: Results, series: Series) -> Marks | None:
    """The labels that training used, from the reports beside the scores."""
    for run in _runs_of(results, series):
        labels = run.report.supervision
        return ("pose" in labels, "segmentation" in labels, "joint" in labels)
    return None


def camera_of(results: Results, series: Series) -> bool | None:
    """Whether it uses where the camera stands; None where a run does not say or two differ."""
    said = {run.report.camera for run in _runs_of(results, series)}
    return said.pop() if len(said) == 1 else None


def in_order(rows: Sequence[Row]) -> list[Row]:
    """By the rank of methods, each printed row before ours of that method; references last."""
    order = _ranked()

    def rank(row: Row) -> tuple[int, int]:
        known = [i for i, name in enumerate(order) if row.method.startswith(name)]
        reference = row.method.startswith(tuple(REFERENCE.values()))
        return (known[-1] if known else len(order) + reference, row.source != "paper")

    return sorted(rows, key=rank)


def general_notes() -> tuple[str, ...]:
    """How to read a table."""
    return (
        "Rows marked paper are as printed, on other data: for orientation. Means of our rows are "
        "computed from unrounded cells and empty unless every category was run.",
        "† A printed mean that the cells of its own row do not give.",
        "Pose, Seg., Joint: labels that training used; Camera: whether where the camera stands is "
        "used (– not said). Constant and Oracle pose are no methods: the means of the training "
        "labels, placed at the cloud's centroid or at the true pose of the base.",
        "Bold: best among self-supervised rows (fewer than three check marks), printed and ours "
        "apart. – does not exist or was not run.",
        "In brackets: 95 % bootstrap interval, resampled by instance; ± standard deviation over "
        "training seeds.",
        "The part order is chosen per sample, which flatters two-part methods; rows with one part "
        "order choose it once per data set. Ambiguity-aware rows are scored against the best of "
        "the turns that nobody can tell from the truth (docs/ambiguity.md). Both stand only where "
        "they differ from the row they belong to.",
    )


def left_out(
    results: Results, candidates: Sequence[tuple[str, Sequence[Row]]], *kinds: Kind
) -> tuple[str, ...]:
    """One line on what was not run, or has no value: nothing where all is there.

    Args:
        results: All scores.
        candidates: Of each block what it is called, and its rows, printed or not.
        kinds: Of the table's data.
    """
    series = {one for kind in kinds for one in results.series(kind)}
    run = {title(one.method) for one in series}
    names = dict.fromkeys((*REFERENCE.values(), *_ranked()))
    missing = {"Not run": [name for name in names if name not in run]}
    plain = sorted(one for one in series if not one.switches)
    for reading, words in READINGS.items():
        missing[f"Not scored as {words}"] = [
            display_name(one) for one in plain if replace(one, switches=reading) not in series
        ]
    empty: dict[str, list[str]] = {}
    for symbol, rows in candidates:
        for row in rows:
            if row.empty and not row.plain:
                name = row.method if row.source == "ours" else f"{row.method} as printed"
                empty.setdefault(name, []).append(symbol)
    sentences = [f"{what}: {'; '.join(words)}." for what, words in missing.items() if words]
    if empty:
        told = (f"{name} ({', '.join(symbols)})" for name, symbols in empty.items())
        sentences.append(f"Without a value: {'; '.join(told)}.")
    return (" ".join(sentences),) if sentences else ()


def budget_notes(results: Results, kind: Kind, categories: Sequence[str]) -> tuple[str, ...]:
    """One line per run series: seeds, data, labels and what its header says of its cost."""
    lines: dict[str, set[int]] = {}
    for run in results.all_runs(unseen=False):
        if (
            kind_of(run.run.data) != kind
            or run.run.category not in categories
            or "[" in run.run.variant
        ):
            continue
        name = display_name(series_of(run))
        text = (
            f"{name}, {run.run.category} on {run.run.data} ({run.run.split}), "
            f"{_answered(run.report.counts)}; "
            f"labels: {', '.join(run.report.supervision) or 'none'}; "
            f"{_cost(run.report)}"
        )
        lines.setdefault(text, set()).add(run.run.seed)
    return tuple(
        f"{text}; seeds {', '.join(map(str, sorted(seeds)))}." for text, seeds in lines.items()
    )


def _answered(counts: Counts) -> str:
    """Samples, and how many have every answer: what others lack is in no mean, but fails the AP.

    Where more lack one tensor than another, they need not be the same samples.

    >>> _answered(Counts(samples=1000, instances=50, unanswered={"part_weight": 700}))
    '1000 samples, 300 of them answered'
    >>> _answered(Counts(samples=5, instances=1, unanswered={"joint_axis": 0, "part_weight": 0}))
    '5 samples'
    >>> _answered(Counts(samples=9, instances=3, unanswered={"joint_axis": 2, "part_weight": 1}))
    '9 samples, at most 7 of them answered'
    """
    lacking = {number for number in counts.unanswered.values() if number}
    if not lacking:
        return f"{counts.samples} samples"
    most = "at most " if len(lacking) > 1 else ""
    return f"{counts.samples} samples, {most}{counts.samples - max(lacking)} of them answered"


TOLD = ("device", "processor", "batch", "seconds_per_cloud")
"""Of a budget: what is told of every row, said or not."""


def _cost(report: Report) -> str:
    """What the predictions say of their cost, as text."""
    seconds = report.cost("seconds_per_cloud")
    told = [
        f"device {_said(report, 'device')}",
        *([f"processor {_said(report, 'processor')}"] if "processor" in report.budget else []),
        f"batch {_said(report, 'batch')}",
        f"seconds per cloud {DASH if seconds is None else _short(seconds)}",
    ]
    others = [
        f"{_short(key.replace('_', ' '))} {_short(value)}"
        for key, value in sorted(report.budget.items())
        if key not in TOLD
    ]
    return f"{', '.join(told)}; budget: {', '.join(others) or 'not stated'}"


def _said(report: Report, name: str) -> str:
    return _short(report.budget[name]) if name in report.budget else DASH


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else one_line(value, 200)
