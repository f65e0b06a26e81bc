# SPDX-License-Identifier: MIT
"""What a model says of an object's cloud, as a `Twin`, and what speaks for and against it.

A model that saw no labels has part frames, an order of parts and states of its own; where labelled
clouds told (`scapo.alignment`) they are brought to those of the category.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from bench.infer.cloud import LEAST_POINTS, Cloud, InputError
from bench.infer.model import Model
from bench.infer.parts import Parts
from bench.matching import rotation_degrees
from bench.requests import Mode
from bench.twin.record import BACKGROUND, Shape, Twin
from scapo.categories import Category
from scapo.geometry.points import normalise
from scapo.records import take
from scapo.registered.outliers import inlier_mask
from scapo.registered.pose_refinement import BACKWARD, RANKED
from scapo.registered.view_loss import view_loss
from scapo.registered.views import observe
from scapo.types import Prediction

POINTS = 1024
"""Of a cloud that a model sees: as many as in training."""
RESAMPLES = 4
"""Other draws of the points that are asked as well."""
RESAMPLED = 0.75
"""Share of the points in each of those at most."""
ODD_SIZE = 5.0
"""Times the size of a usual object of the category, or its share, from which on it is said."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Drawn:
    """The points that a model sees."""

    points: Float[np.ndarray, "K 3"]
    inlier: Bool[np.ndarray, " K"]


def ask(name: str, cloud: Cloud, model: Model, mode: Mode) -> Twin:
    """The model's answer, without confidences; `evidence` has the margin, of a view the residual.

    Args:
        name: Of the input.
        cloud: The object.
        model: Of one category.
        mode: Of prediction.

    Raises:
        InputError: The method says nothing of joints or part poses.
    """
    drawn = _draw(cloud)
    found = model.predictor.predict(drawn.points, mode, cloud.sensor, up=_up(cloud, model))
    parts = _parts(name, found, model.category)
    label = np.where(drawn.inlier, _labels(found), BACKGROUND)
    near = KDTree(drawn.points).query(cloud.points)[1]
    shape = _shape(found)
    own = drawn.points[drawn.inlier]
    pivot = _near_parts(parts, own, label[drawn.inlier], model.category)
    limits, words = _limits(parts, model)
    evidence = {} if found.confidence is None else {"margin": float(found.confidence)}
    if shape is not None and mode != "whole":  # which is no view
        evidence["residual"] = residual(own, shape, cloud.sensor)
    return Twin(
        name=name,
        category=model.category,
        points=cloud.points,
        frame="input" if cloud.sensor is not None and cloud.sensor.any() else "camera",
        part=label[near],
        color=cloud.color,
        camera_T_part=parts.camera_T_part,
        pivot=pivot,
        axis=parts.axis,
        state=parts.state,
        limits=limits,
        shape=shape,
        evidence=evidence,
        model={"name": model.name, "method": model.method, "sha256": model.digest},
        warnings=(
            *cloud.warnings,
            *_odd_size(cloud, model.category),
            *_unused(cloud, model),
            *words,
        ),
    )


def _up(cloud: Cloud, model: Model) -> Float[np.ndarray, 3] | None:
    """The cloud's up, for a model that can use it."""
    return cloud.up if model.predictor.knows_up else None


def _unused(cloud: Cloud, model: Model) -> tuple[str, ...]:
    """A warning where the model cannot be told the cloud's up."""
    blind = cloud.up is not None and not model.predictor.knows_up
    return ("this model cannot use --up",) if blind else ()


def agreement(cloud: Cloud, twin: Twin, model: Model, mode: Mode) -> Twin:
    """The twin with how far answers to other draws of its points differ, in its evidence.

    `joint_J_spread` and `part_P_spread` are median angles in degrees, of axes and of rotations.
    """
    rng = np.random.default_rng(1)
    count = min(POINTS, max(int(RESAMPLED * len(cloud.points)), LEAST_POINTS // 2))
    draws = [cloud.points[rng.choice(len(cloud.points), count, replace=False)]
             for _ in range(RESAMPLES)]  # fmt: skip
    found = model.predictor.predict(np.stack(draws), mode, cloud.sensor, up=_up(cloud, model))
    others = [
        _parts(twin.name, take(found, torch.tensor(k)), model.category) for k in range(RESAMPLES)
    ]
    poses = np.stack([one.camera_T_part[:, :3, :3] for one in others])
    turn = rotation_degrees(poses, np.broadcast_to(twin.camera_T_part[:, :3, :3], poses.shape))
    cosine = np.abs((np.stack([one.axis for one in others]) * twin.axis).sum(-1)).clip(0, 1)
    evidence = dict(twin.evidence)
    for p, value in enumerate(np.median(turn, axis=0)):
        evidence[f"part_{p}_spread"] = float(value)
    for j, value in enumerate(np.median(np.degrees(np.arccos(cosine)), axis=0)):
        evidence[f"joint_{j}_spread"] = float(value)
    return replace(twin, evidence=evidence)


def residual(
    points: Float[np.ndarray, "K 3"], shape: Shape, sensor: Float[np.ndarray, 3] | None
) -> float:
    """How badly the placed shape explains the view: 0 to about 3 (`scapo.registered.view_loss`).

    Observed points that are not on the shape count, and points of the shape that this camera would
    have seen and did not.

    Args:
        points: Observed.
        shape: Placed, in the same frame.
        sensor: Centre of the camera; None: the origin.
    """
    cloud = torch.as_tensor(points, dtype=torch.float32)[None]
    normal, similarity = normalise(cloud)
    at = torch.zeros(1, 1, 3) if sensor is None else torch.as_tensor(sensor).float().view(1, 1, 3)
    views = observe(normal, similarity.forward(at)[:, 0])
    placed = similarity.forward(torch.as_tensor(shape.points, dtype=torch.float32)[None])
    normals = torch.as_tensor(shape.normals, dtype=torch.float32)[None]
    return float(view_loss(views, (placed, normals), RANKED, BACKWARD))


def _draw(cloud: Cloud) -> _Drawn:
    count = min(POINTS, len(cloud.points))
    index = np.random.default_rng(0).choice(len(cloud.points), count, replace=False)
    points = cloud.points[index]
    inlier = inlier_mask(torch.as_tensor(points)[None])[0].numpy()
    return _Drawn(points=points, inlier=inlier)


def _labels(found: Prediction) -> Int[np.ndarray, " K"]:
    return found.part_weight.argmax(-1).numpy()


def _parts(name: str, found: Prediction, category: Category) -> Parts:
    """Poses and joints; children are the base moved by its joint, as a robot's are.

    Raises:
        InputError: Without joints or poses, or with others than numbers.
    """
    if found.joints is None or found.camera_T_part is None:
        raise InputError(f"{name}: expected a method that predicts poses and joints, found none")
    joints = found.joints
    poses = found.camera_T_part.double()
    states = joints.state.double()
    values = (poses, joints.pivot, joints.axis, states)
    if not all(bool(torch.isfinite(value).all()) for value in values):
        raise InputError(f"{name}: expected an answer in numbers, found NaN; try more points")
    limits = found.joint_limits
    return Parts.of(
        category,
        camera_T_base=poses[0].numpy(),
        pivot=joints.pivot.double().numpy(),
        axis=torch.nn.functional.normalize(joints.axis.double(), dim=-1).numpy(),
        state=states.numpy(),
        limits=None if limits is None else limits.double().numpy(),
    )


def _shape(found: Prediction) -> Shape | None:
    """The canonical shape, its parts moved to where they are observed."""
    shape, normals, part = found.canonical_points, found.canonical_normals, found.canonical_part
    if shape is None or normals is None or part is None or found.camera_T_part is None:
        return None
    pose = found.camera_T_part[part]  # (M, 4, 4)
    placed = (pose[:, :3, :3] @ shape[..., None])[..., 0] + pose[:, :3, 3]
    turned = (pose[:, :3, :3] @ normals[..., None])[..., 0]
    return Shape(points=placed.numpy(), normals=turned.numpy(), part=part.numpy())


def _near_parts(
    parts: Parts,
    points: Float[np.ndarray, "K 3"],
    label: Int[np.ndarray, " K"],
    category: Category,
) -> Float[np.ndarray, "J 3"]:
    """Pivots moved along their axes to beside the part that they carry, where it is seen."""
    out = parts.pivot.copy()
    for j, spec in enumerate(category.joints):
        own = points[label == spec.child]
        if len(own):
            out[j] += parts.axis[j] * float(np.median((own - out[j]) @ parts.axis[j]))
    return out


def _limits(parts: Parts, model: Model) -> tuple[Float[np.ndarray, "J 2"], tuple[str, ...]]:
    """Limits that hold the state: of the category, or of training's objects by the method's zero.

    Where neither is known, half of the category's travel either way.
    """
    words = []
    limits = np.array([[spec.lower, spec.upper] for spec in model.category.joints])
    if not model.predictor.in_object_frame and parts.limits is not None:
        limits = parts.limits
    elif not model.predictor.in_object_frame:
        limits = limits - limits.mean(1, keepdims=True) + parts.state[:, None]
        words.append("joint limits are a guess: the method knows neither rest nor range")
    wide = np.stack(
        [np.minimum(limits[:, 0], parts.state), np.maximum(limits[:, 1], parts.state)], -1
    )
    wide[:, 1] = np.maximum(wide[:, 1], wide[:, 0] + 1e-3)
    return wide, tuple(words)


def _odd_size(cloud: Cloud, category: Category) -> tuple[str, ...]:
    diagonal = float(np.linalg.norm(cloud.extent()))
    if category.diagonal / ODD_SIZE < diagonal < category.diagonal * ODD_SIZE:
        return ()
    return (
        f"the cloud's box has a diagonal of {diagonal:.3g} m, a usual {category.name} "
        f"{category.diagonal:.3g} m: is it in metres (--scale)?",
    )
