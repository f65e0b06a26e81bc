# SPDX-License-Identifier: MIT
"""Supervised baselines small enough to train within a test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.baselines import gcn3d, pointnet2
from bench.baselines.answers import Target
from bench.baselines.supervised import SupervisedMethod
from bench.metrics import sample_errors
from scapo.categories import CATEGORIES
from scapo.method import AbstractMethod, Step
from scapo.types import Labels, Observation
from tests.helpers.strategies import generator

LEAN: dict[str, Any] = {
    "pointnet2": replace(
        pointnet2.cpu_config(),
        centres=(32, 8),
        near_samples=(4, 6, 8),
        near_widths=((8, 16), (16, 16), (16, 32)),
        far_samples=(4, 8),
        far_widths=((32, 32), (32, 64)),
        whole_widths=(64, 128),
        back_widths=((64,), (64,), (64,)),
    ),
    "gcn3d": replace(gcn3d.cpu_config(), neighbours=8, widths=(16, 16, 32, 32, 64), fuse=(64, 64)),
}
MAKERS: dict[str, Any] = {"pointnet2": pointnet2.PointNet2, "gcn3d": gcn3d.Gcn3d}
NAMES = tuple(MAKERS)


def lean(name: str, category: str = "laptop", **learning: Any) -> SupervisedMethod:
    """A network of some 50,000 parameters that sees its clouds as they are."""
    config = LEAN[name]
    still = {"points": None, "rotated": 0.0, "noisy": 0.0, "dropout": 0.0} | learning
    config = replace(config, learning=replace(config.learning, **still))
    return MAKERS[name](config, CATEGORIES[category], generator(0))


def a_step(seed: int = 0, count: int = 8) -> Step:
    return Step(
        stage="learn", progress=0.0, generator=generator(seed), index=torch.arange(count), total=8
    )


def target_of(observation: Observation, labels: Labels) -> tuple[Target, Tensor]:
    """Labels and points as they are."""
    assert labels.part is not None
    assert labels.camera_T_part is not None
    assert labels.joints is not None
    target = Target(
        part=labels.part,
        pose=labels.camera_T_part,
        pivot=labels.joints.pivot,
        axis=labels.joints.axis,
    )
    return target, observation.points


def errors_of(
    method: AbstractMethod, observation: Observation, labels: Labels
) -> dict[str, np.ndarray]:
    """Of predictions, as the benchmark measures them."""
    target, _ = target_of(observation, labels)
    prediction = method.predict(observation)
    assert prediction.camera_T_part is not None
    assert prediction.joints is not None
    return sample_errors(
        part_true=target.part.numpy(),
        camera_T_part_true=target.pose.numpy(),
        pivot_true=target.pivot.numpy(),
        axis_true=target.axis.numpy(),
        part_pred=prediction.part_weight.numpy(),
        camera_T_part_pred=prediction.camera_T_part.numpy(),
        pivot_pred=prediction.joints.pivot.numpy(),
        axis_pred=prediction.joints.axis.numpy(),
        symmetry=np.array(method.category.symmetry),
    )
