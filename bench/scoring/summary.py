# SPDX-License-Identifier: MIT
"""Summaries of a category: means with intervals, and average precision as counts of n."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Int

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
    """What the average precision counts; empty where one of its inputs is not there."""
    if any(key not in errors for key in PRECISION_INPUTS):
        return {}
    return precision_passes(
        **{name: errors[name, unit] for name, unit in PRECISION_INPUTS}, rule=rule
    )


def summarise(errors: Errors, instance: Int[np.ndarray, " B"], rule: ApRule) -> dict[str, Any]:
    """`summary` per metric and unit, `average_precision` with k and n, and how they were made."""
    summary = {
        f"{name}_{unit}": interval(values, instance).record()
        for (name, unit), values in errors.items()
    }
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
