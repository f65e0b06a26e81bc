# SPDX-License-Identifier: MIT
"""The errors of a prediction, one number per sample and slot, and the precision made of them.

Pure functions of numpy arrays (docs/protocol.md). A slot is a predicted part or joint. What cannot
be computed is NaN, never perfect. Angles are degrees, lengths those of the input.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from bench.matching import (
    LabelOrder,
    as_weights,
    choose_order,
    overlap,
    reorder_joints,
    reorder_poses,
    rotation_degrees,
    soft_confusion,
)
from scapo.geometry.part_order import confusion, hard_labels

ApRule = Literal["mean", "min", "per-part"]
IouKind = Literal["hard", "soft"]
PivotKind = Literal["point-line", "line-line"]
RotationKind = Literal["full", "folded"]

PARALLEL = 1e-6
"""Sine below which two lines count as parallel."""


METRICS = {
    "iou": ("1",),
    "joint_direction": ("deg",),
    "joint_pivot": ("r4", "m"),
    "joint_state": ("deg", "r4", "m"),
    "part_rotation": ("deg",),
    "part_translation": ("r4", "m"),
    "reconstruction": ("r4", "m"),
    "order": ("1",),
}
"""Units of each name in the scores; `r4`: 1 = 4 x the mean radius of the cloud."""


def sample_errors(  # noqa: PLR0913
    *,
    part_true: np.ndarray,
    camera_T_part_true: np.ndarray,
    pivot_true: np.ndarray,
    axis_true: np.ndarray,
    part_pred: np.ndarray,
    camera_T_part_pred: np.ndarray | None,
    pivot_pred: np.ndarray | None,
    axis_pred: np.ndarray | None,
    symmetry: np.ndarray | None = None,
    label_order: LabelOrder = "sample",
    iou: IouKind = "hard",
    pivot: PivotKind = "point-line",
    rotation: RotationKind = "full",
) -> dict[str, np.ndarray]:
    """All errors of a batch after matching the part order.

    Args:
        part_true: (B, N) ints, negative = ignored.
        camera_T_part_true: (B, P, 4, 4).
        pivot_true: (B, J, 3), a point on the axis.
        axis_true: (B, J, 3), of any length.
        part_pred: (B, N) ints or (B, N, P) weights.
        camera_T_part_pred: (B, P, 4, 4), in the true part frames, or None.
        pivot_pred: (B, J, 3) or None.
        axis_pred: (B, J, 3), of any length, or None.
        symmetry: (3, 3) right-multiplied to the true rotations of swapped samples.
        label_order: Who chooses the order of the parts, see `matching.choose_order`.
        iou: `hard` on labels, `soft` on weights: sum(g q) / (sum g + sum q - sum g q).
        pivot: `point-line`: predicted pivot to true axis. `line-line`: between the two axes.
        rotation: `folded` takes min(e, 180 - e).

    Returns:
        `order` (B, P), `iou` (B, P), `joint_direction` (B, J), `joint_pivot` (B, J),
        `part_rotation` (B, P), `part_translation` (B, P); slot = predicted slot.

    Raises:
        ValueError: `label_order`, `iou`, `pivot` or `rotation` that is none of the known ones.
    """
    check_readings(label_order=label_order, iou=iou, pivot=pivot, rotation=rotation)
    parts = camera_T_part_true.shape[1]
    said = np.asarray(part_pred)
    said = finite_or_nan(said) if said.ndim == 3 else said
    agreement = agree(np.asarray(part_true), said, parts, label_order=label_order, iou=iou)
    poses = reorder_poses(np.asarray(camera_T_part_true), agreement.order, symmetry)
    turn, shift = pose_errors(poses, camera_T_part_pred, rotation)
    direction, distance = joint_errors(
        reorder_joints(np.asarray(pivot_true), agreement.order),
        reorder_joints(np.asarray(axis_true), agreement.order),
        pivot_pred,
        axis_pred,
        pivot,
    )
    return {
        "order": agreement.order,
        "iou": agreement.iou,
        "joint_direction": direction,
        "joint_pivot": distance,
        "part_rotation": turn,
        "part_translation": shift,
    }


KINDS = {"label_order": LabelOrder, "iou": IouKind, "pivot": PivotKind, "rotation": RotationKind}


def check_readings(**readings: str) -> None:
    """Refuse what is no reading of the metrics, by the names of `sample_errors`.

    Raises:
        ValueError: Naming the known ones.
    """
    for name, found in readings.items():
        known = get_args(KINDS[name])
        if found not in known:
            raise ValueError(f"{name}: expected one of {', '.join(known)}, found {found!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How predicted labels meet the true ones."""

    order: Int[np.ndarray, "B P"]
    """The true part compared with each slot."""
    iou: Float[np.ndarray, "B P"]
    """In that order."""
    answered: Bool[np.ndarray, " B"]
    """Whether any point has a label."""


def agree(
    part_true: Int[np.ndarray, "B N"],
    part_pred: Num[np.ndarray, "B N *P"],
    parts: int,
    *,
    label_order: LabelOrder | Int[np.ndarray, "B P"],
    iou: IouKind,
) -> Agreement:
    """Order and IoU (docs/protocol.md); `label_order` may be the order itself."""
    label = hard_labels(part_pred)
    known = (part_true >= 0) & (part_true < parts)
    true_count = np.stack([(part_true == p).sum(1) for p in range(parts)], 1)
    slot_count = np.stack([(known & (label == p)).sum(1) for p in range(parts)], 1)
    counts = confusion(part_true, label, parts)
    if iou == "soft" or (isinstance(label_order, str) and label_order == "hungarian"):
        weight = part_pred if part_pred.ndim == 3 else as_weights(label, parts)
        shared = soft_confusion(part_true, weight)
        soft = overlap(shared, true_count, shared.sum(1))
    else:
        soft = np.zeros(counts.shape)
    order = choose_order(counts, label_order, soft) if isinstance(label_order, str) else label_order
    table = soft if iou == "soft" else overlap(counts, true_count, slot_count)
    value = table[np.arange(len(order))[:, None], order, np.arange(parts)]
    answered = np.asarray((label >= 0).any(1))
    iou_ = np.where(answered[:, None], value, np.nan)
    return Agreement(order=order, iou=iou_, answered=answered)


def pose_errors(
    true: Float[np.ndarray, "B P 4 4"],
    pred: Num[np.ndarray, "B P 4 4"] | None,
    rotation: RotationKind = "full",
) -> tuple[Float[np.ndarray, "B P"], Float[np.ndarray, "B P"]]:
    """Rotation error in degrees and translation error (docs/protocol.md).

    The predicted rotation is brought to the nearest orthogonal matrix first, as published; a
    reflection has no angle and is NaN.
    """
    if pred is None:
        nothing = np.full(true.shape[:2], np.nan)
        return nothing, nothing.copy()
    pred = finite_or_nan(pred)
    shift = np.linalg.norm(true[..., :3, 3] - pred[..., :3, 3], axis=-1)
    matrix = pred[..., :3, :3]
    finite = np.asarray(np.isfinite(matrix).all((-2, -1)))
    u, size, vt = np.linalg.svd(np.where(finite[..., None, None], matrix, np.eye(3)))
    nearest = u @ vt
    angle = rotation_degrees(true[..., :3, :3], nearest)
    usable = finite & (np.linalg.det(nearest) > 0) & (size[..., 2] > 1e-6 * size[..., 0])
    angle = np.where(usable, angle, np.nan)
    if rotation == "folded":
        angle = np.minimum(angle, 180 - angle)
    return angle, shift


def joint_errors(
    pivot_true: Float[np.ndarray, "B J 3"],
    axis_true: Float[np.ndarray, "B J 3"],
    pivot_pred: Num[np.ndarray, "B J 3"] | None,
    axis_pred: Num[np.ndarray, "B J 3"] | None,
    kind: PivotKind = "point-line",
) -> tuple[Float[np.ndarray, "B J"], Float[np.ndarray, "B J"]]:
    """Angle between the undirected axes in degrees, and distance of the pivot."""
    nothing = np.full(pivot_true.shape[:2], np.nan)
    true = unit(axis_true)
    pred = None if axis_pred is None else unit(finite_or_nan(axis_pred))
    direction = nothing if pred is None else line_degrees(true, pred)
    if pivot_pred is None or (kind == "line-line" and pred is None):
        return direction, nothing.copy()
    offset = finite_or_nan(pivot_pred) - pivot_true
    distance = np.linalg.norm(np.cross(offset, true), axis=-1)
    if kind == "line-line" and pred is not None:
        normal = np.cross(true, pred)
        sine = np.linalg.norm(normal, axis=-1)
        between = np.abs((offset * normal).sum(-1)) / np.maximum(sine, PARALLEL)
        distance = np.where(sine > PARALLEL, between, distance)
        distance = np.where(np.isfinite(sine), distance, np.nan)
    return direction, distance


def finite_or_nan(values: np.ndarray) -> np.ndarray:
    """As float64, NaN in place of what is infinite: no answer is so far off."""
    values = np.asarray(values, np.float64)
    return np.where(np.isfinite(values), values, np.nan)


def unit(axis: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
    """Axes of length one; NaN for a zero axis."""
    largest = np.abs(axis).max(-1, keepdims=True)
    largest = np.where(largest > 0, largest, np.nan)
    axis = axis / largest  # no underflow in the norm of a tiny axis
    return axis / np.linalg.norm(axis, axis=-1, keepdims=True)


def line_degrees(
    a: Float[np.ndarray, "*B 3"], b: Float[np.ndarray, "*B 3"]
) -> Float[np.ndarray, "*B"]:
    """Angle between two lines by their unit directions, at most 90 degrees; exact near 0."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(sine, np.abs((a * b).sum(-1))))


def state_errors(
    *,
    state_true: Float[np.ndarray, "B J"],
    state_pred: Float[np.ndarray, "B J"],
    revolute: np.ndarray,
    offset: Float[np.ndarray, "*#B J"],
    sign: Float[np.ndarray, "B J"],
) -> Float[np.ndarray, "B J"]:
    """|s phi + offset - theta| (docs/protocol.md), radians (around the circle) or a length.

    Args:
        state_true: theta, ordered like the predicted joints.
        state_pred: phi.
        revolute: (J,) bool.
        offset: Of each joint, 0 for a method that knows the rest state.
        sign: See `state_sign`.
    """
    difference = sign * state_pred + offset - state_true
    around = np.abs((difference + np.pi) % (2 * np.pi) - np.pi)
    return np.where(revolute, around, np.abs(difference))


def state_sign(
    axis_true: Float[np.ndarray, "B J 3"],
    axis_pred: Num[np.ndarray, "B J 3"] | None,
    reversed_: np.ndarray,
) -> Float[np.ndarray, "B J"]:
    """+1 where predicted and true axis agree, -1 where they oppose.

    Where the two parts are swapped (`reversed_`, (B,) bool, two parts only), the predicted child
    is the true base, which moves the other way: the true axis counts as reversed. A state without
    an axis, whether of a sample or of all, is taken as positive towards open: +1.
    """
    if axis_pred is None:
        return np.ones(axis_true.shape[:2])
    along = (axis_true * np.asarray(axis_pred, np.float64)).sum(-1)
    sign = np.where(along < 0, -1.0, 1.0)
    return np.where(reversed_[:, None] & np.isfinite(along), -sign, sign)


def average_precision(
    *,
    iou: np.ndarray,
    part_rotation: np.ndarray,
    part_translation: np.ndarray,
    joint_direction: np.ndarray,
    joint_pivot: np.ndarray,
    rule: str = "mean",
) -> dict[str, float]:
    """Shares of Table 2 (docs/protocol.md): IoU over 75 and 50 %, errors under k degrees and k cm.

    `mean`: per sample, the mean over its parts (joints) of each error is compared. `min`: every
    part (joint) must pass. `per-part`: parts (joints) are counted one by one. Comparisons are
    strict. An undefined error fails; an undefined IoU (the part neither there nor predicted) is
    left out of its sample's mean or minimum, and fails where the sample has no other.

    Args:
        iou: (B, P).
        part_rotation: (B, P), degrees.
        part_translation: (B, P), metres.
        joint_direction: (B, J), degrees.
        joint_pivot: (B, J), metres.
        rule: How the parts of a sample join.

    Returns:
        `seg_75, seg_50, joint_5, joint_10, joint_15, part_5, part_10, part_15` as fractions; NaN
        for an empty batch.
    """
    passed = precision_passes(
        iou=iou,
        part_rotation=part_rotation,
        part_translation=part_translation,
        joint_direction=joint_direction,
        joint_pivot=joint_pivot,
        rule=rule,
    )
    return {name: float(p.mean()) if p.size else float("nan") for name, p in passed.items()}


def precision_passes(
    *,
    iou: np.ndarray,
    part_rotation: np.ndarray,
    part_translation: np.ndarray,
    joint_direction: np.ndarray,
    joint_pivot: np.ndarray,
    rule: str = "mean",
) -> dict[str, np.ndarray]:
    """What `average_precision` counts: bool (B,), or (B, P) and (B, J) for `per-part`."""
    rule_name = rule.replace("_", "-")
    if rule_name not in ("mean", "min", "per-part"):
        raise ValueError(f"rule: expected mean, min or per-part, found {rule!r}")
    joined = _Join(rule_name)
    overlaps = joined.iou(np.asarray(iou, np.float64))
    out = {f"seg_{k}": overlaps > k / 100 for k in (75, 50)}
    for name, angle, length in (
        ("joint", joint_direction, joint_pivot),
        ("part", part_rotation, part_translation),
    ):
        degrees, metres = joined.errors(np.asarray(angle)), joined.errors(np.asarray(length))
        for k in (5, 10, 15):
            out[f"{name}_{k}"] = (degrees < k) & (metres < k / 100)
    return out


@dataclass(frozen=True, slots=True)
class _Join:
    """How the values of one sample's slots become what is compared."""

    rule: str

    def iou(self, values: Float[np.ndarray, "B P"]) -> np.ndarray:
        if self.rule == "per-part":
            return values
        defined = ~np.isnan(values)
        if self.rule == "min":
            lowest = np.where(defined, values, np.inf).min(1)
            return np.where(defined.any(1), lowest, np.nan)
        total = np.where(defined, values, 0).sum(1)
        return np.where(defined.any(1), total / np.maximum(defined.sum(1), 1), np.nan)

    def errors(self, values: Num[np.ndarray, "B K"]) -> np.ndarray:
        if self.rule == "per-part":
            return values
        return values.max(1) if self.rule == "min" else values.mean(1)
