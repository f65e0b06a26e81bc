# SPDX-License-Identifier: MIT
"""What both stages of EAP are made of: EPN encoder, readouts per anchor, decoders, slot attention.

Liu et al., "Self-Supervised Category-Level Articulated Object Pose Estimation with Part-Level
SE(3) Equivariance", ICLR 2023. Slot attention: Locatello et al., NeurIPS 2020.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from scapo.equivariant.anchors import icosahedron
from scapo.equivariant.epn import PointConv, SeparableBlock
from scapo.equivariant.layers import ChannelNorm, anchor_coordinates, leaky
from scapo.equivariant.levels import LevelConfig, Neighbourhood, levels
from scapo.geometry.numerics import at_least_float32
from scapo.ranges import Neighbours, Positive

SLOPE = 0.01
"""Of the leaky ReLUs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderConfig:
    """Sizes of an EPN encoder, which keeps all points."""

    LIKE: ClassVar[tuple[tuple[str, ...], ...]] = (("channels", "radii"),)

    channels: tuple[int, ...] = (64, 128, 512)
    """Channels of each block."""
    radii: tuple[Positive, ...] = (0.08, 0.16, 0.226)
    """0.2 x 0.4 x (1, 2, 2.83) where the box's diagonal is 1; mean radius 0.25 is about that."""
    neighbours: Neighbours = 64
    """Most points of a neighbourhood."""
    recompute: bool = False
    """Compute correlations twice rather than keep them: less memory, more time."""

    def plan(self) -> tuple[LevelConfig, ...]:
        """Every convolution's neighbourhood."""
        return tuple(LevelConfig(radius=one, neighbours=self.neighbours) for one in self.radii)


class PointBlock(nn.Module):
    """A convolution over space with norm and leaky ReLU, without one over the group."""

    def __init__(self, inputs: int, outputs: int, *, recompute: bool) -> None:
        super().__init__()
        self.conv = PointConv(inputs, outputs, recompute=recompute)
        self.norm = ChannelNorm(outputs)

    def forward(
        self, features: Float[Tensor, "B N A C"], near: Neighbourhood
    ) -> Float[Tensor, "B N 60 O"]:
        """Of the same points."""
        return leaky(self.norm(self.conv(features, near)), SLOPE)


class Encoder(nn.Module):
    """Points -> features of every point and anchor; `group` convolves over the anchors too."""

    def __init__(self, config: EncoderConfig, *, group: bool) -> None:
        super().__init__()
        self.config = config
        sizes = zip([1, *config.channels], config.channels, strict=False)
        self.blocks = nn.ModuleList(
            SeparableBlock(
                inputs,
                outputs,
                slope=SLOPE,
                recompute=config.recompute,
                skip_norm=number > 0,  # the first block sees ones
            )
            if group
            else PointBlock(inputs, outputs, recompute=config.recompute)
            for number, (inputs, outputs) in enumerate(sizes)
        )

    def forward(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 60 C"]:
        """From an input of ones."""
        nears, _ = levels(points, self.config.plan())
        x = torch.ones_like(points[..., :1])[:, :, None]
        for block, near in zip(self.blocks, nears, strict=True):
            x = block(x, near)
        return x


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Features of a cloud or of one of its parts."""

    anchors: Float[Tensor, "B 60 C"]
    """Turned by a rotation g of the group, a cloud has the row of R_a at g R_a."""
    code: Float[Tensor, "B C"]
    """Invariant: their mean under an attention."""


class Readout(nn.Module):
    """A PointNet in the frame of every anchor: greatest over points of [feature; coordinates]."""

    rotations: Tensor

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.feature = nn.Linear(inputs, width)
        self.norm = ChannelNorm(width)
        self.embed = nn.Linear(width + 3, width)
        self.attention = nn.Linear(width, 1)
        rotations = icosahedron().rotations.float()
        self.register_buffer("rotations", rotations, persistent=False)

    def forward(
        self,
        points: Float[Tensor, "B N 3"],
        features: Float[Tensor, "B N 60 C"],
        member: Bool[Tensor, "B N"] | None = None,
    ) -> Summary:
        """Of all points, or of the members alone; 0 where a cloud has none."""
        x = self.norm(self.feature(features)).relu()
        seen = anchor_coordinates(points, self.rotations).to(x.dtype)
        x = self.embed(torch.cat([x, seen], -1)).relu()
        if member is not None:  # all are at least 0 by now
            x = x * member[:, :, None, None]
        pooled = x.amax(1)  # (B, 60, width)
        share = torch.softmax(self.attention(pooled), 1)
        return Summary(anchors=pooled, code=(share * pooled).sum(1))


class PointReadout(nn.Module):
    """Features of every point and anchor -> invariant ones of every point, by an attention."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.feature = nn.Linear(inputs, width)
        self.norm = ChannelNorm(width)
        self.attention = nn.Linear(width, 1)

    def forward(self, features: Float[Tensor, "B N 60 C"]) -> Float[Tensor, "B N W"]:
        """At each point by itself."""
        x = self.norm(self.feature(features)).relu()
        return (torch.softmax(self.attention(x), 2) * x).sum(2)


class ShapeDecoder(nn.Module):
    """Code -> points within half a unit of the origin, by a sigmoid."""

    def __init__(self, code: int, width: int, points: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.Linear(code, width), ChannelNorm(width), nn.LeakyReLU(SLOPE)),
            *(nn.Linear(width, width), ChannelNorm(width), nn.LeakyReLU(SLOPE)),
            nn.Linear(width, 3 * points),
        )

    def forward(self, code: Float[Tensor, "B C"]) -> Float[Tensor, "B M 3"]:
        """Points of a shape, or a single one."""
        numbers = at_least_float32(self.layers(code))
        return (torch.sigmoid(numbers) - 0.5).unflatten(-1, (-1, 3))


class PerAnchor(nn.Module):
    """Two layers on the feature of every anchor."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(inputs, inputs), nn.LeakyReLU(SLOPE), nn.Linear(inputs, outputs)
        )

    def forward(self, x: Float[Tensor, "B 60 C"]) -> Float[Tensor, "B 60 O"]:
        """Numbers of every anchor."""
        return at_least_float32(self.layers(x))


class Slot(nn.Module):
    """One slot: query, key and value of its own, a GRU and an MLP."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.gru = nn.GRUCell(width, width)
        self.before, self.after = nn.LayerNorm(width), nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))
        self.start = nn.Parameter(torch.zeros(width))

    def reset(self, generator: torch.Generator) -> None:
        """The GRU as PyTorch does, uniform; the start normal, so that slots differ."""
        with torch.no_grad():
            for parameter in self.gru.parameters():
                draw = torch.rand(parameter.shape, generator=generator)
                parameter.copy_((2 * draw - 1) * self.gru.hidden_size**-0.5)
            self.start.copy_(torch.randn(self.start.shape, generator=generator))

    def logits(
        self, key: Float[Tensor, "B N C"], state: Float[Tensor, "B C"]
    ) -> Float[Tensor, "B N"]:
        """How much each point is asked for."""
        query = self.query(self.before(state))[..., None]
        return at_least_float32(key @ query)[..., 0] * query.shape[1] ** -0.5

    def update(self, mean: Float[Tensor, "B C"], state: Float[Tensor, "B C"]) -> Tensor:
        """The next state, (B, C)."""
        state = self.gru(mean, state)
        return state + self.mlp(self.after(state))


class SlotAttention(nn.Module):
    """Points -> weights of the slots, which compete for them in a few rounds."""

    def __init__(self, slots: int, width: int, rounds: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.slots = nn.ModuleList([Slot(width) for _ in range(slots)])
        self.rounds = rounds

    def all_slots(self) -> Iterator[Slot]:
        """The slots in order."""
        return (cast("Slot", slot) for slot in self.slots)

    def forward(self, features: Float[Tensor, "B N C"]) -> Float[Tensor, "B N S"]:
        """Softmax over the slots."""
        x, slots = self.norm(features), list(self.all_slots())
        keys, values = [one.key(x) for one in slots], [one.value(x) for one in slots]
        states = [one.start.expand(x.shape[0], -1) for one in slots]
        weights = x.new_zeros(())
        for _ in range(self.rounds):
            asked = [
                one.logits(key, state) for one, key, state in zip(slots, keys, states, strict=True)
            ]
            weights = torch.softmax(torch.stack(asked, -1), -1)  # (B, N, S)
            share = weights / (weights.sum(1, keepdim=True) + 1e-8)
            states = [
                one.update((share[:, None, :, k].to(x.dtype) @ value)[:, 0], state)
                for k, (one, value, state) in enumerate(zip(slots, values, states, strict=True))
            ]
        return weights
