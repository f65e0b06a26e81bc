# SPDX-License-Identifier: MIT
"""Pictures of a training in progress: the same few clouds each time, where they can be drawn."""

from __future__ import annotations

import importlib.util

import torch

from scapo.log import Log
from scapo.method import AbstractMethod
from scapo.types import Observation

SHOWN = 6
"""Training clouds that are shown, evenly taken from the data."""


def can_draw() -> bool:
    """Whether matplotlib and pillow are installed."""
    return all(importlib.util.find_spec(name) is not None for name in ("matplotlib", "PIL"))


def shown(observation: Observation, count: int = SHOWN) -> Observation:
    """The clouds that pictures show."""
    number = observation.points.shape[0]
    count = min(count, number)
    index = torch.arange(count, device=observation.points.device) * number // count
    return Observation(points=observation.points[index])


@torch.no_grad()
def draw_progress(
    method: AbstractMethod, observation: Observation, stage: str, log: Log, step: int
) -> None:
    """Hand the method's pictures to the log, named `STAGE-NAME`; nothing where none are drawn."""
    if not can_draw():
        return
    was_training = method.training
    method.eval()
    for name, picture in method.pictures(shown(observation), stage).items():
        log.picture(f"{stage}-{name}", picture, step)
    method.train(was_training)
