# SPDX-License-Identifier: MIT
"""Two answers that are no method, as predictions files: the floor and a ceiling of every table.

`constant` gives every cloud the same answer, learned from the training labels: each point is the
most frequent part, poses, joints and states are the training means, placed at the cloud's centroid
and scaled by its mean radius. `oracle-pose` is told the true pose of the base and nothing else: the
same means, taken in the object frame, and the label of the nearest training point there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from bench.matching import project_rotations
from bench.requests import Kind
from bench.scoring.truth import Truth, blocks, revolute
from scapo.geometry import rigid as geometry
from scapo.store import Arrays, Split, open_split
from scapo.store.definitions import foreign, known_category
from scapo.store.files import require_suffix
from scapo.store.predictions import Header, write_predictions

RECIPE = "scapo-reference/2"
"""To be changed with what the references answer: scores of another recipe are made again."""
TRAINED_ON = ("clean", "sensor")
"""Parts of a benchmark whose training split serves where a part has none, such as `real`."""
TEMPLATE_CLOUDS = 50
"""Training clouds whose labelled points, in the object frame, vote for labels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Means:
    """Training means in the frame of each cloud (`constant`) or of each object; lengths in r4."""

    pose: Float[np.ndarray, "P 4 4"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    state: Float[np.ndarray, " J"]
    """Radians, or r4."""
    frequent: int
    """The part with the most points."""
    points: Float[np.ndarray, "K 3"]
    label: Int[np.ndarray, " K"]


def write_reference(
    kind: Kind, data: Path, category: str, out: Path, *, split: str = "test"
) -> None:
    """Write the predictions file of a reference for a split, learned on the split `train`.

    Raises:
        StoreError: No such data, or a file of another suffix to write.
    """
    require_suffix(out, ".safetensors")
    test = open_split(data, category, split)
    train = training_split(test) or open_split(data, category, "train")
    write_answers(kind, train, test, out)


def training_split(split: Split) -> Split | None:
    """The split `train` of the same part and category, else of a part in `TRAINED_ON`."""
    category, name = split.folder.resolve().parent, split.manifest.category
    parts = [category.parent.parent / part / name for part in TRAINED_ON]
    for folder in (category, *parts):
        if (folder / "train" / "manifest.json").is_file():
            found = Split(folder / "train")
            if found.manifest.category == name and found.manifest.parts == split.manifest.parts:
                return found
    return None


def write_answers(kind: Kind, train: Split, test: Split, out: Path) -> None:
    """Write the predictions file of a reference for the split `test`, learned on `train`."""
    turns = revolute(test.manifest)
    means = learn(kind, train)
    parts = [_answer(kind, truth, means, turns) for truth in blocks(test)]
    arrays: Arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    known = known_category(test.manifest)
    header = Header(
        method=kind, variant="", category=test.manifest.category, split=test.manifest.split,
        seed=0, data_digest=test.manifest.digest, supervision=("joint", "pose", "segmentation"),
        camera=False,
        budget={"training clouds": train.manifest.count, "training": "means of the labels"},
        run={"data_digest": train.manifest.digest, "recipe": RECIPE},
        definition=None if known is None else foreign(known),
    )  # fmt: skip
    write_predictions(out, header, arrays)


def frames(kind: Kind, truth: Truth) -> Float[np.ndarray, "B 4 4"]:
    """camera_T_frame of the frame in which means are taken: the cloud's, or the true base's."""
    if kind == "oracle-pose":
        return truth.camera_T_part[:, 0]
    frame = np.tile(np.eye(4), (len(truth), 1, 1))
    frame[:, :3, 3] = truth.points.mean(1)
    return frame


def learn(kind: Kind, split: Split) -> Means:
    """Means of the training labels."""
    poses, pivots, axes, states, points, labels = [], [], [], [], [], []
    count = np.zeros(len(split.manifest.parts), np.int64)
    turns = revolute(split.manifest)
    for truth in blocks(split):
        inverse = geometry.invert(torch.from_numpy(frames(kind, truth))).numpy()
        unit = truth.scale[:, None, None]
        pose = inverse[:, None] @ truth.camera_T_part
        pose[..., :3, 3] /= unit
        poses.append(pose)
        rotation, shift = inverse[:, :3, :3], inverse[:, None, :3, 3]
        pivots.append((truth.joint_pivot @ np.swapaxes(rotation, 1, 2) + shift) / unit)
        axes.append(truth.joint_axis @ np.swapaxes(rotation, 1, 2))
        states.append(truth.joint_state / np.where(turns, 1.0, truth.scale[:, None]))
        count += [(truth.part == part).sum() for part in range(len(count))]
        for i in range(min(len(truth), max(0, TEMPLATE_CLOUDS - len(points)))):
            own = (truth.points[i] @ rotation[i].T + shift[i]) / truth.scale[i]
            points.append(own[truth.part[i] >= 0])
            labels.append(truth.part[i][truth.part[i] >= 0])
    mean_pose = np.concatenate(poses).mean(0)
    mean_pose[:, :3, :3] = project_rotations(mean_pose[:, :3, :3])
    axis = _main_direction(np.concatenate(axes))
    pivot = _closest_points(np.concatenate(pivots), np.concatenate(axes), axis)
    return Means(
        pose=mean_pose, pivot=pivot, axis=axis, state=_mean_known(np.concatenate(states)),
        frequent=int(count.argmax()), points=np.concatenate(points),
        label=np.concatenate(labels).astype(np.int64),
    )  # fmt: skip


def _mean_known(states: Float[np.ndarray, "B J"]) -> Float[np.ndarray, " J"]:
    """The mean of each joint's known states; NaN where none is, as in many sets of others."""
    known = ~np.isnan(states)
    total = np.where(known, states, 0.0).sum(0)
    return np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.nan)


def _main_direction(axes: Float[np.ndarray, "B J 3"]) -> Float[np.ndarray, "J 3"]:
    """The line closest to all axes, pointing as most of them do."""
    _, vectors = np.linalg.eigh(np.einsum("bji,bjk->jik", axes, axes))
    main = vectors[..., -1]
    sign = np.sign((axes * main).sum(-1).mean(0))
    return main * np.where(sign == 0, 1, sign)[:, None]


def _closest_points(
    pivots: Float[np.ndarray, "B J 3"],
    axes: Float[np.ndarray, "B J 3"],
    axis: Float[np.ndarray, "J 3"],
) -> Float[np.ndarray, "J 3"]:
    """The point with the least sum of squared distances to all true axes.

    A pivot may lie anywhere on its axis, so its plain mean would depend on that choice. Along the
    mean axis, where parallel axes leave it free, the mean pivot decides.
    """
    across = np.eye(3) - axes[..., :, None] * axes[..., None, :]
    along = 1e-3 * axis[:, :, None] * axis[:, None, :]
    matrix = across.mean(0) + along
    right = (across @ pivots[..., None]).mean(0) + along @ pivots.mean(0)[..., None]
    return np.linalg.solve(matrix, right)[..., 0]


def _answer(kind: Kind, truth: Truth, means: Means, turns: np.ndarray) -> Arrays:
    """The predictions of some samples."""
    frame, unit = frames(kind, truth), truth.scale[:, None, None]
    pose = np.broadcast_to(means.pose, (len(truth), *means.pose.shape)).copy()
    pose[..., :3, 3] *= unit
    rotation = np.swapaxes(frame[:, :3, :3], 1, 2)
    pivot = means.pivot * unit @ rotation + frame[:, None, :3, 3]
    state = np.where(turns, means.state, means.state * truth.scale[:, None])
    if kind == "constant":
        label = np.full(truth.part.shape, means.frequent)
    else:
        tree = KDTree(means.points)
        inverse = geometry.invert(torch.from_numpy(frame)).numpy()
        own = truth.points @ np.swapaxes(inverse[:, :3, :3], 1, 2) + inverse[:, None, :3, 3]
        label = means.label[tree.query(own / unit)[1]]
    return {
        "part": label.astype(np.uint8),
        "camera_T_part": (frame[:, None] @ pose).astype(np.float32),
        "joint_pivot": pivot.astype(np.float32),
        "joint_axis": (means.axis @ rotation).astype(np.float32),
        "joint_state": state.astype(np.float32),
    }
