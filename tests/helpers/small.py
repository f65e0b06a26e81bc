# SPDX-License-Identifier: MIT
"""Each method of the bench as a training of seconds; one that is not named here trains as it is."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.testing import assert_close

from scapo.method import AbstractMethod
from scapo.types import Observation
from tests.helpers.hinged import plates
from tests.helpers.splits import write_split

FLAGS: dict[str, list[str]] = {
    "scapo": [
        "--preset", "cpu", "--epochs", "1", "--batch", "4",
        "--encoder.centres", "16", "--encoder.neighbours", "6", "--encoder.width", "6",
        "--decoder.points", "64", "--decoder.widths", "16", "16", "8",
    ],
    "registered": [
        "--learned", "8", "--epochs", "1", "--points", "128", "--width", "8",
        "--grid-hypotheses", "4",
        "--discovery.seeds", "8", "--discovery.searched", "8", "--discovery.rotations", "200",
        "--discovery.starts", "1", "--discovery.draws", "1", "--discovery.judged", "2",
        "--discovery.finalists", "1", "--discovery.trusted", "0.9", "--discovery.heats", "0.8",
        "--discovery.no-mirror", "--discovery.no-leans", "--discovery.no-halves",
        "--discovery.dense-rounds", "1",
        "--discovery.template-points", "60", "--discovery.final-points", "80",
    ],
    "registered-labelled": [
        "--learned", "8", "--epochs", "1", "--points", "128", "--width", "8",
        "--grid-hypotheses", "4", "--discovery.rotations", "200", "--discovery.final-points", "80",
    ],
    "icp": ["--templates", "2", "--states", "1", "--part-points", "80", "--starts", "4"],
    "kiss-matcher": ["--templates", "2", "--states", "1", "--part-points", "80"],
    "npcs-epn": [
        "--preset", "cpu", "--epochs", "1", "--batch", "4", "--points", "64", "--draws", "20",
        "--network.widths", "4", "8", "--network.strides", "4", "2",
        "--network.radii", "0.3", "0.6",
        "--network.neighbours", "6", "6", "--network.frames", "2", "--network.code", "8",
        "--network.head", "16",
    ],
    "pointnet2": [
        "--preset", "cpu", "--epochs", "1", "--batch", "4",
        "--centres", "16", "4", "--whole-widths", "32", "32",
    ],
    "gcn3d": [
        "--preset", "cpu", "--epochs", "1", "--batch", "4",
        "--widths", "8", "8", "16", "16", "32", "--fuse", "32", "32",
    ],
    "eap": [
        "--preset", "cpu", "--epochs", "1", "1", "--batch", "4", "--points", "32",
        "--encoder.channels", "4", "8", "--encoder.radii", "0.2", "0.3",
        "--encoder.neighbours", "6", "--whole.width", "8", "--whole.points", "24",
        "--parts.width", "8", "--parts.points", "12", "--parts.rounds", "2",
    ],
    "op-align": [
        "--preset", "cpu", "--epochs", "1", "--batch", "4",
        "--backbone.channels", "4", "8", "--backbone.depth", "1", "1", "--backbone.points", "32",
        "--backbone.neighbours", "8", "--hypotheses.pooled", "8", "--hypotheses.width", "16",
        "--decoder.points", "48", "--decoder.width", "16", "--point-net.width", "8",
        "--point-net.blocks", "2", "--chosen-by", "32", "--no-color",
    ],
}  # fmt: skip


M = TypeVar("M", bound=torch.nn.Module)


def settle(module: M) -> M:
    """Make its running statistics those of the last batch, so that one is enough."""
    for one in module.modules():
        if isinstance(one, torch.nn.BatchNorm1d):
            one.momentum = 1.0
    return module


def assert_turns_with(
    method: AbstractMethod, points: Float[Tensor, "B N 3"], rotation: Float[Tensor, "3 3"]
) -> None:
    """What a method says of turned clouds is what it said, turned."""
    one = method.predict(Observation(points=points))
    other = method.predict(Observation(points=points @ rotation.mT))
    assert one.camera_T_part is not None
    assert other.camera_T_part is not None
    assert one.joints is not None
    assert other.joints is not None
    assert_close(other.part_weight, one.part_weight, atol=1e-4, rtol=0)
    turned = one.camera_T_part.clone()
    turned[..., :3, :] = rotation @ turned[..., :3, :]
    assert_close(other.camera_T_part, turned, atol=1e-3, rtol=0)
    assert_close(other.joints.pivot, one.joints.pivot @ rotation.mT, atol=1e-3, rtol=0)
    assert_close(other.joints.axis, one.joints.axis @ rotation.mT, atol=1e-3, rtol=0)
    assert_close(other.joints.state, one.joints.state, atol=1e-4, rtol=0)


POINTS = 160
"""Of each cloud."""


def hinged_data(
    folder: Path,
    *,
    train: int = 12,
    test: int = 5,
    points: int = POINTS,
    color: bool = False,
    wrong: bool = False,
) -> Path:
    """A train and a test split of two plates that turn, as laptops; colours come with sensors.

    `wrong`: labels of other clouds.
    """
    for split, count in (("train", train), ("test", test)):
        observation, labels = plates(count, points, seed=count)
        if wrong:
            _, labels = plates(count, points, seed=count + 100)
        assert labels.camera_T_part is not None
        assert labels.joints is not None
        assert labels.part is not None
        change = {
            "points": observation.points.numpy(),
            "part": labels.part.numpy().astype(np.uint8),
            "camera_T_part": labels.camera_T_part.numpy(),
            "joint_pivot": labels.joints.pivot.numpy(),
            "joint_axis": labels.joints.axis.numpy(),
            "joint_state": labels.joints.state.numpy(),
        }
        if color:
            shades = np.random.default_rng(0).integers(0, 256, observation.points.shape)
            shades[..., 2] = 255 * change["part"]  # blue tells the parts
            change["color"] = shades.astype(np.uint8)
            change["sensor"] = np.zeros((count, 3), np.float32)
        write_split(
            folder / "laptop" / split, split=split, counts=(count,), change=change, points=points
        )
    return folder
