# SPDX-License-Identifier: MIT
"""The frames of a method that saw no poses, fitted on its predictions of the training split.

One rigid offset per part and one offset per joint state (docs/protocol.md), lengths in units of
4 x the mean radius of each cloud. Truth is ordered and symmetry-corrected first, as in scoring.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bench.matching import Calibration, accuracies, calibrate, reorder_joints, reorder_poses
from bench.scoring.scores import Frames, Rows, Settings, agreement_of, label_of, signs
from bench.scoring.truth import Truth, blocks
from scapo.geometry.part_order import confusion, hard_labels, part_orders
from scapo.store import Split, StoreError
from scapo.store.predictions import Header, Predictions

CALIBRATION_SPLIT = "train"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fitted:
    """What the training predictions said of a method's frames."""

    poses: Calibration | None
    """None where the method gives no poses."""
    state_offset: Float[np.ndarray, " J"] | None
    """Radians, or r4 for a prismatic joint; None where it gives no states."""
    state_count: tuple[int, ...]
    """Samples behind each state offset."""
    order: Int[np.ndarray, " P"] | None
    """The one part order of the data set, where asked for."""
    samples: int

    def record(self) -> dict[str, Any]:
        """For JSON, NaN as null."""
        out: dict[str, Any] = {"samples": self.samples, "split": CALIBRATION_SPLIT}
        if self.poses is not None:
            out |= {
                "seed": self.poses.seed,
                "own_T_part": _plain(self.poses.offsets),
                "rotation_inlier_ratio": _plain(self.poses.rotation_inliers),
                "translation_inlier_ratio": _plain(self.poses.translation_inliers),
                "answered": self.poses.answered.tolist(),
            }
        if self.state_offset is not None:
            out |= {
                "state_offset": _plain(self.state_offset),
                "state_answered": list(self.state_count),
            }
        return out


def _plain(values: np.ndarray) -> Any:  # noqa: ANN401
    """Nested lists, NaN as None."""
    if values.ndim > 1:
        return [_plain(value) for value in values]
    return [value if value == value else None for value in values.tolist()]


def check_calibration(path: Path, header: Header, tested: Header) -> None:
    """Refuse predictions that must not calibrate these.

    Raises:
        StoreError: Of the split that is scored, or of another method, variant, seed or category.
    """
    if header.split != CALIBRATION_SPLIT:
        raise StoreError(
            f"{path}: expected predictions on the split {CALIBRATION_SPLIT!r} for calibration, "
            f"found split {header.split!r}"
        )
    if header.data_digest == tested.data_digest:
        raise StoreError(
            f"{path}: expected for calibration other clouds than those that are scored, found the "
            f"same data (digest {header.data_digest})"
        )
    for name in ("method", "variant", "seed", "category"):
        want, have = getattr(tested, name), getattr(header, name)
        if want != have:
            raise StoreError(
                f"{path}: header field {name!r}: expected {want!r} as in the "
                f"predictions to be scored, found {have!r}"
            )
    if header.object_frame != tested.object_frame:
        raise StoreError(
            f"{path}: header field 'object_frame': expected "
            f"{_frame(tested)} as in the predictions to be scored, found {_frame(header)}"
        )


def _frame(header: Header) -> str:
    frame = header.object_frame
    if frame is None:
        return "none (the method's own frames)"
    return f"that of {frame.samples} clouds of {frame.split!r} {frame.data_digest[:12]}"


def fit(path: Path, split: Split, *, settings: Settings, frames: Frames, seed: int = 0) -> Fitted:
    """Fit offsets on the predictions `path` of the training split.

    Raises:
        StoreError: The file is not valid or not of this split.
    """
    gathered = Gathered(frames, settings)
    with Predictions(path, split) as predictions:
        order = None
        if settings.label_order == "dataset":
            order = dataset_order(predictions, split)
        for truth in blocks(split):
            gathered.add(truth, predictions.rows(truth.first, len(truth)), order)
        predictions.finish()
    poses, offset, count = gathered.fitted(seed)
    return Fitted(
        poses=poses,
        state_offset=offset,
        state_count=count,
        order=order,
        samples=split.manifest.count,
    )


class Gathered:
    """Poses and state residuals of labelled clouds, a few numbers per sample, and what they say."""

    def __init__(self, frames: Frames, settings: Settings) -> None:
        """Nothing yet; truth is ordered and symmetry-corrected as these say."""
        self.frames, self.settings = frames, settings
        self.pred: list[np.ndarray] = []
        self.true: list[np.ndarray] = []
        self.scale: list[np.ndarray] = []
        self.residual: list[np.ndarray] = []
        self.sign: list[np.ndarray] = []
        """Of the axes of joints with states, `metrics.state_sign`."""

    def add(self, truth: Truth, rows: Rows, order: Int[np.ndarray, " P"] | None) -> None:
        """Answers to some clouds; `order` is the one of the whole data set where it is fixed."""
        frames = self.frames
        agreement = agreement_of(truth, rows, self.settings, order)
        if "camera_T_part" in rows:
            self.pred.append(rows["camera_T_part"].astype(np.float64))
            self.true.append(reorder_poses(truth.camera_T_part, agreement.order, frames.symmetry))
            self.scale.append(truth.scale)
        if "joint_state" in rows:
            axis = reorder_joints(truth.joint_axis, agreement.order)
            state = reorder_joints(truth.joint_state, agreement.order)
            unit = np.where(frames.revolute, 1.0, truth.scale[:, None])
            self.sign.append(signs(rows, agreement.order, axis))
            self.residual.append((state - self.sign[-1] * rows["joint_state"]) / unit)

    def fitted(
        self, seed: int = 0
    ) -> tuple[Calibration | None, Float[np.ndarray, " J"] | None, tuple[int, ...]]:
        """Offsets of part frames and of states, None without answers; clouds behind the latter."""
        poses, offset, count = None, None, ()
        if self.pred:
            pred, true, scale = map(np.concatenate, (self.pred, self.true, self.scale))
            poses = calibrate(pred, true, scale=scale, seed=seed)
        if self.residual:
            offset, count = _state_offsets(np.concatenate(self.residual), self.frames.revolute)
        return poses, offset, count


def _state_offsets(
    residual: Float[np.ndarray, "B J"], revolute: np.ndarray
) -> tuple[Float[np.ndarray, " J"], tuple[int, ...]]:
    """Circular mean of theta - s phi, or mean for a prismatic joint; NaN without an answer."""
    offsets, counts = [], []
    for joint in range(residual.shape[1]):
        values = residual[:, joint]
        values = values[np.isfinite(values)]
        counts.append(len(values))
        if len(values) == 0:
            offsets.append(np.nan)
        elif revolute[joint]:
            offsets.append(float(np.arctan2(np.sin(values).mean(), np.cos(values).mean())))
        else:
            offsets.append(float(values.mean()))
    return np.array(offsets), tuple(counts)


def dataset_order(predictions: Predictions, split: Split) -> Int[np.ndarray, " P"]:
    """The one order with the highest mean accuracy over the whole split."""
    parts = len(split.manifest.parts)
    orders = part_orders(parts)
    total = np.zeros(len(orders))
    for truth in blocks(split):
        rows = predictions.rows(truth.first, len(truth))
        counts = confusion(truth.part, hard_labels(label_of(rows)), parts)
        total += accuracies(counts, orders).sum(0)
    predictions.unanswered.clear()
    return orders[total.argmax()]
