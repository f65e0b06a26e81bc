# SPDX-License-Identifier: MIT
"""What is printed under every table: how to read it, and what each row cost."""

from __future__ import annotations

from collections.abc import Sequence

from bench.results import Kind, Results, kind_of
from bench.table_data import METHODS


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
        budget = run.report.get("budget") or {}
        cost = (
            ", ".join(
                f"{key.replace('_', ' ')} {_short(value)}" for key, value in sorted(budget.items())
            )
            or "not stated"
        )
        name = METHODS.get(run.run.method, run.run.method)
        variant = f" ({run.run.variant})" if run.run.variant else ""
        text = (
            f"{name}{variant}, {run.run.category} on {run.run.data}, "
            f"{len(run.samples)} samples; budget: {cost}"
        )
        lines.setdefault(text, set()).add(run.run.seed)
    return tuple(
        f"{text}; seeds {', '.join(map(str, sorted(seeds)))}." for text, seeds in lines.items()
    )


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
