# SPDX-License-Identifier: MIT
"""Intervals, spreads and paired comparisons, resampled by instance.

Samples of one object are not independent: 20 views of a bad object are one bad object. So
instances are drawn with replacement, each with all of its samples.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

RESAMPLES = 2000
BOOTSTRAP_SEED = 0
LEVEL = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A mean with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float
    count: int
    """Values in the mean."""
    undefined: int
    """Values that could not be computed, left out of the mean."""

    def record(self) -> dict[str, float | int | None]:
        """For JSON, NaN as null."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


def interval(
    values: np.ndarray,
    instance: Int[np.ndarray, " B"],
    *,
    resamples: int = RESAMPLES,
) -> Interval:
    """Mean over all defined values of (B, K) or (B,), resampled by instance.

    Args:
        values: NaN where undefined.
        instance: Which object each of the B samples shows.
        resamples: Bootstrap draws.
    """
    table = np.asarray(values, np.float64).reshape(len(values), -1)
    known = table[~np.isnan(table)]
    if known.size == 0:
        nan = float("nan")
        return Interval(mean=nan, low=nan, high=nan, count=0, undefined=int(table.size))
    low, high = bounds(resampled_means(table, instance, resamples=resamples))
    return Interval(
        mean=float(known.mean()),
        low=low,
        high=high,
        count=int(known.size),
        undefined=int(table.size - known.size),
    )


def bounds(means: Float[np.ndarray, " R"]) -> tuple[float, float]:
    """The 95 % interval of resampled means."""
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def resampled_means(
    values: np.ndarray,
    instance: Int[np.ndarray, " B"],
    *,
    resamples: int = RESAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Float[np.ndarray, " R"]:
    """The mean of the defined values in each resample; a resample without one is left out."""
    table = np.asarray(values, np.float64).reshape(len(values), -1)
    defined = ~np.isnan(table)
    total, count = _by_instance(np.where(defined, table, 0).sum(1), defined.sum(1), instance)
    return _ratio(_draws(len(total), resamples, seed), total, count)


def _by_instance(
    total: Float[np.ndarray, " B"], count: np.ndarray, instance: Int[np.ndarray, " B"]
) -> tuple[Float[np.ndarray, " I"], Float[np.ndarray, " I"]]:
    _, index = np.unique(instance, return_inverse=True)
    return np.bincount(index, total), np.bincount(index, count.astype(np.float64))


@lru_cache(maxsize=64)
def _draws(instances: int, resamples: int, seed: int) -> Int[np.ndarray, "R I"]:
    """How often each instance is drawn in each resample."""
    generator = np.random.default_rng(seed)
    share = np.full(instances, 1 / instances)
    return generator.multinomial(instances, share, size=resamples)


def _ratio(
    draws: Int[np.ndarray, "R I"], total: Float[np.ndarray, " I"], count: Float[np.ndarray, " I"]
) -> Float[np.ndarray, " Q"]:
    """Means of the resamples that hold a value."""
    size = draws @ count
    means = np.divide(draws @ total, size, out=np.full(len(size), np.nan), where=size > 0)
    return means[np.isfinite(means)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """A number over several training seeds."""

    mean: float
    deviation: float
    """Sample standard deviation; NaN for one seed."""
    seeds: int


def spread(values: list[float]) -> Spread:
    """Mean and standard deviation over seeds, undefined ones left out."""
    known = np.array([value for value in values if value == value])
    if len(known) == 0:
        return Spread(mean=float("nan"), deviation=float("nan"), seeds=0)
    deviation = float(known.std(ddof=1)) if len(known) > 1 else float("nan")
    return Spread(mean=float(known.mean()), deviation=deviation, seeds=len(known))


@dataclass(frozen=True, slots=True, kw_only=True)
class Paired:
    """One metric of two methods on the same samples."""

    difference: float
    """Mean of second minus first."""
    low: float
    high: float
    p_value: float
    """Two-sided, of no difference: signs of whole instances flipped at random."""
    samples: int
    """Where both are defined."""


def paired(
    first: Float[np.ndarray, " B"],
    second: Float[np.ndarray, " B"],
    instance: Int[np.ndarray, " B"],
    *,
    resamples: int = RESAMPLES,
) -> Paired:
    """Difference of two methods per sample, its interval and a sign-flip test by instance.

    Args:
        first: One value per sample, NaN where undefined.
        second: The other method, the same samples in the same order.
        instance: Which object each sample shows.
        resamples: Bootstrap draws and sign flips, from a fixed seed.
    """
    difference = second - first
    both = ~np.isnan(difference)
    if not both.any():
        nan = float("nan")
        return Paired(difference=nan, low=nan, high=nan, p_value=nan, samples=0)
    base = interval(difference[both], instance[both], resamples=resamples)
    total, _ = _by_instance(difference[both], np.ones(int(both.sum())), instance[both])
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    flips = generator.choice([-1.0, 1.0], size=(resamples, len(total))) @ total
    # The observed arrangement is one of those possible: never a p-value of 0.
    extreme = np.abs(flips) >= abs(total.sum()) * (1 - 1e-12)
    return Paired(
        difference=base.mean,
        low=base.low,
        high=base.high,
        p_value=float((1 + extreme.sum()) / (1 + resamples)),
        samples=base.count,
    )
