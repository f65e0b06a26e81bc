# SPDX-License-Identifier: MIT
"""Does a prediction move with its cloud, and does it stay when the points are drawn again?

Equivariance: each cloud is moved by random rigid motions, the prediction is moved back and
compared with the prediction for the cloud as it was; `none` repeats the same cloud and shows the
rounding. Resampling: each cloud is thinned to random subsets of its points; the scatter of the
answers is that of the method alone, since the view stays. No truth enters.

Numpy, camera frame, metres; answers are the tensors of a predictions file. The place of a joint
axis is its point nearest to the cloud's centroid: where along the axis a method puts its pivot
says nothing of the joint.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from bench.matching import project_rotations, rotation_degrees
from bench.metrics import line_degrees, unit
from bench.scoring.scores import Errors, Rows, label_of
from bench.statistics import BOOTSTRAP_SEED, bounds
from scapo.geometry.part_order import hard_labels
from scapo.paper.augment import random_pose

Answer = Callable[[Float[np.ndarray, "B N 3"], Float[np.ndarray, "B 3"]], Rows]
"""Clouds in metres and the centres of their cameras -> the tensors of a predictions file."""


MotionKind = Literal["none", "rotation", "translation", "both"]


MOTIONS: tuple[MotionKind, ...] = ("none", "rotation", "translation", "both")


SHIFT = 1.0
"""Half side of the cube of the random translations, metres."""


POINTED = ("camera_T_part", "joint_pivot", "joint_axis")
"""What resampling compares: one answer per cloud, whatever its points."""


BOOTSTRAPS = 500
NUMBERS = ("mean", "median", "p95")


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


def in_batches(
    answer: Answer, points: Float[np.ndarray, "S N 3"], sensor: Float[np.ndarray, "S 3"], batch: int
) -> Rows:
    """The answers for all clouds."""
    starts = range(0, len(points), batch)
    pieces = [answer(points[k : k + batch], sensor[k : k + batch]) for k in starts]
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def moved(rows: Rows, motion: Float[np.ndarray, "B 4 4"]) -> Rows:
    """The answers as they are after the camera frame's points x became motion x."""
    turn, shift = motion[:, None, :3, :3], motion[:, None, :3, 3]
    out = dict(rows)
    if "camera_T_part" in rows:
        out["camera_T_part"] = motion[:, None] @ rows["camera_T_part"]
    if "joint_pivot" in rows:
        out["joint_pivot"] = (turn @ rows["joint_pivot"][..., None])[..., 0] + shift
    if "joint_axis" in rows:
        out["joint_axis"] = (turn @ rows["joint_axis"][..., None])[..., 0]
    return out


def changes(
    first: Rows, second: Rows, points: Float[np.ndarray, "B N 3"], revolute: np.ndarray
) -> Errors:
    """Differences of two answers for the same clouds, per sample and slot.

    Args:
        first: Answers.
        second: Others, in the same frame.
        points: The clouds, for the unit `r4` and the place of the axes.
        revolute: (J,) bool.

    Returns:
        `base_rotation`, `part_rotation` (moving parts), `part_translation`, `axis` (of lines,
        at most 90 degrees), `pivot` (place of the axis), `state` and `labels` (share of the
        points); only what both answers hold.
    """
    centre, length = centroid_and_unit(points)
    label, there = hard_labels(label_of(first)), hard_labels(label_of(second))
    out: Errors = {("labels", "1"): (label != there).mean(1, keepdims=True)}
    if "camera_T_part" in first and "camera_T_part" in second:
        pose, there = (r["camera_T_part"].astype(np.float64) for r in (first, second))
        turn = rotation_degrees(pose[..., :3, :3], there[..., :3, :3])
        away = np.linalg.norm(pose[..., :3, 3] - there[..., :3, 3], axis=-1)
        out["base_rotation", "deg"], out["part_rotation", "deg"] = turn[:, :1], turn[:, 1:]
        out["part_translation", "r4"] = away / length[:, None]
    if all("joint_axis" in r and "joint_pivot" in r for r in (first, second)):
        axis, other = (unit(r["joint_axis"].astype(np.float64)) for r in (first, second))
        out["axis", "deg"] = line_degrees(axis, other)
        apart = axis_places(first, centre) - axis_places(second, centre)
        distance = np.linalg.norm(apart, axis=-1)
        out["pivot", "m"], out["pivot", "r4"] = distance, distance / length[:, None]
        if "joint_state" in first and "joint_state" in second:
            out |= _states(first, second, revolute, length)
    return out


def _states(
    first: Rows, second: Rows, revolute: np.ndarray, length: Float[np.ndarray, " B"]
) -> Errors:
    """An axis that points the other way turns the other way."""
    sign = np.where((first["joint_axis"] * second["joint_axis"]).sum(-1) < 0, -1.0, 1.0)
    change = first["joint_state"] - sign * second["joint_state"]
    around = np.degrees(np.abs((change + np.pi) % (2 * np.pi) - np.pi))
    out: Errors = {}
    if revolute.any():
        out["state", "deg"] = np.where(revolute, around, np.nan)
    if not revolute.all():
        out["state", "r4"] = np.where(revolute, np.nan, np.abs(change)) / length[:, None]
    return out


def axis_places(rows: Rows, centre: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B J 3"]:
    """The point of each joint axis nearest to `centre`."""
    pivot, axis = (
        rows["joint_pivot"].astype(np.float64),
        unit(rows["joint_axis"].astype(np.float64)),
    )
    return pivot + axis * ((centre[:, None] - pivot) * axis).sum(-1, keepdims=True)


def centroid_and_unit(
    points: Float[np.ndarray, "B N 3"],
) -> tuple[Float[np.ndarray, "B 3"], Float[np.ndarray, " B"]]:
    """Centroid of each cloud and the length of one `r4`, 4 x its mean radius."""
    wide = points.astype(np.float64)
    centre = wide.mean(1)
    return centre, 4 * np.linalg.norm(wide - centre[:, None], axis=-1).mean(1)


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


Scatter = dict[tuple[str, str, str], np.ndarray]
"""(quantity, unit, `std` or `mad`) -> (B, K); NaN where an answer is missing."""


Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]


def scatter(answers: Sequence[Rows], points: Float[np.ndarray, "B N 3"]) -> Scatter:
    """Spread of R answers for the same clouds.

    Two statistics of the deviations, which are angles or distances: `std`, their root mean square
    about the mean (with R - 1), and `mad`, their median about the geometric median. Both are those
    of a vector, not of one coordinate: for a normal distribution with deviation s in each of two
    directions, std is 1.41 s and mad 1.18 s.

    Args:
        answers: `camera_T_part`, `joint_pivot` and `joint_axis` where a method has them, all in
            one frame.
        points: The clouds, for the unit `r4` and the place of the axes.

    Returns:
        `base_rotation`, `axis` (of lines) and `pivot` (place of the axis).
    """
    centre, length = centroid_and_unit(points)
    out: Scatter = {}
    if all("camera_T_part" in rows for rows in answers):
        turns = np.stack([rows["camera_T_part"][:, :1, :3, :3] for rows in answers])
        out |= _named("base_rotation", "deg", _spread(turns, project_rotations, rotation_degrees))
    if all("joint_axis" in rows and "joint_pivot" in rows for rows in answers):
        axes = same_signs(np.stack([rows["joint_axis"] for rows in answers]))
        out |= _named("axis", "deg", _spread(axes, unit, line_degrees))
        places = np.stack([axis_places(rows, centre) for rows in answers])
        found = _spread(places, np.asarray, _distance)
        out |= _named("pivot", "m", found)
        out |= _named("pivot", "r4", {key: item / length[:, None] for key, item in found.items()})
    return out


def same_signs(axes: Float[np.ndarray, "R *B 3"]) -> Float[np.ndarray, "R *B 3"]:
    """Unit axes, each turned to the side of their common principal direction."""
    axes = unit(axes.astype(np.float64))
    moment = np.nan_to_num(np.einsum("r...i,r...j->...ij", axes, axes))
    principal = np.linalg.eigh(moment)[1][..., -1]
    return axes * np.where((axes * principal).sum(-1, keepdims=True) < 0, -1.0, 1.0)


def geometric_median(values: Float[np.ndarray, "R *B D"]) -> Float[np.ndarray, "*B D"]:
    """The point with the smallest sum of distances to R points (Weiszfeld's iteration)."""
    centre = np.median(values, 0)
    for _ in range(100):
        distance = np.linalg.norm(values - centre, axis=-1, keepdims=True)
        weight = 1 / np.maximum(distance, 1e-12)
        centre = (weight * values).sum(0) / weight.sum(0)
    return centre


def _spread(
    values: np.ndarray, project: Callable[[np.ndarray], np.ndarray], distance: Distance
) -> dict[str, np.ndarray]:
    """Both statistics of R values (R, B, K, ...); `project` brings a centre back to its space."""
    values = values.astype(np.float64)
    count, shape = len(values), values.shape[1:]
    flat = values.reshape(count, *shape[:2], -1)
    median = project(geometric_median(flat).reshape(shape))
    about_mean = distance(values, np.broadcast_to(project(values.mean(0)), values.shape))
    about_median = distance(values, np.broadcast_to(median, values.shape))
    return {
        "std": np.sqrt(np.square(about_mean).sum(0) / max(1, count - 1)),
        "mad": np.median(about_median, 0),
    }


def _named(name: str, label: str, found: dict[str, np.ndarray]) -> Scatter:
    return {(name, label, statistic): value for statistic, value in found.items()}


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)


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
    draws = _numbers(_resampled(values, instance))
    for name, value, drawn in zip(NUMBERS, _numbers(known[None])[0], draws.T, strict=True):
        low, high = bounds(drawn)
        out[name] = {"value": float(value), "low": low, "high": high}
    return out


def _numbers(values: Float[np.ndarray, "D K"]) -> Float[np.ndarray, "E 3"]:
    """`NUMBERS` of each row that holds a value, NaN left out."""
    values = np.sort(values, axis=1)  # NaN last
    counts = np.count_nonzero(~np.isnan(values), axis=1)
    values, counts = values[counts > 0], counts[counts > 0]
    columns = [np.nansum(values, axis=1) / counts]
    for quantile in (0.5, 0.95):
        place = quantile * (counts - 1)
        below = np.floor(place).astype(np.int64)
        low, high = (
            np.take_along_axis(values, at[:, None], axis=1)[:, 0]
            for at in (below, np.minimum(below + 1, counts - 1))
        )
        columns.append(low + (high - low) * (place - below))
    return np.stack(columns, axis=1)


def _resampled(values: np.ndarray, instance: Int[np.ndarray, " S"]) -> Float[np.ndarray, "D K"]:
    """The values of each bootstrap draw of whole objects, filled up with NaN."""
    objects = [values[instance == number].ravel() for number in np.unique(instance)]
    table = np.full((len(objects), max(map(len, objects))), np.nan)
    for row, known in zip(table, objects, strict=True):
        row[: len(known)] = known
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    chosen = generator.integers(len(objects), size=(BOOTSTRAPS, len(objects)))
    return table[chosen].reshape(BOOTSTRAPS, -1)
