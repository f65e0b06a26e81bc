# SPDX-License-Identifier: MIT
"""A split on disk as a `torch.utils.data.Dataset` and as batched `Observation` and `Labels`.

A split held in memory on the training device, batched by index there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import SupportsIndex

import numpy as np
import torch
from jaxtyping import Int
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from scapo.records import map_tensors, take
from scapo.store.files import SAMPLES, Arrays, read_header, require, tensor_names
from scapo.store.manifest import read_manifest
from scapo.store.schema import (
    LAYOUT,
    OPTIONAL,
    TENSORS,
    UNLABELLED,
    StoreError,
    check_samples,
)
from scapo.store.split import Split, check_bytes, open_split
from scapo.types import Joints, Labels, Observation, Supervision


class SampleDataset(Dataset[dict[str, Tensor]]):
    """Samples of one split; an item is a dict of tensors that `default_collate` stacks.

    Names and shapes are those on disk without the leading sample dimension; `part`
    is int64 with -1 for background, `index` the position in the split. Shards are memory-mapped
    and opened in the process that reads them, so the object pickles into DataLoader workers; a
    whole batch is fetched at once (`__getitems__`), one read per shard it touches.
    """

    def __init__(self, split: Split, names: Sequence[str] = TENSORS) -> None:
        """See `scapo.store.split.dataset`."""
        self.split = split
        self.names = tuple(names)
        counts = [shard.count for shard in split.manifest.shards]
        self._ends = np.cumsum(counts)
        self._open: dict[int, Arrays] = {}

    def __len__(self) -> int:
        """Number of samples."""
        return self.split.manifest.count

    def __getstate__(self) -> dict[str, object]:
        """Without the open memory maps: a worker opens its own."""
        return {**self.__dict__, "_open": {}}

    def __getitem__(self, index: SupportsIndex) -> dict[str, Tensor]:
        """Sample `index`; negative counts from the end."""
        return self.__getitems__([int(index)])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Tensor]]:
        """Several samples: the call that DataLoader makes for a batch."""
        batch = self.batch(torch.as_tensor(indices, dtype=torch.long))
        return [{name: tensor[i] for name, tensor in batch.items()} for i in range(len(indices))]

    def batch(self, indices: Int[Tensor, " K"]) -> dict[str, Tensor]:
        """The samples of `indices` stacked, in that order; negative ones count from the end.

        Raises:
            IndexError: There is no such sample.
            StoreError: A shard is not what the manifest and the layout say.
        """
        index = self._inside(indices)
        shard_of = np.searchsorted(self._ends, index, side="right")
        shards = np.unique(shard_of)
        for shard in shards:  # first, so that room is made for what is there alone
            self._shard(int(shard))
        out = {name: self._room(name, len(index)) for name in self.names}
        for shard in shards:
            rows = np.flatnonzero(shard_of == shard)
            local = index[rows] - self.split.manifest.shards[shard].first
            # numpy copies in this thread; torch would wake its others for each small tensor.
            for name, array in self._shard(int(shard)).items():
                out[name][rows] = array[local]
        batch = {name: torch.from_numpy(array) for name, array in out.items()}
        if "part" in batch:
            part = batch["part"].long()
            batch["part"] = torch.where(part == UNLABELLED, -1, part)
        batch["index"] = torch.from_numpy(index)
        return batch

    def _room(self, name: str, count: int) -> np.ndarray:
        """Zeros for `count` samples of a tensor; one that the layout lacks is as in shard 0."""
        if name in LAYOUT:
            return np.zeros(self.split.shapes(count)[name], LAYOUT[name][0])
        if not self.split.manifest.shards:
            return np.zeros(count, np.float32)
        like = self._shard(0)[name]
        return np.zeros((count, *like.shape[1:]), like.dtype)

    def _inside(self, indices: Tensor) -> np.ndarray:
        """The indices from 0 on."""
        index = indices.cpu().numpy().astype(np.int64)
        outside = index[(index < -len(self)) | (index >= len(self))]
        if outside.size:
            raise IndexError(
                f"{self.split.folder}: expected a sample below {len(self)}, found {outside[0]}"
            )
        return np.where(index < 0, index + len(self), index)

    def _shard(self, number: int) -> Arrays:
        """A shard's memory map, checked once per process."""
        if number not in self._open:
            shard = self.split.manifest.shards[number]
            path = self.split.folder / shard.file
            self.split.check_header(path, read_header(path, SAMPLES))
            try:
                with safe_open(path, "pt") as file:  # the numpy reader copies
                    require(path, self.names, file.keys())
                    arrays = {name: file.get_tensor(name).numpy() for name in self.names}
            except (SafetensorError, TypeError, OSError) as error:
                raise StoreError(
                    f"{path}: expected numpy-readable tensors, found {error}"
                ) from error
            check_samples(path, arrays, self.split.manifest, shard.first, shard.count)
            check_bytes(path, shard.sha256)
            self._open[number] = arrays
        return self._open[number]


def dataset(
    folder: Path | str,
    category: str | None = None,
    split: str | None = None,
    names: Sequence[str] = TENSORS,
) -> SampleDataset:
    """The samples below `folder`: a data set, a category's or a split's folder.

    Without a name, of the split whose folder it is, or else of train.

    Raises:
        StoreError: No such split, or more than one fits; a broken manifest.
    """
    manifest = Path(folder) / "manifest.json"
    if split is None:
        split = read_manifest(manifest).split if manifest.is_file() else "train"
    return SampleDataset(open_split(folder, category, split), names)


def observed(split: Split) -> tuple[str, ...]:
    """The names of all that a split has for methods: colours and camera centres where it has them.

    Raises:
        StoreError: Its first shard cannot be read.
    """
    if not split.manifest.shards:
        return TENSORS
    there = tensor_names(split.folder / split.manifest.shards[0].file)
    return (*TENSORS, *(name for name in OPTIONAL if name in there))


def observe(batch: dict[str, Tensor]) -> Observation:
    """What a method may see of a batch, as far as it is there (`observed`)."""
    color = batch.get("color")
    return Observation(
        points=batch["points"],
        color=None if color is None else color.float() / 255,
        sensor=batch.get("sensor"),
    )


def label(batch: dict[str, Tensor]) -> Labels:
    """The ground truth of a batch, camera frame."""
    return Labels(
        part=batch["part"],
        camera_T_part=batch["camera_T_part"],
        joints=Joints(
            pivot=batch["joint_pivot"], axis=batch["joint_axis"], state=batch["joint_state"]
        ),
        instance=batch["instance"],
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingData:
    """A training split in memory."""

    observation: Observation
    labels: Labels
    """Only what the method's supervision allows is handed on."""
    digest: str
    """Of the manifest."""
    validation: TrainingData | None = None
    """Clouds that are not trained on."""

    def keep(self, supervision: frozenset[Supervision]) -> TrainingData:
        """With the labels that a method with this supervision may see."""
        below = None if self.validation is None else self.validation.keep(supervision)
        return replace(self, labels=self.labels.keep(supervision), validation=below)

    def to(self, device: str) -> TrainingData:
        """On the device."""
        return map_tensors(self, lambda tensor: tensor.to(device))

    def batch(self, index: Tensor) -> tuple[Observation, Labels]:
        """The samples of `index`."""
        return take((self.observation, self.labels), index)

    def held_out(self) -> TrainingData:
        """Every tenth object with all its clouds for validation, the others for training.

        Every tenth cloud where it is not known which object a cloud shows.

        Raises:
            ValueError: Nothing would be left.
        """
        count = self.observation.points.shape[0]
        instance = self.labels.instance
        number = torch.arange(count) if instance is None else instance
        which = number.unique(return_inverse=True)[1].to(self.observation.points.device)
        out = which % HELD_OUT == 0
        if bool(out.all()):
            raise ValueError("training data: expected an object to train on, and one to hold out")
        return replace(take(self, ~out), validation=take(self, out))


HELD_OUT = 10
"""Of so many training objects one is for validation, where there is no split for it."""


def read_training_data(split: Split) -> TrainingData:
    """The whole split on the host.

    Raises:
        StoreError: A shard is missing or not as the manifest says.
    """
    samples = SampleDataset(split, observed(split))
    batch = samples.batch(torch.arange(len(samples)))
    return TrainingData(
        observation=observe(batch),
        labels=label(batch),
        digest=split.manifest.digest,
    )
