# SPDX-License-Identifier: MIT
"""What both stages of EAP are made of: readouts per anchor, decoders, slot attention.

Liu et al., "Self-Supervised Category-Level Articulated Object Pose Estimation with Part-Level
SE(3) Equivariance", ICLR 2023. Slot attention: Locatello et al., NeurIPS 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from scapo.geometry.numerics import at_least_float32


@dataclass(frozen=True, slots=True, kw_only=True)
class Readout:
    """Features of a cloud or of one of its parts."""

    anchors: Float[Tensor, "B A C"]
    """One for each anchor; turned with the cloud."""
    code: Float[Tensor, "B C"]
    """Invariant: their mean under an attention."""


class AnchorReadout(nn.Module):
    """A PointNet in the frame of every anchor: max over points of [feature; turned coordinates]."""

    rotations: Tensor

    def __init__(self, inputs: int, width: int, rotations: Float[Tensor, "A 3 3"]) -> None:
        super().__init__()
        self.feature = nn.Linear(inputs, width)
        self.norm = nn.BatchNorm1d(width)
        self.embed = nn.Linear(width + 3, width)
        self.attention = nn.Linear(width, 1)
        self.register_buffer("rotations", rotations, persistent=False)

    def forward(
        self,
        points: Float[Tensor, "B N 3"],
        features: Float[Tensor, "B N A C"],
        member: Bool[Tensor, "B N"] | None = None,
    ) -> Readout:
        """Of all points, or of the members alone; 0 where a cloud has none."""
        x = self.feature(features)  # (B, N, A, width)
        x = self.norm(x.flatten(0, 2)).view_as(x).relu()
        turned = torch.einsum("bnj,aji->bnai", points, self.rotations)  # R^T p
        x = self.embed(torch.cat([x, turned.to(x.dtype)], -1))
        if member is None:
            pooled = x.amax(1)
        else:
            inside = member[:, :, None, None]
            pooled = x.masked_fill(~inside, -torch.inf).amax(1)
            pooled = torch.where(inside.any(1), pooled, 0.0)
        pooled = pooled.relu()  # (B, A, width)
        share = torch.softmax(self.attention(pooled), 1)
        return Readout(anchors=pooled, code=(share * pooled).sum(1))


class ShapeDecoder(nn.Module):
    """Code -> points within half a unit of the origin, by a sigmoid."""

    def __init__(self, code: int, width: int, points: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(code, width),
            nn.BatchNorm1d(width),
            nn.LeakyReLU(),
            nn.Linear(width, width),
            nn.BatchNorm1d(width),
            nn.LeakyReLU(),
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
            nn.Linear(inputs, inputs), nn.LeakyReLU(), nn.Linear(inputs, outputs)
        )

    def forward(self, x: Float[Tensor, "B A C"]) -> Float[Tensor, "B A O"]:
        """Numbers of every anchor."""
        return at_least_float32(self.layers(x))


class Slot(nn.Module):
    """One slot: query, key and value of its own, a GRU and an MLP."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (nn.Linear(width, width, bias=False) for _ in range(3))
        self.update = nn.GRUCell(width, width)
        self.before, self.after = nn.LayerNorm(width), nn.LayerNorm(width)
        self.mlp = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))
        self.start = nn.Parameter(torch.zeros(width))

    def reset(self, generator: torch.Generator) -> None:
        """The GRU as PyTorch does, uniform; the start normal, so that slots differ."""
        with torch.no_grad():
            for parameter in self.update.parameters():
                draw = torch.rand(parameter.shape, generator=generator)
                parameter.copy_((2 * draw - 1) * self.update.hidden_size**-0.5)
            self.start.copy_(torch.randn(self.start.shape, generator=generator))


class SlotAttention(nn.Module):
    """Points -> weights of the slots, which compete for them in a few rounds."""

    def __init__(self, slots: int, width: int, rounds: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.slots = nn.ModuleList([Slot(width) for _ in range(slots)])
        self.rounds = rounds

    def forward(self, features: Float[Tensor, "B N C"]) -> Float[Tensor, "B N S"]:
        """Softmax over the slots."""
        x, slots = self.norm(features), list(self.slots)
        keys, values = ([getattr(s, name)(x) for s in slots] for name in ("key", "value"))
        state = [slot.start.expand(x.shape[0], -1) for slot in slots]
        weights = x.new_zeros(())
        for _ in range(self.rounds):
            logits = [
                (key @ slot.query(slot.before(one))[..., None])[..., 0] * x.shape[-1] ** -0.5
                for slot, key, one in zip(slots, keys, state, strict=True)
            ]
            weights = torch.softmax(at_least_float32(torch.stack(logits, -1)), -1)  # (B, N, S)
            share = (weights + 1e-8) / (weights + 1e-8).sum(1, keepdim=True)
            state = [
                _updated(slot, (share[..., None, k].to(x.dtype) @ value)[:, 0], one)
                if False
                else _updated(
                    slot, torch.einsum("bn,bnc->bc", share[..., k].to(x.dtype), value), one
                )
                for k, (slot, value, one) in enumerate(zip(slots, values, state, strict=True))
            ]
        return weights


def _updated(slot: nn.Module, mean: Tensor, state: Tensor) -> Float[Tensor, "B C"]:
    state = slot.update(mean, state)
    return state + slot.mlp(slot.after(state))
