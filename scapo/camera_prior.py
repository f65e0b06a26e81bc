# SPDX-License-Identifier: MIT
"""Where the cameras of a category's views stand about its objects, learned from its own choices.

Some views are explained alike by two poses: seen from the front, a cabinet that is upside down is a
cabinet whose drawer sits as far from the other end. Data sets do not look at objects from
everywhere; among such poses that one is taken whose camera stands where those of other views do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.pose_search import Finalists, Found
from scapo.sightings import Views
from scapo.state_range import StateRange

CONCENTRATION = 12.0
"""Of the von Mises-Fisher kernels about the directions: 1/e of the peak at 24 degrees."""
FLOOR = 0.05
"""Share of cameras that may stand anywhere."""
WEIGHT = 0.15
"""Of the logarithm of the density in the loss of a hypothesis."""
ALIKE = 0.1
"""Hypotheses that explain a view worse than the best one by more are not taken for their cameras:
where an object has two sides that are nearly alike, cameras stand about both."""
REPEATS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPrior:
    """A density of viewing directions."""

    cameras: Float[Tensor, "V 3"]
    """Unit vectors from the template to cameras, in its frame."""

    def best(self, finalists: Finalists, views: Views, states: StateRange) -> Found:
        """The best of each view, cameras considered."""
        density = _kernel(directions(finalists, views) @ self.cameras.mT).mean(-1)
        return finalists.best(states, _cost(density, finalists.charged(states)))


def directions(finalists: Finalists, views: Views) -> Float[Tensor, "B F 3"]:
    """Where each hypothesis has its camera, unit vectors in the template frame."""
    placement, shape = finalists.placement, finalists.loss.shape
    away = views.camera.repeat_interleave(shape[1], 0) - placement.translation
    return F.normalize((away[:, None] @ placement.rotation)[:, 0], dim=-1).unflatten(0, shape)


@torch.no_grad()
def agreed(finalists: Finalists, views: Views, states: StateRange) -> Found:
    """The best of each view given the cameras of the others, until no choice changes."""
    direction, loss = directions(finalists, views), finalists.charged(states)
    every = torch.arange(len(loss), device=loss.device)
    chosen, cost = loss.argmin(1), torch.zeros_like(loss)
    for _ in range(REPEATS):
        kernel = _kernel(direction @ direction[every, chosen].mT)  # (B, F, B)
        own = kernel[every, :, every]
        cost = _cost((kernel.sum(-1) - own) / max(1, len(loss) - 1), loss)
        better = (loss + cost).argmin(1)
        if torch.equal(better, chosen):
            break
        chosen = better
    return finalists.best(states, cost)


def _kernel(cosine: Tensor) -> Tensor:
    """Density at an angle from its direction, 1 for the uniform one."""
    peak = 2 * CONCENTRATION / (1 - math.exp(-2 * CONCENTRATION))
    return peak * torch.exp(CONCENTRATION * (cosine - 1))


def _cost(density: Float[Tensor, "B F"], loss: Float[Tensor, "B F"]) -> Float[Tensor, "B F"]:
    """What hypotheses are charged for their cameras."""
    cost = -WEIGHT * (FLOOR + (1 - FLOOR) * density).log()
    return cost.masked_fill(loss > loss.amin(1, keepdim=True) + ALIKE, torch.inf)
