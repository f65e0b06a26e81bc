# SPDX-License-Identifier: MIT
"""OP-Align's backbone: four groups of E2PN convolutions, pooled per rotation of the icosahedron."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from scapo.equivariant.anchors import VERTICES, icosahedron
from scapo.equivariant.e2pn import QuotientBlock, to_rotations
from scapo.equivariant.layers import ChannelNorm, PointPool
from scapo.equivariant.levels import LevelConfig, Sampling, levels
from scapo.paper.heads import thin
from scapo.ranges import Neighbours, Positive

SLOPE = 0.01
"""Of the leaky ReLUs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BackboneConfig:
    """Sizes of the equivariant backbone; defaults as published."""

    LIKE: ClassVar[tuple[tuple[str, ...], ...]] = (("channels", "depth"),)

    channels: tuple[int, ...] = (32, 64, 128, 256)
    """Channels of each group; every group keeps one point of two."""
    depth: tuple[int, ...] = (2, 2, 2, 1)
    """Convolutions of each group."""
    radius: Positive = 0.2
    """Radius of the first convolution's neighbourhoods; times the square root of 2 with every
    halving."""
    neighbours: Neighbours = 32
    """Most neighbours of the first convolution of a group, half as many of the others."""
    points: int | None = None
    """Points it looks at, evenly taken from the cloud's order; None = all."""
    sampling: Sampling = "farthest"
    """How points are kept: by farthest-point sampling, or evenly from their order."""
    recompute: bool = False
    """Compute correlations twice rather than keep them: less memory, more time."""

    def plan(self) -> tuple[LevelConfig, ...]:
        """Every convolution's neighbourhood, which grows with the points it ends at.

        The very first has the radius of the points it starts from.
        """
        out = []
        for group, depth in enumerate(self.depth):
            for number in range(depth):
                halvings = 0 if group == number == 0 else group + 1
                out.append(
                    LevelConfig(
                        radius=self.radius * 2 ** (halvings / 2),
                        neighbours=self.neighbours // (1 if number == 0 else 2),
                        stride=2 if number == 0 else 1,
                    )
                )
        return tuple(out)


class Backbone(nn.Module):
    """Points and colours -> features of the 60 rotations."""

    anchors: Tensor

    def __init__(self, config: BackboneConfig, pooled: int) -> None:
        """`pooled` channels for each of the 12 anchors in the end."""
        super().__init__()
        self.config = config
        sizes = [
            channels
            for channels, depth in zip(config.channels, config.depth, strict=True)
            for _ in range(depth)
        ]
        self.blocks = nn.ModuleList(
            [
                QuotientBlock(
                    inputs,
                    outputs,
                    slope=SLOPE,
                    recompute=config.recompute,
                    skip_norm=number > 0,  # colours are one grey where the data have none
                )
                for number, (inputs, outputs) in enumerate(zip([3, *sizes], sizes, strict=False))
            ]
        )
        self.pools = nn.ModuleList([PointPool(size, size, VERTICES) for size in config.channels])
        self.norms = nn.ModuleList([ChannelNorm(size) for size in config.channels])
        self.join = nn.Linear(sum(config.channels), pooled)
        self.join_norm = ChannelNorm(pooled)
        self.outputs = VERTICES * pooled
        """Channels of each rotation."""
        anchors = icosahedron().rotations.float()
        self.register_buffer("anchors", anchors, persistent=False)

    def forward(
        self, points: Float[Tensor, "B N 3"], color: Float[Tensor, "B N 3"]
    ) -> Float[Tensor, "B 60 C"]:
        """Turned by a rotation g of the group, a cloud has the row of R_a at g R_a."""
        count = self.config.points or points.shape[1]
        points, x = thin(points, count), thin(color, count)[:, :, None]
        nears, ends = levels(points, self.config.plan(), self.config.sampling)
        pooled: list[Tensor] = []
        last = [sum(self.config.depth[: group + 1]) - 1 for group in range(len(self.pools))]
        for number, (block, near, end) in enumerate(zip(self.blocks, nears, ends, strict=True)):
            x = block(x, near)
            if number in last:
                group = len(pooled)
                pooled.append(self.norms[group](self.pools[group](x, end)).relu())
        joined = self.join_norm(self.join(torch.cat(pooled, -1)))  # (B, 12, pooled)
        return to_rotations(joined)
