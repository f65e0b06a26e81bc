# SPDX-License-Identifier: MIT
"""A split in memory equals the split on disk."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from scapo.store import open_split
from scapo.store.files import read, sha256_file
from scapo.store.samples import SampleDataset, read_training_data
from scapo.store.schema import StoreError
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


@pytest.mark.parametrize("how", ["all", "batch", "shards"])
def test_a_flipped_bit_is_found_on_first_reading(tmp_path: Path, how: str) -> None:
    split = open_split(write_split(tmp_path / "laptop" / "train"))
    path = split.folder / split.manifest.shards[1].file
    data = bytearray(path.read_bytes())
    start = 8 + int.from_bytes(data[:8], "little")  # past the header: a coordinate changes a bit
    arrays, _ = read(path)
    offset = bytes(data).index(arrays["points"].tobytes(), start)
    data[offset] ^= 1
    path.write_bytes(bytes(data))
    assert (read(path)[0]["points"] != arrays["points"]).sum() == 1
    ways: dict[str, Callable[[], object]] = {
        "all": lambda: read_training_data(split),
        "batch": lambda: SampleDataset(split).batch(torch.tensor([3])),
        "shards": lambda: split.arrays("part"),
    }
    with pytest.raises(StoreError, match=r"00001.safetensors: expected sha256 \w+, found \w+"):
        ways[how]()


def test_a_shard_is_hashed_once_until_it_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = open_split(write_split(tmp_path / "laptop" / "train"))
    hashed: list[Path] = []

    def counted(path: Path) -> str:
        hashed.append(path)
        return sha256_file(path)

    monkeypatch.setattr("scapo.store.split.sha256_file", counted)
    for _ in range(3):
        read_training_data(split)
        split.arrays("points")
    assert len(hashed) == len(split.manifest.shards) == 3
    os.utime(hashed[0], ns=(1, 1))
    split.arrays("points")
    assert len(hashed) == 4


def test_batches_follow_the_index() -> None:
    data = tiny_data(6).to("cpu")
    index = torch.tensor([4, 1])
    observation, labels = data.batch(index)
    assert torch.equal(observation.points, data.observation.points[index])
    assert labels.part is not None
    assert data.labels.part is not None
    assert torch.equal(labels.part, data.labels.part[index])
