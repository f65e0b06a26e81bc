# SPDX-License-Identifier: MIT
"""All scores of a folder, and the numbers of a table's cells made from them."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from jaxtyping import Float, Int

from bench.metrics import ApRule
from bench.scoring.score_files import SUFFIX, Scores, is_report, read_scores, side_file
from bench.scoring.summary import passes, swapped
from bench.statistics import bounds, resampled_means, spread
from bench.tables.model import Cell
from bench.tables.spec import PRECISION_KEYS, REFERENCE, Measure
from scapo.store import StoreError

Kind = Literal["clean", "complete", "isolated", "sensor", "real"]
"""What data are: single views, whole surfaces, parts seen alone, a sensor's, real models."""
TABLE_SPLIT, UNSEEN_SPLIT = "test", "test-ood"
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
    unseen: bool = False
    """The split of objects unlike those of training."""


class Results:
    """Scores by series and place."""

    def __init__(self, scores: Sequence[Scores], split: str = TABLE_SPLIT) -> None:
        """Group the runs on `split`, and those on objects unlike the training's.

        Raises:
            StoreError: One place has scores on two data sets, a run was scored twice, or two
                readings of a run are of different predictions.
        """
        self._runs: dict[tuple[Series, Place], dict[int, Scores]] = {}
        self.splits = sorted({item.run.split for item in scores})
        """Of all scores, those that are left out too."""
        digests: dict[Place, tuple[str, Path]] = {}
        for item in scores:
            if item.run.split not in (split, UNSEEN_SPLIT):
                continue
            unseen = item.run.split != split
            place = Place(kind_of(item.run.data), item.run.category, unseen)
            data, path = digests.setdefault(place, (item.run.data, item.path))
            if data != item.run.data:
                raise StoreError(
                    f"{item.path}: expected scores on {data} like {path}, found {item.run.data}"
                )
            runs = self._runs.setdefault((series_of(item), place), {})
            if item.run.method in REFERENCE and _same(item, runs.get(item.run.seed)):
                continue  # made beside the scores of several methods
            if item.run.seed in runs:
                raise StoreError(
                    f"{item.path}: expected one scores file per run, found seed "
                    f"{item.run.seed} also in {runs[item.run.seed].path}"
                )
            runs[item.run.seed] = item
        self._check_readings()

    def _check_readings(self) -> None:
        """Refuse further readings of other predictions than the row they stand beside."""
        for (series, place), runs in self._runs.items():
            plain = self._runs.get((replace(series, switches=""), place), {})
            for seed, item in runs.items():
                if seed not in plain:
                    continue
                mine, its = (one.report.digests.predictions for one in (item, plain[seed]))
                if mine != its:
                    raise StoreError(
                        f"{item.path}: expected scores of the predictions of {plain[seed].path}, "
                        "found those of others"
                    )

    def series(self, kind: Kind, *, unseen: bool = False) -> list[Series]:
        """Every series with scores on data of this kind, sorted."""
        wanted = (kind, unseen)
        return sorted({s for s, place in self._runs if (place.kind, place.unseen) == wanted})

    def runs(self, series: Series, place: Place) -> list[Scores]:
        """Its runs there, by seed."""
        found = self._runs.get((series, place), {})
        return [found[seed] for seed in sorted(found)]

    def categories(self, kind: Kind, *, unseen: bool = False) -> list[str]:
        """Every category with scores on data of this kind, sorted."""
        wanted = (kind, unseen)
        return sorted({p.category for _, p in self._runs if (p.kind, p.unseen) == wanted})

    def all_runs(self, *, unseen: bool = True) -> list[Scores]:
        """Every run, sorted; those on objects unlike the training's only if wanted."""
        keys = sorted(
            (key for key in self._runs if unseen or not key[1].unseen),
            key=lambda key: (key[0], key[1].kind, key[1].category, key[1].unseen),
        )
        return [run for key in keys for run in self.runs(*key)]


def _same(item: Scores, other: Scores | None) -> bool:
    """Whether two scores of one run say the same, but for the last digits of another machine."""
    return (
        other is not None
        and item.errors.keys() == other.errors.keys()
        and all(
            table.shape == other.errors[key].shape
            and np.allclose(table, other.errors[key], rtol=1e-5, atol=1e-5, equal_nan=True)
            for key, table in item.errors.items()
        )
    )


def load(folder: Path, split: str = TABLE_SPLIT) -> Results:
    """Every `*.csv.gz` below a folder.

    Raises:
        StoreError: No such folder, a file that is no scores file, or scores or a report alone.
    """
    if not folder.is_dir():
        raise StoreError(
            f"{folder}: expected a folder of scores, found none; `scapo-bench evaluate` writes them"
        )
    files = sorted(folder.rglob(f"*{SUFFIX}"))
    alone = {path for path in folder.rglob("*.json") if is_report(path)} - set(
        map(side_file, files)
    )
    for path in sorted(alone):
        raise StoreError(f"{path}: expected the scores of this report beside it, found none")
    return Results([scores for file in files for scores in read_scores(file)], split)


def kind_of(data: str) -> Kind:
    """Which tables the data belong to, from the name before the `@`."""
    name = data.partition("@")[0].rpartition("/")[2]
    if name.endswith("sensor") or name.startswith("op-align-real"):
        return "sensor"
    last = name.rpartition("-")[2]
    return cast("Kind", last) if last in ("complete", "isolated", "real") else "clean"


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
    per_seed: Mapping[int, float]
    """The mean of each training seed that has one."""
    unit: str = "1"


def measured(runs: Sequence[Scores], measure: Measure, seed: int) -> Sampled | None:
    """Mean over samples, slots and seeds; None where nothing was run or is defined."""
    key = (measure.metric, measure.unit)
    found = {run.run.seed: run.errors[key] for run in runs if key in run.errors}
    tables = {
        one: measure.factor * (swapped(table) if key[0] == "order" else table)
        for one, table in found.items()
    }
    if all(np.isnan(table).all() for table in tables.values()):
        return None
    sampled = replace(_sampled(runs, tables, measure.decimals, seed), unit=measure.unit)
    return _marked(sampled, runs, measure.metric)


def _marked(sampled: Sampled, runs: Sequence[Scores], metric: str) -> Sampled:
    """Marked where some run lacks a calibration that this metric needs."""
    lacks = any(run.report.lacks_calibration(metric) for run in runs)
    return replace(sampled, cell=replace(sampled.cell, uncalibrated=lacks))


def seconds_per_cloud(runs: Sequence[Scores]) -> Cell:
    """As the predictions say it, a mean over seeds; empty where one does not say it."""
    found = [run.report.cost("seconds_per_cloud") for run in runs]
    known = [value for value in found if value is not None]
    if not known or len(known) < len(found):
        return Cell()
    return Cell(value=float(np.mean(known)), decimals=4)


def precise(runs: Sequence[Scores], key: str, rule: ApRule, seed: int) -> Sampled | None:
    """Average precision in percent: k of n samples, over all seeds."""
    found = {run.run.seed: passes(run.errors, rule).get(key) for run in runs}
    tables = {
        one: 100.0 * table.reshape(len(table), -1)
        for one, table in found.items() if table is not None
    }  # fmt: skip
    if not tables:
        return None
    sampled = _sampled(runs, tables, 2, seed)
    passed = sum(int((table > 0).sum()) for table in tables.values())
    count = sum(table.size for table in tables.values())
    sampled = replace(sampled, cell=_with_precision(sampled.cell, passed, count))
    return _marked(sampled, runs, "part_rotation" if key.startswith("part") else key)


def _with_precision(cell: Cell, passed: int, count: int) -> Cell:
    value = 100 * passed / count
    if cell.value is None or abs(cell.value - value) > 1e-9:
        raise ArithmeticError(f"average precision: expected k/n = {value}, found {cell.value}")
    return replace(cell, value=value, count=count, passed=passed, undefined=0)


def _sampled(
    runs: Sequence[Scores], tables: Mapping[int, np.ndarray], decimals: int, seed: int
) -> Sampled:
    instance = _same_samples(runs)
    joined = np.concatenate(list(tables.values()), 1)
    defined = joined[~np.isnan(joined)]
    means = resampled_means(joined, instance, seed=seed)
    per_seed = {
        one: float(np.nanmean(table)) for one, table in tables.items()
        if not np.isnan(table).all()
    }  # fmt: skip
    low, high = bounds(means)
    cell = Cell(
        value=float(defined.mean()), decimals=decimals, low=low, high=high,
        deviation=_deviation(per_seed.values()), count=int(defined.size),
        undefined=int(joined.size - defined.size),
    )  # fmt: skip
    return Sampled(cell, means, per_seed)


def _deviation(per_seed: Collection[float]) -> float | None:
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
    """The mean over categories, from unrounded cells.

    Empty unless every category was run, and where they have two units: the states of drawers are
    lengths, those of other joints angles. Without a deviation where categories have other seeds.
    """
    known = [part for part in parts if part is not None]
    if len(known) < len(parts) or len({part.unit for part in known}) != 1:
        return Cell()
    values = [part.cell.value for part in known if part.cell.value is not None]
    size = min(len(part.means) for part in known)
    low, high = bounds(np.mean([part.means[:size] for part in known], axis=0))
    seeds = known[0].per_seed
    alike = all(part.per_seed.keys() == seeds.keys() for part in known)
    per_seed = [float(np.mean([part.per_seed[one] for part in known])) for one in seeds if alike]
    return Cell(
        value=float(np.mean(values)), decimals=known[0].cell.decimals, low=low, high=high,
        deviation=_deviation(per_seed),
        undefined=sum(part.cell.undefined for part in known),
        uncalibrated=any(part.cell.uncalibrated for part in known),
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
