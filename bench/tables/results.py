# SPDX-License-Identifier: MIT
"""All scores of a folder, and the numbers of a table's cells made from them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from bench.metrics import ApRule
from bench.scoring.score_files import SUFFIX, Scores, is_report, read_scores, side_file
from bench.scoring.summary import passes
from bench.statistics import bounds, resampled_means, spread
from bench.tables.model import Cell
from bench.tables.spec import PRECISION_KEYS, Measure
from scapo.store import StoreError

Kind = Literal["clean", "sensor"]
TABLE_SPLIT = "test"
_SWITCHES = re.compile(r"^(?P<variant>.*?)(?:\[(?P<switches>[^\[\]]*)\])?$")


@dataclass(frozen=True, slots=True, order=True)
class Series:
    """One row of a table: a method in one variant, all its training seeds."""

    method: str
    variant: str
    switches: str
    """Readings other than the default, such as `label-order=dataset`."""


@dataclass(frozen=True, slots=True)
class Place:
    """One category of one kind of data."""

    kind: Kind
    category: str


class Results:
    """Scores on the test split by series and place."""

    def __init__(self, scores: Sequence[Scores]) -> None:
        """Group the runs.

        Raises:
            StoreError: One place has scores on two data sets, or a run was scored twice.
        """
        self._runs: dict[tuple[Series, Place], dict[int, Scores]] = {}
        digests: dict[Place, tuple[str, Path]] = {}
        for item in scores:
            if item.run.split != TABLE_SPLIT:
                continue
            place = Place(kind_of(item.run.data), item.run.category)
            data, path = digests.setdefault(place, (item.run.data, item.path))
            if data != item.run.data:
                raise StoreError(
                    f"{item.path}: expected scores on {data} like {path}, found {item.run.data}"
                )
            runs = self._runs.setdefault((series_of(item), place), {})
            if item.run.seed in runs:
                raise StoreError(
                    f"{item.path}: expected one scores file per run, found seed "
                    f"{item.run.seed} also in {runs[item.run.seed].path}"
                )
            runs[item.run.seed] = item

    def series(self, kind: Kind) -> list[Series]:
        """Every series with scores on data of this kind, sorted."""
        return sorted({series for series, place in self._runs if place.kind == kind})

    def runs(self, series: Series, place: Place) -> list[Scores]:
        """Its runs there, by seed."""
        found = self._runs.get((series, place), {})
        return [found[seed] for seed in sorted(found)]

    def all_runs(self) -> list[Scores]:
        """Every run, sorted."""
        keys = sorted(self._runs, key=lambda key: (key[0], key[1].kind, key[1].category))
        return [run for key in keys for run in self.runs(*key)]


def load(folder: Path) -> Results:
    """Every `*.csv.gz` below a folder.

    Raises:
        StoreError: No such folder, a file that is no scores file, or scores or a report alone.
    """
    if not folder.is_dir():
        raise StoreError(f"{folder}: expected a folder of scores, found none")
    files = sorted(folder.rglob(f"*{SUFFIX}"))
    alone = {path for path in folder.rglob("*.json") if is_report(path)} - set(
        map(side_file, files)
    )
    for path in sorted(alone):
        raise StoreError(f"{path}: expected the scores of this report beside it, found none")
    return Results([scores for file in files for scores in read_scores(file)])


def kind_of(data: str) -> Kind:
    """Which tables the data belong to, from the name before the `@`."""
    name = data.partition("@")[0].rpartition("/")[2]
    return "sensor" if name.endswith("sensor") or name.startswith("op-align-real") else "clean"


def series_of(scores: Scores) -> Series:
    """The row that a run belongs to."""
    match = _SWITCHES.match(scores.run.variant)
    variant, switches = (match["variant"], match["switches"] or "") if match else ("", "")
    return Series(scores.run.method, variant, switches)


@dataclass(frozen=True, slots=True)
class Sampled:
    """A category's values and how their mean varies over resampled instances."""

    cell: Cell
    means: Float[np.ndarray, " R"]
    per_seed: tuple[float, ...]


def measured(runs: Sequence[Scores], measure: Measure, seed: int) -> Sampled | None:
    """Mean over samples, slots and seeds; None where nothing was run or is defined."""
    key = (measure.metric, measure.unit)
    tables = [run.errors[key] * measure.factor for run in runs if key in run.errors]
    if not tables or all(np.isnan(table).all() for table in tables):
        return None
    return _sampled(runs, tables, measure.decimals, seed)


def precise(runs: Sequence[Scores], key: str, rule: ApRule, seed: int) -> Sampled | None:
    """Average precision in percent: k of n samples, over all seeds."""
    found = [passes(run.errors, rule).get(key) for run in runs]
    tables = [100.0 * table.reshape(len(table), -1) for table in found if table is not None]
    if not tables:
        return None
    sampled = _sampled(runs, tables, 2, seed)
    passed, count = sum(int((t > 0).sum()) for t in tables), sum(t.size for t in tables)
    return Sampled(_with_precision(sampled.cell, passed, count), sampled.means, sampled.per_seed)


def _with_precision(cell: Cell, passed: int, count: int) -> Cell:
    value = 100 * passed / count
    if cell.value is None or abs(cell.value - value) > 1e-9:
        raise ArithmeticError(f"average precision: expected k/n = {value}, found {cell.value}")
    return Cell(
        value=value,
        decimals=cell.decimals,
        low=cell.low,
        high=cell.high,
        deviation=cell.deviation,
        count=count,
        passed=passed,
    )


def _sampled(runs: Sequence[Scores], tables: list[np.ndarray], decimals: int, seed: int) -> Sampled:
    instance = _same_samples(runs)
    joined = np.concatenate(tables, 1)
    defined = joined[~np.isnan(joined)]
    means = resampled_means(joined, instance, seed=seed)
    per_seed = tuple(float(np.nanmean(t)) for t in tables if not np.isnan(t).all())
    low, high = bounds(means)
    cell = Cell(
        value=float(defined.mean()), decimals=decimals, low=low, high=high,
        deviation=_deviation(per_seed), count=int(defined.size),
        undefined=int(joined.size - defined.size),
    )  # fmt: skip
    return Sampled(cell, means, per_seed)


def _deviation(per_seed: Sequence[float]) -> float | None:
    return spread(list(per_seed)).deviation if len(per_seed) > 1 else None


def _same_samples(runs: Sequence[Scores]) -> Int[np.ndarray, " B"]:
    """The instances of the samples that all seeds share.

    Raises:
        StoreError: The seeds were scored on other samples.
    """
    first = runs[0]
    for run in runs[1:]:
        if not np.array_equal(run.samples, first.samples):
            raise StoreError(
                f"{run.path}: expected the {len(first.samples)} samples of "
                f"{first.path}, found {len(run.samples)} others"
            )
    return first.instance


def averaged(parts: Sequence[Sampled | None]) -> Cell:
    """The mean over categories, from unrounded cells; empty unless every category was run."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or not known:
        return Cell()
    values = [part.cell.value for part in known if part.cell.value is not None]
    size = min(len(part.means) for part in known)
    low, high = bounds(np.mean([part.means[:size] for part in known], axis=0))
    seeds = {len(part.per_seed) for part in known}
    per_seed = np.mean([part.per_seed for part in known], axis=0) if len(seeds) == 1 else []
    return Cell(
        value=float(np.mean(values)), decimals=known[0].cell.decimals, low=low, high=high,
        deviation=_deviation([float(value) for value in per_seed]),
        undefined=sum(part.cell.undefined for part in known),
    )  # fmt: skip


def check_monotone(values: dict[str, Sampled | None]) -> None:
    """Assert that a wider threshold never passes fewer.

    Raises:
        ArithmeticError: It does.
    """
    for group in (PRECISION_KEYS[:2], PRECISION_KEYS[2:5], PRECISION_KEYS[5:]):
        counts = [item.cell.passed for key in group if (item := values[key]) is not None]
        known = [count for count in counts if count is not None]
        if known != sorted(known):
            raise ArithmeticError(
                f"average precision {group}: expected counts that rise with the "
                f"threshold, found {known}"
            )
