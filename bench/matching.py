# SPDX-License-Identifier: MIT
"""Which true part is compared with which predicted one, and the frames that predicted poses have.

The order of the parts is chosen by labels alone; the canonical frame of a method that saw no poses
is fitted on its predictions of the training split. Both are the same for every method
(docs/protocol.md). Truth is relabelled in a copy, never in place.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from scapo.geometry.part_order import joint_order, order_scores, part_orders

LabelOrder = Literal["sample", "dataset", "hungarian"]


DRAWS = 100
"""Random draws of the consensus search, each of `DRAW_SIZE` samples and each of one sample."""


DRAW_SIZE = 5


ROTATION_INLIER = 10.0
"""Degrees."""


TRANSLATION_INLIER = 0.25
"""In the unit of the fit: 4 x mean radius for the benchmark."""


def choose_order(
    counts: Int[np.ndarray, "B P P"], rule: LabelOrder, iou: Float[np.ndarray, "B P P"]
) -> Int[np.ndarray, "B P"]:
    """The true part compared with each slot, (B, P).

    `sample`: the order with the most points labelled right, per sample. `dataset`: the same, one
    order for all of the batch, each sample counting alike. `hungarian`: the one-to-one matching
    with the largest sum of `iou`, per sample, over all orders (EAP). Ties go to the identity.
    """
    parts = counts.shape[1]
    if rule == "hungarian":
        orders = np.array(list(permutations(range(parts))))
        score = np.nan_to_num(iou)[:, orders, np.arange(parts)].sum(-1)
        # Equal sums in another order of addition differ in the last digit.
        return orders[(score > score.max(1, keepdims=True) - 1e-9).argmax(1)]
    orders = part_orders(parts)
    if rule == "sample":
        return orders[order_scores(counts, orders).argmax(1)]
    best = accuracies(counts, orders).sum(0).argmax()
    return np.broadcast_to(orders[best], (len(counts), parts)).copy()


def accuracies(
    counts: Int[np.ndarray, "B P P"], orders: Int[np.ndarray, "O P"]
) -> Float[np.ndarray, "B O"]:
    """Share of the answered points labelled right under each order; 0 without an answer."""
    return order_scores(counts, orders) / np.maximum(counts.sum((1, 2)), 1)[:, None]


def soft_confusion(
    part_true: Int[np.ndarray, "B N"], weight: Num[np.ndarray, "B N P"]
) -> Float[np.ndarray, "B P P"]:
    """Predicted weight of slot q on the points of true part t, (B, P, P); NaN counts nothing."""
    slots = weight.shape[-1]
    weight = np.nan_to_num(weight.astype(np.float64))
    rows = [np.einsum("bn,bnq->bq", part_true == part, weight) for part in range(slots)]
    return np.stack(rows, 1)


def overlap(
    shared: Num[np.ndarray, "B P P"],
    true_count: Num[np.ndarray, "B P"],
    slot_count: Num[np.ndarray, "B P"],
) -> Float[np.ndarray, "B P P"]:
    """IoU of true part t and slot q from their intersection and sizes; 0/0 is NaN."""
    union = true_count[:, :, None] + slot_count[:, None, :] - shared
    return np.divide(shared, union, out=np.full(shared.shape, np.nan), where=union > 0)


def as_weights(label: Int[np.ndarray, "B N"], parts: int) -> Float[np.ndarray, "B N P"]:
    """One-hot weights; labels outside 0..P-1 have none."""
    return (label[..., None] == np.arange(parts)).astype(np.float64)


def is_swapped(order: Int[np.ndarray, "B P"]) -> Bool[np.ndarray, " B"]:
    """Where the order is the exchange that a category's symmetry rotation belongs to."""
    parts = order.shape[1]
    if parts not in (2, 3):
        return np.zeros(len(order), bool)
    return (order == part_orders(parts)[1]).all(1)


def reorder_joints(
    values: Num[np.ndarray, "B J *rest"], order: Int[np.ndarray, "B P"]
) -> Float[np.ndarray, "B J *rest"]:
    """True joint quantities by predicted joint; NaN where `joint_order` has none."""
    joint = joint_order(order)
    index = np.maximum(joint, 0).reshape(*joint.shape, *[1] * (values.ndim - 2))
    out = np.take_along_axis(values, index, 1).astype(np.float64)
    out[joint < 0] = np.nan
    return out


def reorder_poses(
    camera_T_part: Float[np.ndarray, "B P 4 4"],
    order: Int[np.ndarray, "B P"],
    symmetry: np.ndarray | None,
) -> Float[np.ndarray, "B P 4 4"]:
    """True poses by slot; rotations of swapped samples times `symmetry` from the right."""
    poses = np.take_along_axis(camera_T_part, order[..., None, None], 1).astype(np.float64)
    if symmetry is not None:
        swapped = is_swapped(order)
        poses[swapped, :, :3, :3] = poses[swapped, :, :3, :3] @ np.asarray(symmetry, np.float64)
    return poses


def fit_calibration(
    camera_T_part_pred: np.ndarray,
    camera_T_part_true: np.ndarray,
    *,
    scale: np.ndarray | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Constant offsets T, (P, 4, 4), with pred @ T = true for most samples (docs/protocol.md).

    Args:
        camera_T_part_pred: (B, P, 4, 4).
        camera_T_part_true: (B, P, 4, 4), order-matched and symmetry-corrected.
        scale: (B,) divides the translations of both before the fit.
        seed: Of the random draws.

    Returns:
        One offset per part; NaN for a part without a finite prediction.
    """
    return calibrate(camera_T_part_pred, camera_T_part_true, scale=scale, seed=seed).offsets


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Constant offsets of a method's part frames, and how many samples agree with them."""

    offsets: Float[np.ndarray, "P 4 4"]
    """own_T_part: camera_T_own @ own_T_part = camera_T_part; translations in units of `scale`."""
    rotation_inliers: Float[np.ndarray, " P"]
    """Share of the answered samples within 10 degrees."""
    translation_inliers: Float[np.ndarray, " P"]
    """Share of the answered samples within 0.25."""
    answered: Int[np.ndarray, " P"]
    """Samples with a finite pose."""
    seed: int


def calibrate(
    camera_T_part_pred: np.ndarray,
    camera_T_part_true: np.ndarray,
    *,
    scale: np.ndarray | None = None,
    seed: int = 0,
) -> Calibration:
    """`fit_calibration` with the share of samples that agree."""
    pred = np.asarray(camera_T_part_pred, np.float64)
    true = np.asarray(camera_T_part_true, np.float64)
    unit = np.ones(len(pred)) if scale is None else np.asarray(scale, np.float64)
    inverse = np.swapaxes(pred[..., :3, :3], -1, -2)
    rotation = inverse @ true[..., :3, :3]
    shift = (true[..., :3, 3] - pred[..., :3, 3]) / unit[:, None, None]
    shift = (inverse @ shift[..., None])[..., 0]
    parts = [_consensus(rotation[:, p], shift[:, p], seed) for p in range(pred.shape[1])]
    return Calibration(
        offsets=np.stack([part[0] for part in parts]),
        rotation_inliers=np.array([part[1] for part in parts]),
        translation_inliers=np.array([part[2] for part in parts]),
        answered=np.array([part[3] for part in parts]),
        seed=seed,
    )


def apply_calibration(
    camera_T_part_pred: np.ndarray, offsets: np.ndarray, *, scale: np.ndarray | None = None
) -> np.ndarray:
    """Poses of the true frames: pred @ offsets, their translations times `scale` (B,)."""
    pred = np.asarray(camera_T_part_pred, np.float64)
    own_T_part = np.broadcast_to(np.asarray(offsets, np.float64), pred.shape).copy()
    if scale is not None:
        own_T_part[..., :3, 3] *= np.asarray(scale, np.float64)[:, None, None]
    return pred @ own_T_part


def _consensus(
    rotation: Float[np.ndarray, "B 3 3"], shift: Float[np.ndarray, "B 3"], seed: int
) -> tuple[Float[np.ndarray, "4 4"], float, float, int]:
    """One part: the draw that most samples agree with, refined on those.

    A draw's rotation and translation are judged together, unlike the published search, which may
    take each from another of two equally frequent frames.
    """
    finite = np.isfinite(rotation).all((1, 2)) & np.isfinite(shift).all(1)
    rotation, shift = rotation[finite], shift[finite]
    count = len(shift)
    if count == 0:
        return np.full((4, 4), np.nan), np.nan, np.nan, 0
    generator = np.random.default_rng(seed)
    best = (-1, np.eye(3), np.zeros(3))
    for size in [min(DRAW_SIZE, count)] * DRAWS + [1] * DRAWS:
        chosen = generator.choice(count, size=size, replace=False)
        guess = project_rotations(rotation[chosen].sum(0)), shift[chosen].mean(0)
        near, close = _agree(rotation, shift, *guess)
        score = int(near.sum() + close.sum())
        if score > best[0]:
            best = (score, *guess)
    turn, move = _refine(rotation, shift, best[1], best[2])
    near, close = _agree(rotation, shift, turn, move)
    offset = np.eye(4)
    offset[:3, :3], offset[:3, 3] = turn, move
    return offset, float(near.mean()), float(close.mean()), count


def _agree(
    rotation: Float[np.ndarray, "B 3 3"],
    shift: Float[np.ndarray, "B 3"],
    turn: Float[np.ndarray, "3 3"],
    move: Float[np.ndarray, " 3"],
) -> tuple[Bool[np.ndarray, " B"], Bool[np.ndarray, " B"]]:
    angle, distance = _residuals(rotation, shift, turn, move)
    return angle <= ROTATION_INLIER, distance <= TRANSLATION_INLIER


def _residuals(
    rotation: Float[np.ndarray, "B 3 3"],
    shift: Float[np.ndarray, "B 3"],
    turn: Float[np.ndarray, "3 3"],
    move: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"]]:
    return rotation_degrees(rotation, turn), np.linalg.norm(shift - move, axis=1)


def _refine(
    rotation: Float[np.ndarray, "B 3 3"],
    shift: Float[np.ndarray, "B 3"],
    turn: Float[np.ndarray, "3 3"],
    move: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """Means over the agreeing samples, the limits closing to three robust deviations."""
    angle_limit, distance_limit = ROTATION_INLIER, TRANSLATION_INLIER
    for _ in range(20):
        angle, distance = _residuals(rotation, shift, turn, move)
        near, close = angle <= angle_limit, distance <= distance_limit
        both = near & close
        near, close = (both, both) if both.any() else (near, close)
        if near.any():
            turn = project_rotations(rotation[near].sum(0))
        if close.any():
            move = shift[close].mean(0)
        if not both.any():
            continue
        angle, distance = _residuals(rotation[both], shift[both], turn, move)
        # 1.4826 x the median deviation is one standard deviation of a normal distribution.
        angle_limit = min(ROTATION_INLIER, max(1e-4, 4.45 * float(np.median(angle))))
        distance_limit = min(TRANSLATION_INLIER, max(1e-6, 4.45 * float(np.median(distance))))
    return turn, move


def nearest_orthogonal(matrix: Float[np.ndarray, "*B 3 3"]) -> Float[np.ndarray, "*B 3 3"]:
    """U V^T of the singular value decomposition, reflections included; NaN if not finite."""
    finite = np.asarray(np.isfinite(matrix).all((-2, -1)))[..., None, None]
    u, _, vt = np.linalg.svd(np.where(finite, matrix, np.eye(3)))
    return np.where(finite, u @ vt, np.nan)


def project_rotations(matrix: Float[np.ndarray, "*B 3 3"]) -> Float[np.ndarray, "*B 3 3"]:
    """Nearest rotations (SVD, det +1); NaN where an entry is not finite."""
    finite = np.asarray(np.isfinite(matrix).all((-2, -1)))[..., None, None]
    u, _, vt = np.linalg.svd(np.where(finite, matrix, np.eye(3)))
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.where(finite, u @ vt, np.nan)


def rotation_degrees(
    a: Float[np.ndarray, "*#B 3 3"], b: Float[np.ndarray, "*#B 3 3"]
) -> Float[np.ndarray, "*B"]:
    """Angle of a b^T in degrees by atan2, exact near 0 and near 180."""
    relative = a @ np.swapaxes(b, -1, -2)
    skew = relative - np.swapaxes(relative, -1, -2)
    sine = np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    cosine = np.trace(relative, axis1=-2, axis2=-1) - 1
    return np.degrees(np.arctan2(sine, cosine))
