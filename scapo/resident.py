# SPDX-License-Identifier: MIT
"""A split held in memory on the training device, batched by index there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from scapo.data import SampleDataset, label, observe
from scapo.store import Split
from scapo.types import Joints, Labels, Observation


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingData:
    """A training split in memory."""

    observation: Observation
    labels: Labels
    """Only what the method's supervision allows is handed on."""
    digest: str
    """Of the manifest."""

    def to(self, device: str) -> TrainingData:
        """On the device."""
        return TrainingData(
            observation=Observation(points=self.observation.points.to(device)),
            labels=map_labels(self.labels, lambda tensor: tensor.to(device)),
            digest=self.digest,
        )

    def batch(self, index: Tensor) -> tuple[Observation, Labels]:
        """The samples of `index`."""
        points = self.observation.points[index]
        return Observation(points=points), map_labels(self.labels, lambda tensor: tensor[index])


def map_labels(labels: Labels, change: Callable[[Tensor], Tensor]) -> Labels:
    """Labels with every tensor that is there changed."""
    joints = labels.joints
    return Labels(
        part=None if labels.part is None else change(labels.part),
        camera_T_part=None if labels.camera_T_part is None else change(labels.camera_T_part),
        joints=None
        if joints is None
        else Joints(
            pivot=change(joints.pivot), axis=change(joints.axis), state=change(joints.state)
        ),
    )


def read_training_data(split: Split) -> TrainingData:
    """The whole split on the host.

    Raises:
        StoreError: A shard is missing or not as the manifest says.
    """
    samples = SampleDataset(split)
    batch = samples.batch(torch.arange(len(samples)))
    return TrainingData(
        observation=observe(batch), labels=label(batch), digest=split.manifest.digest
    )
