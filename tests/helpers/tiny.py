# SPDX-License-Identifier: MIT
"""A SCAPO small enough to train within a test."""

from __future__ import annotations

from dataclasses import replace

from scapo.categories import CATEGORIES
from scapo.paper.autoencoder import DecoderConfig, EncoderConfig
from scapo.paper.config import ScapoConfig, cpu_config
from scapo.paper.heads import HeadConfig, JointConfig
from scapo.paper.method import Scapo
from scapo.store.samples import TrainingData
from tests.helpers.hinged import plates
from tests.helpers.strategies import generator

TINY = replace(
    cpu_config(),
    encoder=EncoderConfig(
        neighbours=6, centres=16, pool=64, width=6, branch=(8, 12, 8, 6), features=6
    ),
    decoder=DecoderConfig(patches=2, points=64, widths=(16, 16, 8)),
    joint=JointConfig(width=8, blocks=2, head=(8, 8), points=32),
    heads=HeadConfig(keypoint=(8, 8, 8), residual=(8, 8)),
    epochs=(2, 2),
    batch=8,
)


def tiny(seed: int = 0, config: ScapoConfig = TINY, category: str = "laptop") -> Scapo:
    """A model with drawn weights."""
    return Scapo(config, CATEGORIES[category], generator(seed))


def tiny_data(count: int = 24, points: int = 96) -> TrainingData:
    """Clouds of two plates."""
    observation, labels = plates(count, points)
    return TrainingData(observation=observation, labels=labels, digest="plates")
