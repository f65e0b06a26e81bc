# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bench.statistics import interval, paired, resampled_means, spread


def test_mean_and_counts():
    values = np.array([[1.0, 3.0], [np.nan, 5.0], [np.nan, np.nan]])
    found = interval(values, np.array([0, 0, 1]))
    assert found.mean == pytest.approx(3)
    assert (found.count, found.undefined) == (3, 3)
    empty = interval(np.full((4, 2), np.nan), np.arange(4))
    assert np.isnan([empty.mean, empty.low, empty.high]).all()
    assert empty.record()["mean"] is None
    assert empty.undefined == 8


def test_instances_are_resampled_not_samples():
    """Twenty copies of each object's value carry no more than one: the interval stays as wide."""
    generator = np.random.default_rng(0)
    per_object = generator.normal(size=30)
    once = interval(per_object, np.arange(30))
    copies = interval(np.repeat(per_object, 20), np.repeat(np.arange(30), 20))
    assert copies.high - copies.low == pytest.approx(once.high - once.low, rel=1e-9)
    as_samples = interval(np.repeat(per_object, 20), np.arange(600))
    assert as_samples.high - as_samples.low < 0.4 * (once.high - once.low)


def test_the_interval_is_the_textbook_one():
    generator = np.random.default_rng(1)
    values = generator.normal(loc=2, size=400)
    found = interval(values, np.arange(400), resamples=20000)
    low, high = stats.norm.interval(0.95, values.mean(), values.std(ddof=1) / 20)
    np.testing.assert_allclose([found.low, found.high], [low, high], atol=0.01)
    again = interval(values, np.arange(400), resamples=20000)
    assert again == found  # a fixed seed
    other = resampled_means(values, np.arange(400), seed=1)
    assert not np.array_equal(other, resampled_means(values, np.arange(400), seed=2))


def test_an_instance_without_a_value_leaves_the_rest():
    values = np.array([1.0, np.nan])
    found = interval(values, np.array([0, 1]))
    assert (found.mean, found.low, found.high) == (1, 1, 1)


def test_spread_over_seeds():
    found = spread([1.0, 2.0, float("nan"), 4.0])
    assert found.mean == pytest.approx(7 / 3)
    assert found.deviation == pytest.approx(np.std([1, 2, 4], ddof=1))
    assert found.seeds == 3
    assert np.isnan(spread([5.0]).deviation)
    assert np.isnan(spread([]).mean)


def test_a_difference_is_found_and_none_is_not():
    generator = np.random.default_rng(2)
    instance = np.repeat(np.arange(40), 5)
    hard = np.repeat(generator.normal(size=40), 5)
    first = hard + generator.normal(scale=0.2, size=200)
    better = first - 0.3 + generator.normal(scale=0.1, size=200)
    same = hard + generator.normal(scale=0.2, size=200)
    found = paired(first, better, instance)
    assert found.difference == pytest.approx(-0.3, abs=0.05)
    assert found.low < found.difference < found.high < 0
    assert found.p_value < 0.002
    assert paired(first, same, instance).p_value > 0.05
    assert paired(first, first, instance).p_value == 1
    half = np.where(np.arange(200) < 100, np.nan, better)
    assert paired(first, half, instance).samples == 100
    assert np.isnan(paired(first, half * np.nan, instance).p_value)


def test_p_values_are_uniform_without_a_difference():
    generator = np.random.default_rng(3)
    values = [paired(generator.normal(size=30), generator.normal(size=30), np.arange(30),
                     resamples=400).p_value for _ in range(200)]  # fmt: skip
    assert stats.kstest(values, "uniform").pvalue > 0.01
