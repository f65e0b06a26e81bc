# SPDX-License-Identifier: MIT
"""What a point network of the supervised baselines takes and gives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """What a body says of a cloud."""

    points: Float[Tensor, "B N C"]
    code: Float[Tensor, "B G"]


class Body(nn.Module, ABC):
    """A point network."""

    features: int
    """Channels of each point."""
    code: int
    """Channels of the whole."""
    least_points: int
    """Points that it needs."""

    @abstractmethod
    def forward(
        self, points: Float[Tensor, "B N 3"], generator: torch.Generator | None
    ) -> Features:
        """Features of clouds of mean radius 0.5; random choices only where a generator is given."""


class Block(nn.Module):
    """A pointwise linear layer, batch norm and ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "*B I"]) -> Float[Tensor, "*B O"]:
        """Over the last axis."""
        return self.activate(self.linear(x))

    def activate(self, x: Float[Tensor, "*B O"]) -> Float[Tensor, "*B O"]:
        """What follows the linear layer."""
        return F.relu(self.norm(x.flatten(0, -2)).view_as(x))
