# SPDX-License-Identifier: MIT
"""Summaries of a category: means with intervals, and average precision as counts of n."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bench.metrics import ApRule, precision_passes
from bench.scoring.scores import Errors
from bench.statistics import BOOTSTRAP_SEED, RESAMPLES, interval

PRECISION_INPUTS = (
    ("iou", "1"),
    ("part_rotation", "deg"),
    ("part_translation", "m"),
    ("joint_direction", "deg"),
    ("joint_pivot", "m"),
)


def passes(errors: Errors, rule: ApRule) -> dict[str, np.ndarray]:
    """What the average precision counts; empty where one of its inputs is not there.

    Without that of parts or of joints where no sample has any value of them: who gives no poses
    has no precision of poses, rather than one of 0.
    """
    if any(key not in errors for key in PRECISION_INPUTS):
        return {}
    inputs = {name: errors[name, unit] for name, unit in PRECISION_INPUTS}
    silent = {name.partition("_")[0] for name, values in inputs.items() if np.isnan(values).all()}
    passed = precision_passes(**inputs, rule=rule)
    return {key: value for key, value in passed.items() if key.partition("_")[0] not in silent}


def swapped(order: Float[np.ndarray, "B P"]) -> Float[np.ndarray, "B 1"]:
    """1 where the parts were taken in another order than the true one, NaN without an answer."""
    moved = (order != np.arange(order.shape[1])).any(1, keepdims=True).astype(np.float64)
    return np.where(np.isnan(order).any(1, keepdims=True), np.nan, moved)


def by_trait(
    errors: Errors, instance: Int[np.ndarray, " B"], trait: Sequence[str], rule: ApRule
) -> dict[str, Any]:
    """`summarise` of the samples of each trait apart; nothing where no object has any.

    Args:
        errors: Of all samples.
        instance: Which object each sample shows.
        trait: Of each object.
        rule: Of the average precision.
    """
    own = np.array([trait[i] for i in instance], dtype=object)
    out = {}
    for name in sorted(set(own.tolist()) - {""}):
        members = own == name
        few = {key: values[members] for key, values in errors.items()}
        out[name] = {
            "samples": int(members.sum()),
            "instances": len(np.unique(instance[members])),
            **summarise(few, instance[members], rule),
        }
        del out[name]["bootstrap"]
    return out


def summarise(errors: Errors, instance: Int[np.ndarray, " B"], rule: ApRule) -> dict[str, Any]:
    """`summary` per metric and unit, `average_precision` with k and n, and how they were made.

    Of the order of the parts the summary has the share of samples in which they were swapped.
    """
    shown = {f"{name}_{unit}": values for (name, unit), values in errors.items() if name != "order"}
    if ("order", "1") in errors:
        shown["swapped_1"] = swapped(errors["order", "1"])
    summary = {name: interval(values, instance).record() for name, values in shown.items()}
    precision = {}
    for name, passed in passes(errors, rule).items():
        bounds = interval(passed.astype(np.float64), instance)
        precision[name] = {
            "k": int(passed.sum()),
            "n": int(passed.size),
            **{k: bounds.record()[k] for k in ("low", "high")},
        }
    return {
        "summary": summary,
        "average_precision": {"rule": rule, **precision},
        "bootstrap": {"resamples": RESAMPLES, "seed": BOOTSTRAP_SEED, "unit": "instance"},
    }
