# SPDX-License-Identifier: MIT
"""A split in memory equals the split on disk."""

from __future__ import annotations

from pathlib import Path

import torch

from scapo.store import open_split
from scapo.store.samples import read_training_data
from tests.helpers.splits import write_split
from tests.helpers.tiny import tiny_data


def test_the_whole_split_is_read(tmp_path: Path) -> None:
    split = open_split(write_split(tmp_path / "laptop" / "train"))
    data = read_training_data(split)
    arrays = split.arrays("points", "part", "joint_axis")
    assert (data.observation.points.numpy() == arrays["points"]).all()
    assert data.labels.part is not None
    assert data.labels.joints is not None
    assert data.labels.part.min() == -1
    assert (data.labels.joints.axis.numpy() == arrays["joint_axis"]).all()
    assert data.digest == split.manifest.digest


def test_batches_follow_the_index() -> None:
    data = tiny_data(6).to("cpu")
    index = torch.tensor([4, 1])
    observation, labels = data.batch(index)
    assert torch.equal(observation.points, data.observation.points[index])
    assert labels.part is not None
    assert data.labels.part is not None
    assert torch.equal(labels.part, data.labels.part[index])
