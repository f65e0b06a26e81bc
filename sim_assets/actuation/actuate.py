# SPDX-License-Identifier: MIT
"""`scapo-data actuate`: every joint is pulled along the path that its prediction implies.

The object is had again from its generator or its model, set to the sample's true state and pulled
from there to the side with more travel left: opened, or closed where it is more than half open. A
success has moved at least 30 degrees or half of the travel left, of a slide half of it. A sample
without an answer is a failure; an object that cannot be had again is left out, with the reason.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from scapo.geometry.part_order import confusion, hard_labels, joint_order, order_scores, part_orders
from scapo.parallel.pool import Outcome, Report
from scapo.parallel.ray import open_pool
from scapo.store import Split, StoreError
from scapo.store.actuations import Actuation, write_actuations
from scapo.store.manifest import Manifest
from scapo.store.predictions import Predictions, find_data, read_prediction_header
from scapo.store.schema import UNLABELLED
from scapo.store.split import data_name
from scapo.text import one_line
from sim_assets.actuation.grasp import path_of
from sim_assets.generation.assets import recover
from sim_assets.generation.generate import Running

if TYPE_CHECKING:
    from sim_assets.actuation.pull import Body, Pulled

ENOUGH = math.radians(30.0)
"""Turned so far, a joint has opened; less where half of the travel left is less."""
BLOCK = 256
"""Samples whose predictions are read at once."""
TRUTH = ("part", "camera_T_part", "joint_state", "instance")
NO_ANSWER, TOO_LITTLE = "no answer", "moved too little"
SLIPPED = "the hand slipped off"
LONGEST_REASON = 300

Joint3 = Float[np.ndarray, "B J 3"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """The samples of one object; predictions in the object frame, NaN where there is none."""

    manifest: Manifest
    instance: int
    source: Path | None
    sample: Int[np.ndarray, " B"]
    state: Float[np.ndarray, "B J"]
    pivot: Joint3
    axis: Joint3
    names: Mapping[str, Any] = field(default_factory=dict)
    """The columns that all rows share."""


def actuate(
    predictions: Path,
    data: Path,
    out: Path,
    *,
    source: Path | None = None,
    limit: int | None = None,
    running: Running | None = None,
) -> list[Actuation]:
    """Pull at every joint, and write what came of it.

    Args:
        predictions: A predictions file, of any program.
        data: The data set that they are of.
        out: CSV file (docs/actuate.md).
        source: Folder of the models, for data made from some.
        limit: Only the first so many samples.
        running: How.

    Returns:
        The rows, by sample and joint.

    Raises:
        StoreError: Files that are not what they should be; a method that predicts no joints.
        ValueError: `limit` or `out` that make no sense, or SAPIEN is not installed.
    """
    if limit is not None and limit < 1:
        raise ValueError(f"limit: expected 1 or more, found {limit}")
    if out.suffix != ".csv":
        raise ValueError(f"out: expected a file FILE.csv, found {out}")
    if find_spec("sapien") is None:
        raise ValueError("actuate: expected SAPIEN, found none (pip install 'scapo[sim]')")
    running = running or Running()
    split = find_data(data, read_prediction_header(predictions))
    jobs = make_jobs(predictions, split, data, source, limit)
    total, rows = sum(len(job.sample) for job in jobs), []
    done = 0
    running.progress("samples", done, total)
    with open_pool("local", running.workers, timeout=running.timeout) as pool:
        for outcome in pool.run(pull_all, jobs):
            rows += _rows(outcome)
            done += len(outcome.job.sample)
            running.progress("samples", done, total)
    rows.sort(key=lambda row: (row.sample, row.joint))
    write_actuations(out, rows)
    return rows


def make_jobs(
    predictions: Path, split: Split, data: Path, source: Path | None, limit: int | None
) -> list[Job]:
    """One job for each object of the first `limit` samples."""
    truth = split.arrays(*TRUTH)
    count = min(limit or split.manifest.count, split.manifest.count)
    truth = {name: array[:count] for name, array in truth.items()}
    with Predictions(predictions, split) as opened:
        pivot, axis = _in_object(opened, split, truth)
        header = opened.header
    names = {
        "method": header.method,
        "variant": header.variant,
        "seed": header.seed,
        "supervision": " ".join(header.supervision),
        "data": data_name(data, split),
        "category": header.category,
        "split": header.split,
    }
    jobs = []
    for instance in np.unique(truth["instance"]):
        chosen = np.flatnonzero(truth["instance"] == instance)
        jobs.append(
            Job(
                manifest=split.manifest,
                instance=int(instance),
                source=source,
                sample=chosen,
                state=truth["joint_state"][chosen].astype(np.float64),
                pivot=pivot[chosen],
                axis=axis[chosen],
                names=names,
            )
        )
    return jobs


def _in_object(
    opened: Predictions, split: Split, truth: Mapping[str, np.ndarray]
) -> tuple[Joint3, Joint3]:
    """Predicted pivots and axes by true joint, in the object frame."""
    slides = all(joint.kind == "prismatic" for joint in split.manifest.joints)
    needed = ("joint_axis",) if slides else ("joint_axis", "joint_pivot")
    for name in needed:
        if name not in opened.names:
            raise StoreError(
                f"{opened.path}: expected tensor {name!r}, found none: only predicted joints can "
                "be pulled at"
            )
    pivots, axes = [], []
    for first in range(0, len(truth["instance"]), BLOCK):
        block = slice(first, first + BLOCK)
        part = truth["part"][block].astype(np.int64)
        part[part == UNLABELLED] = -1
        rows = opened.rows(first, len(part))
        slot = _slots(part, rows, len(split.manifest.parts))
        pose = truth["camera_T_part"][block, 0].astype(np.float64)
        axis = _taken(rows["joint_axis"], slot)
        pivot = _taken(rows.get("joint_pivot", np.zeros_like(axis)), slot)
        axes.append(axis @ pose[:, :3, :3])
        pivots.append((pivot - pose[:, None, :3, 3]) @ pose[:, :3, :3])
    return np.concatenate(pivots), np.concatenate(axes)


def _slots(
    part: Int[np.ndarray, "B N"], rows: Mapping[str, np.ndarray], parts: int
) -> Int[np.ndarray, "B J"]:
    """The predicted joint of each true one, -1 where none links its parts: as the labels say."""
    label = hard_labels(rows["part"] if "part" in rows else rows["part_weight"])
    orders = part_orders(parts)
    order = orders[order_scores(confusion(part, label, parts), orders).argmax(1)]
    true_of_slot = joint_order(order)
    fits = true_of_slot[:, None, :] == np.arange(parts - 1)[None, :, None]
    return np.where(fits.any(2), fits.argmax(2), -1)


def _taken(values: np.ndarray, slot: Int[np.ndarray, "B J"]) -> Joint3:
    found = np.take_along_axis(values, np.maximum(slot, 0)[..., None], 1).astype(np.float64)
    return np.where(slot[..., None] >= 0, found, np.nan)


def pull_all(job: Job, report: Report) -> list[Actuation]:
    """The rows of one object's samples.

    Raises:
        RecoverError: The object cannot be had again.
    """
    from sim_assets.actuation.pull import body_of

    name = job.manifest.instances[job.instance].id
    report(name, 0)
    thing = recover(job.manifest, job.instance, job.source)
    bodies = [body_of(thing, j) for j in range(len(job.manifest.joints))]
    rows = []
    for i in range(len(job.sample)):
        report(name, 0)
        rows += [_tried(job, i, j, body) for j, body in enumerate(bodies)]
    return rows


def _tried(job: Job, i: int, j: int, body: Body) -> Actuation:
    """One joint of one sample, pulled."""
    from sim_assets.actuation.pull import pull

    state = min(max(float(job.state[i, j]) / body.unit, 0.0), body.upper)
    opening = body.upper - state >= state
    left = body.upper - state if opening else state
    needed = left / 2 if body.kind == "prismatic" else min(ENOUGH, left / 2)
    pivot, axis = job.pivot[i, j] / body.size, job.axis[i, j]
    lengths = (left, needed)
    if not (np.isfinite(axis).all() and axis.any() and np.isfinite(pivot).all()):
        return _row(job, i, j, success=False, reason=NO_ANSWER, **_told(body, opening, lengths))
    own = body.path()
    forward = own.tangent(state) if opening else -own.tangent(state)
    wanted = path_of(body.kind, pivot, axis, own.at(state)).towards(forward)
    done = pull(body, state, wanted, left, opening)
    success = done.moved >= needed
    reason = "" if success else SLIPPED if done.slipped else TOO_LITTLE
    told = _told(body, opening, lengths, done)
    return _row(job, i, j, success=success, reason=reason, **told)


def _told(
    body: Body, opening: bool, lengths: tuple[float, float], done: Pulled | None = None
) -> dict[str, Any]:
    """What a row says of a pull, in degrees or metres and the newtons of the object's own size."""
    unit = math.degrees(1.0) if body.kind == "revolute" else body.size
    return {
        "towards": "open" if opening else "closed",
        "travel": lengths[0] * unit,
        "needed": lengths[1] * unit,
        "moved": None if done is None else done.moved * unit,
        "off_path_mean": None if done is None else done.mean * body.size,
        "off_path_peak": None if done is None else done.peak * body.size,
    }


def _row(
    job: Job, i: int, j: int, *, success: bool | None, reason: str, **told: float | str | None
) -> Actuation:
    nothing = dict.fromkeys(("moved", "needed", "travel", "off_path_mean", "off_path_peak"), None)
    turning = job.manifest.joints[j].kind == "revolute"
    values: dict[str, Any] = {"towards": "", **nothing, **told}
    return Actuation(
        **job.names,
        sample=int(job.sample[i]),
        instance=job.instance,
        joint=j,
        success=success,
        unit="deg" if turning else "m",
        reason=reason,
        **values,
    )


def _rows(outcome: Outcome[Job, list[Actuation]]) -> list[Actuation]:
    """Those of a job, also of one that failed."""
    if outcome.result is not None:
        return outcome.result
    job, why = outcome.job, one_line(outcome.reason, LONGEST_REASON)
    joints = range(len(job.manifest.joints))
    return [
        _row(job, i, j, success=None, reason=why) for i in range(len(job.sample)) for j in joints
    ]


def summary(rows: Sequence[Actuation]) -> list[str]:
    """A line for each category and split: how many joints moved far enough, and the forces."""
    groups = sorted({(row.category, row.split) for row in rows})
    return [_line(name, [r for r in rows if (r.category, r.split) == name]) for name in groups]


def _line(name: tuple[str, str], rows: Sequence[Actuation]) -> str:
    tried = [row for row in rows if row.success is not None]
    good = sum(bool(row.success) for row in tried)
    share = f"{100 * good / len(tried):.1f} % " if tried else ""
    why = Counter(row.reason for row in tried if not row.success)
    parts = [f"{'/'.join(name)}: {share}({good} of {len(tried)} joints) moved as far as needed"]
    parts += [f"{count} {reason}" for reason, count in sorted(why.items())]
    parts += [f"{len(rows) - len(tried)} left out"] if len(tried) < len(rows) else []
    means = [row.off_path_mean for row in tried if row.off_path_mean is not None]
    peaks = [row.off_path_peak for row in tried if row.off_path_peak is not None]
    if means:
        parts.append(
            f"force across the path {np.median(means):.3g} N, at most {np.median(peaks):.3g} N "
            "(medians)"
        )
    return "; ".join(parts)


def left_out(rows: Sequence[Actuation]) -> dict[str, str]:
    """Object -> why its joints could not be tried."""
    return {f"object {row.instance}": row.reason for row in rows if row.success is None}
