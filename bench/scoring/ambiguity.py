# SPDX-License-Identifier: MIT
"""Scores against the best of the turns of the true object that look as it does.

Poses, joints, states and parts of a turn belong together: the truth of a sample is exchanged whole,
and the one whose parts are turned least from the prediction is taken (docs/ambiguity.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int

from bench.scoring.scores import Errors, Rows
from bench.scoring.truth import Truth
from scapo.geometry.rigid import joint_motion
from scapo.store import Split, StoreError
from scapo.store.files import tensor_names

Score = Callable[[Truth, Rows], Errors]


def check_alike(split: Split) -> None:
    """Refuse a split whose samples do not say which turns look alike.

    Raises:
        StoreError: Naming the shard that does not.
    """
    for shard in split.manifest.shards:
        path = split.folder / shard.file
        if "alike" not in tensor_names(path):
            raise StoreError(
                f"{path}: expected tensor 'alike' for --ambiguity on "
                "(scapo-data generate --ambiguity), found none"
            )


def score_best(truth: Truth, rows: Rows, score: Score, revolute: np.ndarray) -> Errors:
    """The errors of each sample against the truth or the turn of it that answers it best.

    Best is the smallest mean rotation error of the parts, or of the joint directions where no
    rotation is predicted; on ties the truth, then the first turn.

    Args:
        truth: Without `alike` there is the truth alone.
        rows: Predictions.
        score: What scores them.
        revolute: Which joints turn, (J,) bool.
    """
    best = score(truth, rows)
    if truth.alike is None:
        return best
    best = {name: values.copy() for name, values in best.items()}
    for turn in range(1, truth.alike.turns.shape[1]):
        members = np.flatnonzero(truth.alike.turns[:, turn])
        if not len(members):
            continue
        few = {name: values[members] for name, values in rows.items()}
        found = score(turned_truth(truth, members, turn, revolute), few)
        kept = {name: values[members] for name, values in best.items()}
        better = _turned_by(found) < _turned_by(kept)
        for name, values in found.items():
            best[name][members[better]] = values[better]
    return best


def _turned_by(errors: Errors) -> Float[np.ndarray, " B"]:
    """Degrees, of the slots with an answer; the same for all samples without any."""
    degrees = _mean_of_known(errors["part_rotation", "deg"])
    joints = _mean_of_known(errors["joint_direction", "deg"])
    return np.nan_to_num(np.where(np.isnan(degrees), joints, degrees), nan=np.inf)


def _mean_of_known(values: Float[np.ndarray, "B K"]) -> Float[np.ndarray, " B"]:
    known = ~np.isnan(values)
    count = known.sum(1)
    total = np.where(known, values, 0).sum(1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


def turned_truth(
    truth: Truth, members: Int[np.ndarray, " M"], turn: int, revolute: np.ndarray
) -> Truth:
    """The truth of some samples as it would be if the object stood turned.

    Raises:
        ValueError: The truth does not know the turns that look alike.
    """
    if truth.alike is None:
        raise ValueError("truth: expected the turns that look alike, found none")
    base = truth.alike.camera_T_base[members, turn]
    state, part = truth.alike.state[members, turn], truth.alike.part[members, turn]
    move, moved = truth.camera_T_part[members, 0], base[:, None]
    turned, shifted = np.swapaxes(move[:, :3, :3], 1, 2)[:, None], move[:, None, :3, 3]
    # Pivots and axes in the frame of the base, which they keep.
    pivot = _apply(turned, truth.joint_pivot[members] - shifted)
    axis = _apply(turned, truth.joint_axis[members])
    motions = [
        joint_motion(
            torch.from_numpy(pivot[:, j]),
            torch.from_numpy(axis[:, j]),
            torch.from_numpy(state[:, j]),
            "revolute" if turns else "prismatic",
        ).numpy()
        for j, turns in enumerate(revolute)
    ]
    label = truth.part[members]
    back = np.argsort(part, 1)  # the turned part in the place of each true one
    relabelled = np.take_along_axis(back, np.maximum(label, 0), 1)
    return replace(
        truth,
        points=truth.points[members],
        part=np.where(label < 0, label, relabelled).astype(label.dtype),
        camera_T_part=np.stack([base, *(base @ motion for motion in motions)], 1),
        joint_pivot=_apply(moved[..., :3, :3], pivot) + moved[..., :3, 3],
        joint_axis=_apply(moved[..., :3, :3], axis),
        joint_state=state,
        visible=np.take_along_axis(truth.visible[members], part, 1),
        instance=truth.instance[members],
        scale=truth.scale[members],
        alike=None,
    )


def _apply(
    turn: Float[np.ndarray, "M 1 3 3"], vectors: Float[np.ndarray, "M J 3"]
) -> Float[np.ndarray, "M J 3"]:
    return (turn @ vectors[..., None])[..., 0]
