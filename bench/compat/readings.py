# SPDX-License-Identifier: MIT
"""The published evaluators' readings, for comparison with printed numbers only (docs/protocol.md).

`opalign` follows the released OP-Align evaluation (commit f3323dd) including its defects: part
translations are not rotated, the third part is the base seen through joint 1, prismatic states
turn the part, and directions less than 0.81 degrees apart are still turned. `geometry="se3"` is
the same procedure without the first three. EAP's readings are in `eap`. Formulas are written anew
from their definitions, in float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from bench.compat.chain import Chain, inverse_chain, straight_chain
from bench.matching import nearest_orthogonal, project_rotations, rotation_degrees
from bench.metrics import unit
from scapo.geometry.part_order import order_scores, part_orders
from scapo.store.predictions import RECORD

Geometry = Literal["compat", "se3"]

SYMMETRY: dict[str, tuple[tuple[int, int, int], ...]] = {
    "laptop_h": ((0, 0, 1), (0, -1, 0), (1, 0, 0)),
    "laptop_m": ((0, 0, 1), (0, -1, 0), (1, 0, 0)),
    "eyeglasses": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "scissor_output": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "basket_output": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "laptop_output": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "suitcase_output": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
}
"""Rotation of the true poses of swapped samples by OP-Align's category id (docs/protocol.md)."""

_DRAWS, _SIZE = 100, 5
_ROTATION_INLIER, _TRANSLATION_INLIER = 10.0, 0.25


def opalign(
    record: Mapping[str, Any],
    *,
    n_train: int | None = None,
    ransac_seed: int | None = None,
    geometry: Geometry = "compat",
) -> dict[str, Any]:
    """OP-Align's evaluation of network outputs (docs/protocol.md).

    Args:
        record: Always `gt_pose` (B,P,4,4), `gt_joint` (B,J,6: pivot, direction), `gt_seg` (B,N),
            `pred_seg` (B,P,N), `shape_type`. With `R_select` and the rest of `RECORD` the whole
            pipeline is run: the first `n_train` samples calibrate, the others are tested.
            Otherwise the predictions `pred_rot` (B,P,3,3), `pred_trans` (B,P,3), `pred_pivot` and
            `pred_dir` (B,J,3) are compared as they are. Optional: `background` (labels 1..P, 0 is
            ignored), `expand` (B,) dividing lengths where `use_expand`, `joint_type` r or p,
            `symmetry` (3,3) or None instead of that of `shape_type`.
        n_train: Instead of the record's.
        ransac_seed: Of `numpy.random.RandomState`, instead of the record's (1234).
        geometry: `se3` corrects the first three defects.

    Returns:
        `iou` (B,P), `pivot_err`, `dir_err_deg` (B,J), `rot_err_deg`, `trans_err` (B,P) and the
        reordered truth `ordered_gt_pose|joint|seg`; of the pipeline, for the tested samples, also
        `pred_pose`, `pred_pivot_input`, `pred_dir_input` and of the calibration
        `standardized_gt_pose`, `canon_rot`, `canon_trans`, `ransac_rot_inlier_ratio`,
        `ransac_trans_inlier_ratio`.
    """
    if "R_select" not in record:
        pose = np.asarray(record["pred_rot"], np.float64), _float(record["pred_trans"])
        return _score(record, pose, (_float(record["pred_pivot"]), _float(record["pred_dir"])))
    missing = [name for name in RECORD if name not in record]
    if missing:
        raise ValueError(f"record: expected {', '.join(RECORD)}, found no {missing[0]}")
    count = int(record["n_train"]) if n_train is None else n_train
    seed = int(record.get("ransac_seed", 1234)) if ransac_seed is None else ransac_seed
    revolute = geometry == "compat" or str(record.get("joint_type", "r")) == "r"
    chain = Chain(revolute=revolute, corrected=geometry == "se3")
    standard = standardise(_rows(record, slice(0, count)), chain)
    canon, ratios = consensus(standard, seed)
    return score_record(_rows(record, slice(count, None)), canon, chain) | {
        "standardized_gt_pose": standard,
        "canon_rot": canon[0],
        "canon_trans": canon[1],
        "ransac_rot_inlier_ratio": ratios[0],
        "ransac_trans_inlier_ratio": ratios[1],
    }


def standardise(record: Mapping[str, Any], chain: Chain) -> Float[np.ndarray, "B P 4 4"]:
    """True part poses, reordered, brought to canonical space."""
    return straight_chain(record, _reorder(record)[0], chain)


def score_record(
    record: Mapping[str, Any], canon: tuple[np.ndarray, np.ndarray], chain: Chain
) -> dict[str, Any]:
    """Errors of test samples for the canonical part poses `canon`: see `opalign`."""
    rotation, shift = inverse_chain(record, canon, chain)
    turn = _float(record["R_select"])[:, None]
    moved = _float(record["S_joint"]) + _float(record["T_select"])[:, None]
    pivot = (turn @ moved[..., None])[..., 0]
    direction = (turn @ _float(record["S_drct"])[..., None])[..., 0]
    return _score(record, (rotation, shift), (pivot, direction)) | {
        "pred_pose": _poses(rotation, shift),
        "pred_pivot_input": pivot,
        "pred_dir_input": direction,
    }


def _float(values: object) -> np.ndarray:
    return np.asarray(values, np.float64)


def _poses(
    rotation: Float[np.ndarray, "*B 3 3"], shift: Float[np.ndarray, "*B 3"]
) -> Float[np.ndarray, "*B 4 4"]:
    out = np.zeros((*shift.shape[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, shift, 1
    return out


def _rows(record: Mapping[str, Any], rows: slice) -> dict[str, Any]:
    """The record of some samples: what is one value per sample is cut, the rest is kept."""
    names = ("gt_pose", "gt_joint", "gt_seg", "pred_seg", "expand", *RECORD)
    return {n: np.asarray(v)[rows] if n in names else v for n, v in record.items()}


def _reorder(
    record: Mapping[str, Any],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True poses, joints, labels in the predicted order; and which points count."""
    pose, joint = _float(record["gt_pose"]).copy(), _float(record["gt_joint"]).copy()
    label = np.asarray(record["gt_seg"]).astype(np.int64)
    first = 1 if bool(record.get("background", False)) else 0
    slots = np.asarray(record["pred_seg"])
    parts = slots.shape[1]
    counts = _counts(label - first, slots.argmax(1), parts)
    orders = part_orders(parts)
    best = order_scores(counts, orders).argmax(1)
    order = orders[best]
    pose = np.take_along_axis(pose, order[..., None, None], 1)
    if parts == 3:
        joint = np.take_along_axis(joint, (order[:, 1:] - 1)[..., None], 1)
    # The label that part t carries after reordering: the slot whose true part it is.
    slot_of = np.argsort(order, 1)
    known = label >= first
    moved = np.take_along_axis(slot_of, np.where(known, label - first, 0), 1) + first
    symmetry = record.get("symmetry", SYMMETRY.get(str(record.get("shape_type", ""))))
    if symmetry is not None:
        swapped = best == 1
        pose[swapped, :, :3, :3] = pose[swapped, :, :3, :3] @ np.array(symmetry, np.float64)
    return pose, joint, np.where(known, moved, label), known


def _counts(
    label: Int[np.ndarray, "B N"], slot: Int[np.ndarray, "B N"], parts: int
) -> Int[np.ndarray, "B P P"]:
    pairs = [[((label == t) & (slot == q)).sum(1) for q in range(parts)] for t in range(parts)]
    return np.moveaxis(np.array(pairs), -1, 0)


def _score(
    record: Mapping[str, Any],
    pose: tuple[np.ndarray, np.ndarray],
    joints: tuple[np.ndarray, np.ndarray],
) -> dict[str, Any]:
    """Segmentation, joints and poses in the published reading."""
    true_pose, true_joint, label, known = _reorder(record)
    expand = _float(record["expand"])[:, None] if _scaled(record) else 1.0
    axis, pred_axis = unit(true_joint[..., 3:]), unit(joints[1])
    offset = joints[0] - true_joint[..., :3]
    sine = np.linalg.norm(np.cross(axis, pred_axis), axis=-1)
    return {
        "iou": _hard_iou(label, known, record),
        # The published difference of squares can be negative on a perfect pivot; this cannot.
        "pivot_err": np.linalg.norm(np.cross(offset, axis), axis=-1) / expand,
        "dir_err_deg": np.degrees(np.arctan2(sine, np.abs((axis * pred_axis).sum(-1)))),
        "rot_err_deg": rotation_degrees(true_pose[..., :3, :3], nearest_orthogonal(pose[0])),
        "trans_err": np.linalg.norm(true_pose[..., :3, 3] - pose[1], axis=-1) / expand,
        "ordered_gt_pose": true_pose,
        "ordered_gt_joint": true_joint,
        "ordered_gt_seg": label,
    }


def _scaled(record: Mapping[str, Any]) -> bool:
    return "expand" in record and bool(record.get("use_expand", True))


def _hard_iou(
    label: Int[np.ndarray, "B N"], known: Bool[np.ndarray, "B N"], record: Mapping[str, Any]
) -> Float[np.ndarray, "B P"]:
    slot = np.asarray(record["pred_seg"]).argmax(1)
    first = 1 if bool(record.get("background", False)) else 0
    columns = []
    for part in range(np.asarray(record["pred_seg"]).shape[1]):
        here, there = known & (slot == part), known & (label == part + first)
        both, either = (here & there).sum(1), (here | there).sum(1)
        columns.append(np.divide(both, either, out=np.full(len(both), np.nan), where=either > 0))
    return np.stack(columns, 1)


def consensus(
    standard: Float[np.ndarray, "B P 4 4"], seed: int
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[float, float]]:
    """Best rotations and best translations of 100 draws of 5 samples, chosen independently."""
    # The published search draws from numpy's global generator after numpy.random.seed(seed).
    generator = np.random.RandomState(seed)
    standard = standard[np.isfinite(standard).all((1, 2, 3))]
    rotations, shifts = standard[..., :3, :3], standard[..., :3, 3]
    best_turn, best_shift = 0, 0
    turn, shift = np.zeros(rotations.shape[1:]), np.zeros(shifts.shape[1:])
    for _ in range(_DRAWS):
        chosen = generator.choice(len(standard), size=_SIZE, replace=False)
        mean_turn = project_rotations(rotations[chosen].sum(0))
        mean_shift = shifts[chosen].mean(0)
        near = (rotation_degrees(rotations, mean_turn) <= _ROTATION_INLIER).sum()
        close = (np.linalg.norm(shifts - mean_shift, axis=-1) <= _TRANSLATION_INLIER).sum()
        if near > best_turn:
            best_turn, turn = int(near), mean_turn
        if close > best_shift:
            best_shift, shift = int(close), mean_shift
    pairs = standard.shape[0] * standard.shape[1]
    return (turn, shift), (best_turn / pairs, best_shift / pairs)
