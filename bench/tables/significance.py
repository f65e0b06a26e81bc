# SPDX-License-Identifier: MIT
"""Paired comparison of every two series on the samples that both were scored on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import get_args

import numpy as np
from jaxtyping import Float

from bench.metrics import ApRule
from bench.scoring.score_files import Scores
from bench.scoring.summary import passes
from bench.statistics import Paired, paired
from bench.tables.results import Kind, Place, Results, series_of
from bench.tables.spec import REFERENCE, TABLE_1
from scapo.text import as_cell, csv_text

COLUMNS = (
    "data", "category", "metric", "unit", "first", "second", "difference", "low", "high",
    "p_value", "samples",
)  # fmt: skip
COMPARED = (*((measure.metric, measure.unit) for measure in TABLE_1), ("joint_state", "m"))
"""Metric and unit; a joint has its state in degrees, or in metres where it slides."""


def significance_csv(results: Results, rule: ApRule = "mean") -> str:
    """Second minus first per category and metric, its interval and sign-flip p-value."""
    return csv_text(COLUMNS, _rows(results, rule))


def _rows(results: Results, rule: ApRule) -> Iterator[tuple[object, ...]]:
    for runs_a, runs_b in _pairs(results):
        first, second = runs_a[0], runs_b[0]
        both = (series_of(first), series_of(second))
        names = [as_cell(f"{s.method}/{s.variant}" if s.variant else s.method) for s in both]
        place = (as_cell(first.run.data), as_cell(first.run.category))
        for metric, unit, result in _compared(runs_a, runs_b, rule):
            if result.samples:
                numbers = (result.difference, result.low, result.high, result.p_value)
                yield *place, metric, unit, *names, *map(repr, numbers), result.samples


def _pairs(results: Results) -> Iterator[tuple[list[Scores], list[Scores]]]:
    """Two methods on the same place, default readings only."""
    for kind in get_args(Kind):
        series = [s for s in results.series(kind)
                  if not s.switches and s.method not in REFERENCE]  # fmt: skip
        for a, b in combinations(series, 2):
            for category in results.categories(kind):
                found = [results.runs(s, Place(kind, category)) for s in (a, b)]
                if all(found) and np.array_equal(found[0][0].samples, found[1][0].samples):
                    yield found[0], found[1]


def _compared(
    first: Sequence[Scores], second: Sequence[Scores], rule: ApRule
) -> Iterator[tuple[str, str, Paired]]:
    instance = first[0].instance
    for key in COMPARED:
        values = [
            _per_sample([run.errors[key] for run in runs if key in run.errors])
            for runs in (first, second)
        ]
        if values[0] is not None and values[1] is not None:
            yield *key, paired(values[0], values[1], instance)
    counted = [[passes(run.errors, rule) for run in runs] for runs in (first, second)]
    for name in counted[0][0]:
        values = [
            _per_sample(
                [item[name].reshape(len(item[name]), -1) * 1.0 for item in found if name in item]
            )
            for found in counted
        ]
        if values[0] is not None and values[1] is not None:
            yield name, "1", paired(values[0], values[1], instance)


def _per_sample(tables: list[np.ndarray]) -> Float[np.ndarray, " B"] | None:
    """The mean of a sample's defined slots over all seeds; NaN where it has none."""
    if not tables:
        return None
    joined = np.concatenate(tables, 1)
    defined = ~np.isnan(joined)
    total = np.where(defined, joined, 0).sum(1)
    return np.where(defined.any(1), total / np.maximum(defined.sum(1), 1), np.nan)
