# SPDX-License-Identifier: MIT
"""`calibrate`: what labelled clouds teach about a model's answers (`calibration`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from bench.infer.answer import agreement, ask
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
from bench.infer.model import Model, load_model
from bench.matching import rotation_degrees
from bench.metrics import line_degrees
from bench.requests import CalibrateRequest
from bench.runs.align import aligned
from bench.runs.train import pick_device
from bench.scoring.frame import LEAST_SAMPLES
from bench.twin.record import Twin
from scapo.method import evenly
from scapo.predictor import Predictor
from scapo.released import find
from scapo.store import Split, StoreError, open_split
from scapo.store.checkpoint import weights_file
from scapo.store.files import require_suffix
from scapo.store.samples import observed

FOLDS = 5
"""Of the objects: probabilities that `reliability` judges come from maps fitted without them."""
Watch = Callable[[Sequence[int]], Iterable[int]]
"""Passes samples on."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labelled:
    """Clouds with the truth."""

    points: Float[np.ndarray, "S N 3"]
    camera_T_part: Float[np.ndarray, "S P 4 4"]
    axis: Float[np.ndarray, "S J 3"]
    instance: Int[np.ndarray, " S"]
    sensor: Float[np.ndarray, "S 3"] | None
    """None: the clouds are in their cameras' frames."""

    def clouds(self) -> list[Cloud]:
        """As `infer` would have read them."""
        centres = [None] * len(self.points) if self.sensor is None else self.sensor
        pairs = zip(self.points, centres, strict=True)
        return [Cloud(points=points, sensor=sensor) for points, sensor in pairs]


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
    own = load_model(file, pick_device(request.device), None)
    split = open_split(request.data, own.category.name, request.split)
    labelled = _labelled(split, request.limit)
    clouds = labelled.clouds()
    model = _in_object_frame(own, split, request)
    found = Calibration(
        model=model.digest,
        mode=request.mode,
        category=model.category.name,
        split=request.split,
        data=split.manifest.digest,
        samples=len(clouds),
        alignment=None if own.predictor.in_object_frame else model.predictor.alignment,
        joint=(),
        part=(),
        reliability={},
    )
    twins = [_whole(clouds[i], model, request) for i in watch(range(len(clouds)))]
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


def _in_object_frame(model: Model, split: Split, request: CalibrateRequest) -> Model:
    """The model, brought to the object's frame by the same clouds where it is not in it.

    Raises:
        StoreError: Too few have labels and an answer.
    """
    asked = model.predictor
    if asked.in_object_frame:
        return model
    found = aligned(asked.model, split, request.limit, request.mode, asked.device)
    if found is None:
        raise StoreError(
            f"{split.folder}: expected at least {LEAST_SAMPLES} labelled clouds in which the model "
            "finds every part, found fewer"
        )
    return replace(model, predictor=Predictor(asked.model, asked.device, found))


def _labelled(split: Split, limit: int | None) -> Labelled:
    """Samples evenly spread over a split.

    Raises:
        StoreError: Too few.
    """
    sensor = {"sensor"} & set(observed(split))
    arrays = split.arrays("points", "camera_T_part", "joint_axis", "instance", *sensor)
    total = len(arrays["points"])
    index = evenly(total, limit).numpy()
    if len(index) < LEAST_SAMPLES:
        raise StoreError(
            f"{split.folder}: expected at least {LEAST_SAMPLES} samples, found {len(index)}"
        )
    some: dict[str, Any] = {name: array[index] for name, array in arrays.items()}
    return Labelled(
        points=some["points"],
        camera_T_part=some["camera_T_part"].astype(np.float64),
        axis=some["joint_axis"].astype(np.float64),
        instance=some["instance"].astype(int),
        sensor=some.get("sensor"),
    )


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
