# SPDX-License-Identifier: MIT
"""`calibrate`: what labelled clouds teach about a model's answers (`calibration`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bench.infer.alignment import Alignment, Parts, reordered
from bench.infer.answer import agreement, ask, mean_radius
from bench.infer.calibration import (
    JOINT_DEGREES,
    PART_DEGREES,
    Calibration,
    LogisticMap,
    Reliability,
    calibration_file,
    feature,
    fit_map,
    reliability,
    write_calibration,
)
from bench.infer.cloud import Cloud
from bench.infer.model import Model, load_model, weights_file
from bench.matching import calibrate as fit_frames
from bench.matching import choose_order, rotation_degrees
from bench.metrics import line_degrees
from bench.requests import CalibrateRequest
from bench.runs.train import pick_device
from bench.twin.record import BACKGROUND, Twin
from scapo.categories import Category
from scapo.geometry.part_order import confusion
from scapo.method import evenly
from scapo.predictor import find
from scapo.store import Split, StoreError, open_split
from scapo.store.files import require_suffix

FOLDS = 5
"""Of the objects: probabilities that `reliability` judges come from maps fitted without them."""
LEAST_SAMPLES = 20
"""That a calibration is fitted to."""

Watch = Callable[[Sequence[int]], Iterable[int]]
"""Passes samples on."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labelled:
    """Clouds with the truth."""

    points: Float[np.ndarray, "S N 3"]
    part: Int[np.ndarray, "S N"]
    """-1: background."""
    camera_T_part: Float[np.ndarray, "S P 4 4"]
    axis: Float[np.ndarray, "S J 3"]
    state: Float[np.ndarray, "S J"]
    instance: Int[np.ndarray, " S"]


def calibrate(request: CalibrateRequest, watch: Watch = iter) -> tuple[Calibration, list[Path]]:
    """Ask the model about labelled clouds and write what that teaches beside its checkpoint.

    Args:
        request: Model, data and mode.
        watch: Passes the samples on, and may show how far it is.

    Returns:
        The calibration, and the files written.

    Raises:
        StoreError: No such model or data, too few samples, or a picture that is no PNG.
    """
    if request.picture is not None:
        require_suffix(request.picture, ".png")
    file = weights_file(find(request.checkpoint))
    model = load_model(file, pick_device(request.device), None)
    split = open_split(request.data, model.category.name, request.split)
    labelled = _labelled(split, request.limit)
    clouds = [Cloud(points=points) for points in labelled.points]
    plain = [ask("", cloud, model, request.mode) for cloud in clouds]
    found = Calibration(
        model=model.digest,
        mode=request.mode,
        category=model.category.name,
        split=request.split,
        data=split.manifest.digest,
        samples=len(clouds),
        alignment=fit_alignment(plain, labelled, model.category),
        joint=(),
        part=(),
        reliability={},
    )
    told = replace(model, calibration=found)
    twins = [_whole(clouds[i], told, request) for i in watch(range(len(clouds)))]
    joint, part = right_answers(twins, labelled)
    judged = {"joint": _fitted(twins, "joint", joint, labelled.instance),
              "part": _fitted(twins, "part", part, labelled.instance)}  # fmt: skip
    found = replace(
        found,
        joint=judged["joint"][0],
        part=judged["part"][0],
        reliability={kind: one[1] for kind, one in judged.items()},
    )
    written = [calibration_file(file, request.mode)]
    write_calibration(written[0], found)
    if request.picture is not None:
        from bench.infer.diagram import reliability_picture

        reliability_picture(found.reliability, request.picture, f"{model.name}, {request.mode}")
        written.append(request.picture)
    return found, written


def _whole(cloud: Cloud, model: Model, request: CalibrateRequest) -> Twin:
    return agreement(cloud, ask("", cloud, model, request.mode), model, request.mode)


def _labelled(split: Split, limit: int | None) -> Labelled:
    """Samples evenly spread over a split.

    Raises:
        StoreError: Too few.
    """
    names = ("points", "part", "camera_T_part", "joint_axis", "joint_state", "instance")
    arrays = split.arrays(*names)
    total = len(arrays["part"])
    index = evenly(total, limit).numpy()
    if len(index) < LEAST_SAMPLES:
        raise StoreError(
            f"{split.folder}: expected at least {LEAST_SAMPLES} samples, found {len(index)}"
        )
    some: dict[str, Any] = {name: array[index] for name, array in arrays.items()}
    part = some["part"].astype(int)
    return Labelled(
        points=some["points"],
        part=np.where(part == BACKGROUND, -1, part),
        camera_T_part=some["camera_T_part"].astype(np.float64),
        axis=some["joint_axis"].astype(np.float64),
        state=some["joint_state"].astype(np.float64),
        instance=some["instance"].astype(int),
    )


def fit_alignment(twins: Sequence[Twin], labelled: Labelled, category: Category) -> Alignment:
    """One order of parts, offset of the base, sense and zero of each joint for all samples.

    Args:
        twins: Answers by the method's own conventions.
        labelled: The truth of the same clouds.
        category: Theirs.
    """
    label = np.stack([twin.part for twin in twins])
    label = np.where(label == BACKGROUND, -1, label)
    counts = confusion(labelled.part, label, len(category.parts))
    order = tuple(int(p) for p in choose_order(counts, "dataset", np.zeros(counts.shape))[0])
    own = [reordered(_parts(twin), order, category) for twin in twins]
    unit = np.array([4 * mean_radius(points) for points in labelled.points])
    base = np.stack([parts.camera_T_part[:1] for parts in own])
    offset = fit_frames(base, labelled.camera_T_part[:, :1], scale=unit).offsets[0]
    axis = np.stack([parts.axis for parts in own])
    sign = np.where(np.median((axis * labelled.axis).sum(-1), axis=0) < 0, -1.0, 1.0)
    difference = labelled.state - sign * np.stack([parts.state for parts in own])
    zero = [
        float(np.median(difference[:, j] / unit)) if spec.kind == "prismatic"
        else _middle_angle(difference[:, j])
        for j, spec in enumerate(category.joints)
    ]  # fmt: skip
    return Alignment(
        order=order,
        base=tuple(map(tuple, offset.tolist())),
        sign=tuple(float(value) for value in sign),
        zero=tuple(zero),
    )


def _parts(twin: Twin) -> Parts:
    return Parts(
        camera_T_part=twin.camera_T_part,
        pivot=twin.pivot,
        axis=twin.axis,
        state=twin.state,
        limits=twin.limits,
    )


def _middle_angle(angle: Float[np.ndarray, " S"]) -> float:
    """Median about the circular mean, radians."""
    mean = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
    away = (angle - mean + np.pi) % (2 * np.pi) - np.pi
    return float(mean + np.median(away))


def right_answers(
    twins: Sequence[Twin], labelled: Labelled
) -> tuple[Bool[np.ndarray, "S J"], Bool[np.ndarray, "S P"]]:
    """Whether each joint's direction and each part's rotation are right (5 and 10 degrees)."""
    axis = np.stack([twin.axis for twin in twins])
    pose = np.stack([twin.camera_T_part for twin in twins])
    direction = line_degrees(labelled.axis, axis)
    turn = rotation_degrees(labelled.camera_T_part[..., :3, :3], pose[..., :3, :3])
    return direction <= JOINT_DEGREES, turn <= PART_DEGREES


def _fitted(
    twins: Sequence[Twin],
    kind: str,
    right: Bool[np.ndarray, "S K"],
    instance: Int[np.ndarray, " S"],
) -> tuple[tuple[LogisticMap, ...], Reliability]:
    """A map per joint or part, and how true those of other objects are.

    Raises:
        StoreError: The method says nothing that a map could be fitted to.
    """
    maps: list[LogisticMap] = []
    probabilities: list[np.ndarray] = []
    fold = np.unique(instance, return_inverse=True)[1] % FOLDS
    for index in range(right.shape[1]):
        rows = [feature(twin.evidence, kind, index) for twin in twins]
        if any(row is None for row in rows):
            raise StoreError("expected a method with a shape and a confidence, found one without")
        x = np.array(rows, np.float64)
        maps.append(fit_map(x, right[:, index]))
        told = np.zeros(len(x))
        for one in range(FOLDS):
            out = fold == one
            if out.any() and not out.all():
                other = fit_map(x[~out], right[~out, index])
                told[out] = [other.probability(row) for row in x[out].tolist()]
        probabilities.append(told)
    return tuple(maps), reliability(np.concatenate(probabilities), right.T.ravel())
