# SPDX-License-Identifier: MIT
"""`--geometry opalign-compat`: the published OP-Align evaluator on the files of this project.

The record is in the network's frame: x_net = (x - record_center) * record_expand, by default the
cloud's centroid and 0.25 / mean radius (docs/protocol.md).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.compat.chain import Chain
from bench.compat.readings import consensus, score_record, standardise
from bench.matching import as_weights
from bench.scoring.scores import Errors, Frames, Rows, label_of
from bench.scoring.truth import Truth, blocks
from scapo.store import Split, StoreError
from scapo.store.predictions import RECORD, Predictions

RELEASED = Chain(revolute=True, corrected=False)
RANSAC_SEED = 1234

Canon = tuple[np.ndarray, np.ndarray]


def check_record(path: Path, names: tuple[str, ...]) -> None:
    """Refuse a file without the network-side quantities.

    Raises:
        StoreError: Naming those that are missing.
    """
    missing = [f"record_{name}" for name in RECORD if f"record_{name}" not in names]
    if missing:
        raise StoreError(
            f"{path}: expected the tensors {', '.join(missing)} for "
            "--geometry opalign-compat, found none"
        )


def record_of(truth: Truth, rows: Rows, frames: Frames) -> dict[str, Any]:
    """The fixture-shaped record of some samples."""
    parts = truth.camera_T_part.shape[1]
    expand = np.asarray(rows.get("record_expand", 1 / truth.scale), np.float64)
    center = np.asarray(rows.get("record_center", truth.points.mean(1)), np.float64)
    pose = truth.camera_T_part.copy()
    pose[..., :3, 3] = (pose[..., :3, 3] - center[:, None]) * expand[:, None, None]
    pivot = (truth.joint_pivot - center[:, None]) * expand[:, None, None]
    slots = label_of(rows)
    weight = slots if slots.ndim == 3 else as_weights(slots, parts)
    weight = weight[..., list(frames.order)] if frames.order else weight  # as the record has them
    return {
        **{name: rows[f"record_{name}"] for name in RECORD},
        "gt_pose": pose,
        "gt_joint": np.concatenate([pivot, truth.joint_axis], -1),
        "gt_seg": truth.part.astype(np.int64) + 1,
        "pred_seg": np.moveaxis(np.asarray(weight, np.float64), -1, 1),
        "background": True,
        "expand": expand,
        "symmetry": frames.symmetry,
    }


def fit_canon(path: Path, split: Split, frames: Frames) -> tuple[Canon, dict[str, Any]]:
    """Canonical part poses by the published search over training predictions, and its facts.

    Raises:
        StoreError: The file is not valid, or has no record.
    """
    standard = []
    with Predictions(path, split) as predictions:
        check_record(path, predictions.names)
        for truth in blocks(split):
            rows = predictions.rows(truth.first, len(truth))
            standard.append(standardise(record_of(truth, rows, frames), RELEASED))
        predictions.finish()
    poses = np.concatenate(standard)
    usable = int(np.isfinite(poses).all((1, 2, 3)).sum())
    if usable < 5:
        raise StoreError(f"{path}: expected 5 or more samples with a record, found {usable}")
    canon, ratios = consensus(poses, RANSAC_SEED)
    return canon, {
        "seed": RANSAC_SEED,
        "samples": len(poses),
        "rotation_inlier_ratio": ratios[0],
        "translation_inlier_ratio": ratios[1],
        "canon_rot": canon[0].tolist(),
        "canon_trans": canon[1].tolist(),
    }


def score_compat(truth: Truth, rows: Rows, canon: Canon, frames: Frames) -> Errors:
    """The published errors of some samples, lengths brought back to metres and to r4."""
    out = score_record(record_of(truth, rows, frames), canon, RELEASED)
    unit = truth.scale[:, None]
    return {
        ("iou", "1"): out["iou"],
        ("joint_direction", "deg"): out["dir_err_deg"],
        ("joint_pivot", "r4"): out["pivot_err"] / unit,
        ("joint_pivot", "m"): out["pivot_err"],
        ("part_rotation", "deg"): out["rot_err_deg"],
        ("part_translation", "r4"): out["trans_err"] / unit,
        ("part_translation", "m"): out["trans_err"],
    }
