# SPDX-License-Identifier: MIT
"""Test predictions from the best to the worst, at even steps of their rank."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bench.answered import Answered
from bench.pictures import predictions_picture
from bench.scores import Errors

SHARES = {
    ("iou", "1"): 0.15,
    ("joint_direction", "deg"): 4.0,
    ("joint_pivot", "r4"): 0.08,
    ("part_rotation", "deg"): 6.0,
    ("part_translation", "r4"): 0.09,
}
"""The error that counts as 1 in the badness of a prediction; that of `iou` is 1 - IoU."""
SHOWN = 10


def badness(errors: Errors) -> Float[np.ndarray, " S"]:
    """Mean over the five metrics of the sample's mean error by `SHARES`; inf without an answer.

    An error counts at most ten times its share: a wrong pose is wrong, whether by 90 or by 180
    degrees, and leaves the other four their say.
    """
    rows = []
    for key, share in SHARES.items():
        if key not in errors:
            continue
        error = 1 - errors[key] if key[0] == "iou" else errors[key]
        known = np.isfinite(error)
        count = known.sum(1)
        mean = np.where(known, error, 0).sum(1) / np.maximum(count, 1)
        rows.append(np.where(count > 0, np.minimum(mean / share, 10.0), np.nan))
    table = np.stack(rows)
    known = np.isfinite(table)
    total = np.where(known, table, 0).sum(0)
    return np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.inf)


def ranked(value: Float[np.ndarray, " S"], count: int = SHOWN) -> Int[np.ndarray, " K"]:
    """Samples at `count` even steps of the rank, best and worst among them."""
    order = np.argsort(value, kind="stable")
    order = order[np.isfinite(value[order])]
    place = np.linspace(0, len(order) - 1, min(count, len(order)))
    return order[np.round(place).astype(int)]


def ranking_picture(answered: Answered, predictions: Path, out: Path) -> None:
    """Ten predictions, each with its rank and its errors above it."""
    value = badness(answered.errors)
    samples = ranked(value)
    place = np.argsort(np.argsort(value, kind="stable"), kind="stable")
    last = int(np.isfinite(value).sum()) - 1
    titles = [
        _title(answered.errors, i, float(100 * place[i] / max(last, 1))) for i in samples.tolist()
    ]
    header = answered.header
    words = f"{header.method} {header.variant}".strip()
    predictions_picture(
        answered.split, predictions, out, samples.tolist(), titles=titles,
        heading=f"{words}, {header.category}: {len(samples)} of {last + 1} predictions, best to "
        "worst",
    )  # fmt: skip


def _title(errors: Errors, sample: int, rank: float) -> str:
    def mean(*key: str) -> float:
        values = errors[key[0], key[1]][sample]
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) else float("nan")

    name = "best" if rank == 0 else "worst" if rank == 100 else f"{rank:.0f} %"
    first = f"S {100 * mean('iou', '1'):.0f}  D {mean('joint_direction', 'deg'):.1f}°"
    second = f"C {mean('joint_pivot', 'r4'):.2f}  R {mean('part_rotation', 'deg'):.1f}°"
    return f"{name}\n{first}\n{second}".replace("nan°", "–").replace("nan", "–")
