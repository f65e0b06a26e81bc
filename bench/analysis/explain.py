# SPDX-License-Identifier: MIT
"""Why a method fails: its errors by what was seen, and its oracle ladder, measured and as CSV."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bench.analysis.ladder import RUNGS, Rung, climb
from bench.analysis.strata import Stratum, factors, stratify
from bench.requests import Request
from bench.scoring.evaluate import fit_frames, open_data
from bench.scoring.scores import Errors
from bench.scoring.truth import blocks
from bench.statistics import Interval, interval
from scapo.store.predictions import Predictions
from scapo.store.provenance import commit
from scapo.text import csv_text

STRATA_COLUMNS = ("factor", "lower", "upper", "metric", "unit", "samples", "mean", "low", "high",
                  "n", "undefined")  # fmt: skip
LADDER_COLUMNS = ("rung", "metric", "unit", "mean", "low", "high", "n", "undefined")


Ladder = dict[Rung, dict[tuple[str, str], Interval]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """What `explain` found."""

    title: str
    strata: tuple[Stratum, ...]
    ladder: Ladder
    medians: dict[Rung, dict[tuple[str, str], float]]
    facts: dict[str, str]
    """What was explained, by which code."""


def measure(request: Request) -> Explanation:
    """Strata and ladder of a predictions file.

    Raises:
        StoreError: As `evaluate`.
    """
    header, split = open_data(request)
    rungs: dict[Rung, list[Errors]] = {rung: [] for rung in RUNGS}
    seen: list[dict[str, np.ndarray]] = []
    instances: list[np.ndarray] = []
    with Predictions(request.predictions, split) as predictions:
        fitted = fit_frames(request, header, split, predictions)
        for truth in blocks(split):
            rows = predictions.rows(truth.first, len(truth))
            climbed = climb(
                truth, rows, settings=request.settings, frames=fitted.frames, order=fitted.order
            )
            for rung, errors in climbed.items():
                rungs[rung].append(errors)
            seen.append(factors(truth, split.manifest))
            instances.append(truth.instance)
        predictions.finish()
    instance = np.concatenate(instances)
    joined: dict[Rung, Errors] = {rung: _joined(found) for rung, found in rungs.items()}
    values = {name: np.concatenate([block[name] for block in seen]) for name in seen[0]}
    words = (header.method, header.variant, header.category, header.split)
    return Explanation(
        medians={
            rung: {key: _median(table) for key, table in errors.items()}
            for rung, errors in joined.items()
        },
        facts={
            "samples": f"{len(instance)} of {len(np.unique(instance))} objects",
            "seed": str(header.seed),
            "data": header.data_digest[:12],
            "code": commit(),
        },
        title=" ".join(word for word in words if word),
        strata=tuple(stratify(joined["predicted"], values, instance)),
        ladder={
            rung: {key: interval(table, instance) for key, table in errors.items()}
            for rung, errors in joined.items()
        },
    )


def _median(table: np.ndarray) -> float:
    known = table[np.isfinite(table)]
    return float(np.median(known)) if known.size else float("nan")


def _joined(found: list[Errors]) -> Errors:
    return {key: np.concatenate([errors[key] for errors in found]) for key in found[0]}


def _fields(value: Interval) -> tuple[object, ...]:
    record = value.record()
    return tuple("" if record[name] is None else record[name]
                 for name in ("mean", "low", "high", "count", "undefined"))  # fmt: skip


def strata_csv(strata: Iterable[Stratum]) -> str:
    """A row per bin and metric."""
    return csv_text(STRATA_COLUMNS, (
        (s.factor, s.lower, s.upper, s.metric, s.unit, s.samples, *_fields(s.value))
        for s in strata
    ))  # fmt: skip


def ladder_csv(ladder: Ladder) -> str:
    """A row per rung and metric."""
    return csv_text(LADDER_COLUMNS, (
        (rung, metric, unit, *_fields(value))
        for rung, values in ladder.items() for (metric, unit), value in values.items()
    ))  # fmt: skip
