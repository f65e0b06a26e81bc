# SPDX-License-Identifier: MIT
"""Rows of the tables, the paper's as printed and ours from the scores, and their order.

Below them the notes of every table: how to read it, and what each row cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.methods import all_methods
from bench.tables.model import Cell, Marks, Row
from bench.tables.paper import MEAN, Cells, Mismatch
from bench.tables.results import Kind, Results, Sampled, Series, averaged, kind_of
from bench.tables.spec import PAPER_METHODS, PUBLISHED, REFERENCE, TABLE_1
from scapo.text import one_line

DATASET_ORDER = "label-order=dataset"


def printed_rows(
    cells: Cells, wrong: Sequence[Mismatch], table: str, metric: str, columns: Sequence[str]
) -> list[Row]:
    """The paper's rows of one metric over categories; a cell that it has not is a dash."""
    flagged = {(m.table, m.metric, m.method) for m in wrong}
    methods = dict.fromkeys(key[2] for key in cells if key[0] == table)
    rows = []
    for method in methods:
        found = [cells.get((table, metric, method, name)) for name in columns]
        marks = next(cell.marks for key, cell in cells.items() if key[::2] == (table, method))
        row = tuple(
            Cell() if cell is None else Cell(
                value=cell.value, text=cell.text,
                flag=name == MEAN and (table, metric, method) in flagged,
            )
            for name, cell in zip(columns, found, strict=True)
        )  # fmt: skip
        if any(cell.value is not None for cell in row) or metric in {m.key for m in TABLE_1[:5]}:
            rows.append(
                Row(
                    method=PAPER_METHODS.get(method, method), source="paper", marks=marks, cells=row
                )
            )
    return rows


def listed_series(results: Results, kind: Kind, *, with_order: bool) -> list[Series]:
    """Rows of ours: every method and variant, the references, and S with one order per data set."""
    plain = [series for series in results.series(kind) if not series.switches]
    plain += [
        Series(name, "", "") for name in REFERENCE if all(series.method != name for series in plain)
    ]
    others = [
        series for series in results.series(kind) if series.switches not in ("", DATASET_ORDER)
    ]
    if with_order:
        others += [
            replace(series, switches=DATASET_ORDER)
            for series in plain
            if series.method not in REFERENCE
        ]
    return sorted(plain + others)


def our_row(
    results: Results, series: Series, parts: Sequence[Sampled | None], *, mean: bool = True
) -> Row:
    """A cell per category and, if wanted, their mean."""
    cells = [Cell() if part is None else part.cell for part in parts]
    seeds = max((len(part.per_seed) for part in parts if part is not None), default=0)
    return Row(
        method=display_name(series),
        source="ours",
        marks=marks_of(results, series),
        cells=(*cells, averaged(parts)) if mean else tuple(cells),
        ranked=series.method not in REFERENCE and not series.switches,
        seeds=seeds,
    )


def titles() -> dict[str, tuple[str, int]]:
    """Names of methods in scores -> what a table calls them, and their rank."""
    return PUBLISHED | {name: (one.title, one.rank) for name, one in all_methods().items()}


def title(method: str) -> str:
    """What a table calls a method."""
    return REFERENCE.get(method) or titles().get(method, (method, 0))[0]


def display_name(series: Series) -> str:
    """What a table calls a series."""
    name = title(series.method)
    if series.variant not in ("", "default"):
        name += f" ({series.variant})"
    if series.switches == DATASET_ORDER:
        name += ", one part order"
    elif series.switches:
        name += f", {series.switches}"
    return name


def marks_of(results: Results, series: Series) -> Marks | None:
    """The labels that training used, from the reports beside the scores."""
    for run in results.all_runs():
        same = (run.run.method, run.run.variant.partition("[")[0]) == (
            series.method, series.variant)  # fmt: skip
        if same and series.method not in REFERENCE:
            labels = run.report.supervision
            return ("pose" in labels, "segmentation" in labels, "joint" in labels)
    return None


def in_order(rows: Sequence[Row]) -> list[Row]:
    """By the rank of methods, each printed row before ours of that method; references last."""
    order = [name for name, _ in sorted(titles().values(), key=lambda one: one[1])]

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
        "Bold: best among self-supervised rows (fewer than three check marks), printed and ours "
        "apart. – does not exist or was not run.",
        "In brackets: 95 % bootstrap interval, resampled by instance; ± standard deviation over "
        "training seeds.",
        "The part order is chosen per sample, which flatters two-part methods; rows with one part "
        "order choose it once per data set.",
    )


def budget_notes(results: Results, kind: Kind, categories: Sequence[str]) -> tuple[str, ...]:
    """One line per run series: seeds, data and what its header says of its cost."""
    lines: dict[str, set[int]] = {}
    for run in results.all_runs():
        if (
            kind_of(run.run.data) != kind
            or run.run.category not in categories
            or "[" in run.run.variant
        ):
            continue
        budget = run.report.budget
        named = {_short(key.replace("_", " ")): value for key, value in sorted(budget.items())}
        cost = ", ".join(f"{key} {_short(value)}" for key, value in named.items())
        name = title(run.run.method)
        variant = f" ({run.run.variant})" if run.run.variant else ""
        text = (
            f"{name}{variant}, {run.run.category} on {run.run.data}, "
            f"{len(run.samples)} samples; budget: {cost or 'not stated'}"
        )
        lines.setdefault(text, set()).add(run.run.seed)
    return tuple(
        f"{text}; seeds {', '.join(map(str, sorted(seeds)))}." for text, seeds in lines.items()
    )


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else one_line(value, 200)
