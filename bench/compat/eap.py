# SPDX-License-Identifier: MIT
"""EAP's readings: soft IoU with Hungarian matching, folded rotation, calibration per slot."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num

from bench.matching import project_rotations, rotation_degrees

DRAWS, SIZE = 100, 5


def eap_iou(
    pred_soft: Num[np.ndarray, "B K N"],
    gt_onehot: Num[np.ndarray, "B K N"],
    gt_conf: Num[np.ndarray, "B K"] | None = None,
) -> dict[str, np.ndarray]:
    """EAP's segmentation: soft IoU, slots matched one to one to true parts per sample.

    Args:
        pred_soft: Probability of each slot; there may be more slots than parts.
        gt_onehot: True parts in the first rows, the rest zero.
        gt_conf: 1 where the true part exists; by default where it has points.

    Returns:
        `mean_iou` (B,) over the true parts present, and the matching `match_gt`, `match_pred`
        (B, K): pairs by true part, zero-filled after the last.
    """
    pred, true = np.asarray(pred_soft, np.float64), np.asarray(gt_onehot, np.float64)
    present = true.sum(-1) > 0 if gt_conf is None else np.asarray(gt_conf) > 0
    shared = np.einsum("bgn,bkn->bgk", true, pred)
    union = true.sum(-1)[:, :, None] + pred.sum(-1)[:, None, :] - shared
    iou = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    batch, slots = pred.shape[0], pred.shape[1]
    out = {
        "mean_iou": np.full(batch, np.nan),
        "match_gt": np.zeros((batch, slots), np.int64),
        "match_pred": np.zeros((batch, slots), np.int64),
    }
    for b in range(batch):
        rows = np.flatnonzero(present[b])
        if len(rows) == 0:
            continue
        columns = _match(iou[b, rows])
        out["mean_iou"][b] = iou[b, rows, columns].mean()
        out["match_gt"][b, : len(rows)] = rows
        out["match_pred"][b, : len(rows)] = columns
    return out


def _match(iou: Float[np.ndarray, "G K"]) -> Int[np.ndarray, " G"]:
    """The slot of each true part with the largest sum of IoU."""
    parts, slots = iou.shape
    if slots > 7:
        from scipy.optimize import linear_sum_assignment

        return linear_sum_assignment(-iou)[1]
    orders = np.array(list(permutations(range(slots), parts)))
    return orders[iou[np.arange(parts), orders].sum(-1).argmax()]


def eap_rotation(
    a: Num[np.ndarray, "*B 3 3"], b: Num[np.ndarray, "*B 3 3"]
) -> dict[str, np.ndarray]:
    """`deg`: angle between two rotations; `deg_symmetric`: folded to min(e, 180 - e)."""
    angle = rotation_degrees(np.asarray(a, np.float64), np.asarray(b, np.float64))
    return {"deg": angle, "deg_symmetric": np.minimum(angle, 180 - angle)}


def eap_calibration(
    rotations: Num[np.ndarray, "B 3 3"] | None = None,
    translations: Num[np.ndarray, "B 3"] | None = None,
    *,
    rotation_seed: int = 3,
    translation_seed: int = 4,
    inlier_degrees: float = 20.0,
    inlier_distance: float = 0.025,
) -> dict[str, Any]:
    """EAP's canonical pose of one slot from training shapes in the reference articulation.

    Rotation: every draw takes all samples, so it is their chordal mean, whatever the seed.
    Translation: the mean of the best of 100 draws of 5, then of its inliers where these are more.

    Returns:
        `rot` (3,3) and `rot_score`, the share of samples within `inlier_degrees`; `trans` (3,)
        and `trans_score`; each where its input is given.
    """
    del rotation_seed  # the mean does not depend on it; named because the published search draws
    out: dict[str, Any] = {}
    if rotations is not None:
        turns = np.asarray(rotations, np.float64)
        mean = project_rotations(turns.sum(0))
        out["rot"] = mean
        out["rot_score"] = float((rotation_degrees(mean, turns) < inlier_degrees).mean())
    if translations is not None:
        shifts = np.asarray(translations, np.float64)
        out["trans"], out["trans_score"] = _eap_shift(shifts, translation_seed, inlier_distance)
    return out


def _eap_shift(
    shifts: Float[np.ndarray, "B 3"], seed: int, limit: float
) -> tuple[Float[np.ndarray, " 3"], float]:
    generator = np.random.RandomState(seed)  # the published stream of numbers
    size = min(SIZE, len(shifts))
    best, found, inliers = 0.0, np.full(3, np.nan), np.zeros(len(shifts), bool)
    for _ in range(DRAWS):
        keys = generator.rand(1, len(shifts))
        chosen = np.argpartition(keys, size - 1, axis=-1)[0, :size]
        mean = shifts[chosen].mean(0)
        close = np.linalg.norm(shifts - mean, axis=-1) < limit
        if close.mean() > best:
            best, found, inliers = float(close.mean()), mean, close
    if inliers.any():
        mean = shifts[inliers].mean(0)
        share = float((np.linalg.norm(shifts - mean, axis=-1) < limit).mean())
        if share > best:
            best, found = share, mean
    return found, best
