# SPDX-License-Identifier: MIT
"""Does a prediction move with its cloud, and does it stay when the points are drawn again?

Equivariance: each cloud is moved by random rigid motions, the prediction is moved back and
compared with the prediction for the cloud as it was; `none` repeats the same cloud and shows the
rounding. Resampling: each cloud is thinned to random subsets of its points; the scatter of the
answers is that of the method alone, since the view stays. No truth is used.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from bench.changes import changes, moved
from bench.scatter import scatter
from bench.scores import Errors, Rows
from bench.statistics import BOOTSTRAP_SEED, bounds
from scapo.augment import random_pose

MotionKind = Literal["none", "rotation", "translation", "both"]
MOTIONS: tuple[MotionKind, ...] = ("none", "rotation", "translation", "both")
SHIFT = 1.0
"""Half side of the cube of the random translations, metres."""
BOOTSTRAPS = 500
POINTED = ("camera_T_part", "joint_pivot", "joint_axis")
"""What resampling compares: one answer per cloud, whatever its points."""

Answer = Callable[[Float[np.ndarray, "B N 3"], Float[np.ndarray, "B 3"]], Rows]
"""Clouds in metres and the centres of their cameras -> the tensors of a predictions file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How much is measured."""

    motions: int = 2
    """Random motions of each kind for each cloud."""
    resamplings: int = 20
    """Random subsets of each cloud."""
    points: int = 512
    """Of each subset."""
    seed: int = 0
    """Of motions and subsets."""
    batch: int = 32
    """Clouds at a time."""


def equivariance(
    answer: Answer, points: Float[np.ndarray, "S N 3"], revolute: np.ndarray, plan: Plan
) -> dict[MotionKind, Errors]:
    """Changes by kind of motion: (quantity, unit) -> (S, motions * K)."""
    still = in_batches(answer, points, np.zeros((len(points), 3), np.float32), plan.batch)
    generator = torch.Generator().manual_seed(plan.seed)
    out: dict[MotionKind, Errors] = {}
    for kind in MOTIONS:
        found: list[Errors] = []
        for _ in range(1 if kind == "none" else plan.motions):
            motion = random_motions(len(points), kind, generator)
            there = points.astype(np.float64) @ np.swapaxes(motion[:, :3, :3], 1, 2)
            there = (there + motion[:, None, :3, 3]).astype(np.float32)
            sensor = motion[:, :3, 3].astype(np.float32)  # the camera moves with what it saw
            back = moved(in_batches(answer, there, sensor, plan.batch), np.linalg.inv(motion))
            found.append(changes(still, back, points, revolute))
        out[kind] = {key: np.concatenate([item[key] for item in found], 1) for key in found[0]}
    return out


def random_motions(
    count: int, kind: MotionKind, generator: torch.Generator
) -> Float[np.ndarray, "B 4 4"]:
    """Rotations uniform on SO(3) about the camera, translations uniform in a cube."""
    like = torch.zeros(0, dtype=torch.float64)
    motion = random_pose(count, SHIFT, generator, like).numpy()
    if kind in ("none", "translation"):
        motion[:, :3, :3] = np.eye(3)
    if kind in ("none", "rotation"):
        motion[:, :3, 3] = 0
    return motion


def resampled(
    answer: Answer, points: Float[np.ndarray, "S N 3"], plan: Plan
) -> dict[tuple[str, str, str], np.ndarray]:
    """Scatter over random subsets of each cloud, drawn without replacement.

    Raises:
        ValueError: The clouds have no more points than a subset.
    """
    count, total, _ = points.shape
    if not 0 < plan.points < total:
        raise ValueError(
            f"resampling: expected 1 to {total - 1} of the clouds' {total} points, "
            f"found {plan.points}"
        )
    generator = np.random.default_rng(plan.seed)
    answers: list[Rows] = []
    for _ in range(plan.resamplings):
        chosen = generator.permuted(np.tile(np.arange(total), (count, 1)), axis=1)
        subset = np.take_along_axis(points, chosen[:, : plan.points, None], 1)
        rows = in_batches(answer, subset, np.zeros((count, 3), np.float32), plan.batch)
        answers.append({name: rows[name] for name in POINTED if name in rows})
    return scatter(answers, points)


def in_batches(
    answer: Answer, points: Float[np.ndarray, "S N 3"], sensor: Float[np.ndarray, "S 3"], batch: int
) -> Rows:
    """The answers for all clouds."""
    starts = range(0, len(points), batch)
    pieces = [answer(points[k : k + batch], sensor[k : k + batch]) for k in starts]
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


class Timed:
    """An answer that counts clouds and seconds."""

    def __init__(self, answer: Answer) -> None:
        self.answer, self.clouds, self.seconds = answer, 0, 0.0

    def __call__(
        self, points: Float[np.ndarray, "B N 3"], sensor: Float[np.ndarray, "B 3"]
    ) -> Rows:
        """Answer, and count."""
        started = time.perf_counter()
        rows = self.answer(points, sensor)
        self.seconds += time.perf_counter() - started
        self.clouds += len(points)
        return rows


def summary(values: np.ndarray, instance: Int[np.ndarray, " S"]) -> dict[str, Any]:
    """Mean, median, 95th percentile with 95 % intervals (resampled by instance), and maximum.

    Args:
        values: (S, K), NaN where there was no answer.
        instance: The object of each sample.
    """
    known = values[~np.isnan(values)]
    out: dict[str, Any] = {"count": int(known.size), "undefined": int(values.size - known.size)}
    if known.size == 0:
        return out
    out["max"] = float(known.max())
    draws = np.array(list(_draws(values, instance)))
    for column, (name, value) in enumerate(_numbers(known).items()):
        low, high = bounds(draws[:, column])
        out[name] = {"value": value, "low": low, "high": high}
    return out


def _numbers(known: Float[np.ndarray, " K"]) -> dict[str, float]:
    median, high = np.quantile(known, [0.5, 0.95])
    return {"mean": float(known.mean()), "median": float(median), "p95": float(high)}


def _draws(values: np.ndarray, instance: Int[np.ndarray, " S"]) -> Iterator[list[float]]:
    """The numbers of each bootstrap draw that holds a value."""
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    objects = [values[instance == number] for number in np.unique(instance)]
    for _ in range(BOOTSTRAPS):
        chosen = generator.integers(len(objects), size=len(objects))
        drawn = np.concatenate([objects[number] for number in chosen])
        known = drawn[~np.isnan(drawn)]
        if known.size:
            yield list(_numbers(known).values())
