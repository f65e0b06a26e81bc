# SPDX-License-Identifier: MIT
"""Predictions and truth of some samples -> errors per sample and slot, with their units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from bench.matching import apply_calibration, is_swapped, reorder_joints, reorder_poses
from bench.metrics import (
    Agreement,
    agree,
    joint_errors,
    pose_errors,
    state_errors,
    state_sign,
)
from bench.requests import Settings
from bench.scoring.truth import Truth
from scapo.geometry.part_order import hard_labels
from scapo.types import Prediction

Rows = dict[str, np.ndarray]
"""Tensors of a predictions file for some samples."""
Errors = dict[tuple[str, str], np.ndarray]
"""(metric, unit) -> (B, slots); a prismatic state has its lengths, a revolute one its degrees,
and NaN in the other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """What relates a method's own frames to the true ones."""

    symmetry: Float[np.ndarray, "3 3"] | None
    revolute: np.ndarray
    """(J,) bool."""
    offsets: Float[np.ndarray, "P 4 4"] | None = None
    """own_T_part, translations in r4; None: compared as given."""
    state_offset: Float[np.ndarray, " J"] | None = None
    """Radians, or r4 for a prismatic joint; None: 0."""
    order: tuple[int, ...] = ()
    """The part that each of the method's slots became in the predictions; empty: as they were."""


def to_arrays(prediction: Prediction) -> Rows:
    """The tensors of a predictions file; what the method does not say is left out."""
    joints = prediction.joints
    tensors = {
        "part_weight": prediction.part_weight,
        "camera_T_part": prediction.camera_T_part,
        "joint_pivot": None if joints is None else joints.pivot,
        "joint_axis": None if joints is None else joints.axis,
        "joint_state": None if joints is None else joints.state,
        "canonical_points": prediction.canonical_points,
        "confidence_sample": prediction.confidence,
        **{f"record_{name}": tensor for name, tensor in (prediction.record or {}).items()},
    }
    return {
        name: tensor.detach().cpu().numpy().astype(np.float32)
        for name, tensor in tensors.items()
        if tensor is not None
    }


def label_of(rows: Rows) -> np.ndarray:
    """The segmentation of a predictions file, labels or weights."""
    return rows["part"] if "part" in rows else rows["part_weight"]


def agreement_of(
    truth: Truth, rows: Rows, settings: Settings, order: Int[np.ndarray, " P"] | None
) -> Agreement:
    """Order and IoU; `order` is the one of the whole data set where it was fixed before."""
    given = settings.label_order
    if order is not None:
        given = np.broadcast_to(order, (len(truth), len(order)))
    parts = truth.camera_T_part.shape[1]
    return agree(truth.part, label_of(rows), parts, label_order=given, iou=settings.iou)


def score(
    truth: Truth,
    rows: Rows,
    *,
    settings: Settings,
    frames: Frames,
    order: Int[np.ndarray, " P"] | None = None,
) -> Errors:
    """Every metric of these samples; a slot without an answer is NaN."""
    agreement = agreement_of(truth, rows, settings, order)
    pose = rows.get("camera_T_part")
    if pose is not None and frames.offsets is not None:
        pose = apply_calibration(pose, frames.offsets, scale=truth.scale)
    true_pose = reorder_poses(truth.camera_T_part, agreement.order, frames.symmetry)
    turn, shift = pose_errors(true_pose, pose, settings.rotation)
    true_axis = reorder_joints(truth.joint_axis, agreement.order)
    direction, distance = joint_errors(
        reorder_joints(truth.joint_pivot, agreement.order),
        true_axis,
        rows.get("joint_pivot"),
        rows.get("joint_axis"),
        settings.pivot,
    )
    answered = agreement.answered[:, None]
    out: Errors = {
        ("iou", "1"): agreement.iou,
        ("order", "1"): np.where(answered, agreement.order.astype(np.float64), np.nan),
        ("joint_direction", "deg"): direction,
        **_lengths("joint_pivot", distance, truth),
        **_states(truth, rows, frames, agreement, true_axis),
        ("part_rotation", "deg"): turn,
        **_lengths("part_translation", shift, truth),
    }
    if "canonical_points" in rows:
        out |= _lengths("reconstruction", reconstruction(truth, rows)[:, None], truth)
    return out


def _lengths(name: str, metres: Float[np.ndarray, "B K"], truth: Truth) -> Errors:
    return {(name, "r4"): metres / truth.scale[:, None], (name, "m"): metres}


def _states(
    truth: Truth,
    rows: Rows,
    frames: Frames,
    agreement: Agreement,
    true_axis: Float[np.ndarray, "B J 3"],
) -> Errors:
    """The error of the joint state in degrees, or in r4 and metres where the joint slides."""
    turns = frames.revolute
    if "joint_state" in rows:
        unit = np.where(turns, 1.0, truth.scale[:, None])
        offset = np.zeros(len(turns)) if frames.state_offset is None else frames.state_offset
        error = state_errors(
            state_true=reorder_joints(truth.joint_state, agreement.order),
            state_pred=rows["joint_state"].astype(np.float64),
            revolute=turns,
            offset=offset * unit,
            sign=signs(rows, agreement.order, true_axis),
        )
    else:
        error = np.full(truth.joint_state.shape, np.nan)
    out: Errors = {}
    if turns.any():
        out["joint_state", "deg"] = np.where(turns, np.degrees(error), np.nan)
    if not turns.all():
        out |= _lengths("joint_state", np.where(turns, np.nan, error), truth)
    return out


def signs(
    rows: Rows, order: Int[np.ndarray, "B P"], true_axis: Float[np.ndarray, "B J 3"]
) -> Float[np.ndarray, "B J"]:
    """`metrics.state_sign` of a block."""
    reversed_ = is_swapped(order) & (order.shape[1] == 2)
    return state_sign(true_axis, rows.get("joint_axis"), reversed_)


def reconstruction(truth: Truth, rows: Rows) -> Float[np.ndarray, " B"]:
    """Mean distance of the observed object points from the canonical shape, metres.

    Each point of the object (true label of a part) goes back to the method's canonical frame by
    the inverse of the predicted pose of its predicted part; its distance is that to the nearest
    of `canonical_points`. One way only: what the camera does not see cannot be missed. NaN
    without poses, and for a sample without an answer in any of the three tensors or to any part.
    """
    out = np.full(len(truth), np.nan)
    if "camera_T_part" not in rows:
        return out
    label = hard_labels(label_of(rows))
    for i in range(len(truth)):
        pose, shape = rows["camera_T_part"][i].astype(np.float64), rows["canonical_points"][i]
        seen = (truth.part[i] >= 0) & (label[i] >= 0)
        if not (np.isfinite(pose).all() and np.isfinite(shape).all() and seen.any()):
            continue
        own = pose[label[i][seen]]
        offset = truth.points[i][seen] - own[:, :3, 3]
        canonical = np.einsum("nji,nj->ni", own[:, :3, :3], offset)
        out[i] = KDTree(shape).query(canonical)[0].mean()
    return out
