# SPDX-License-Identifier: MIT
"""The network of NPCS-EPN: what each point says of its part and the joint near it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bench.baselines.body import Block
from bench.baselines.pointnet2 import interpolate, interpolation
from scapo.equivariant.anchors import ROTATIONS, icosahedron
from scapo.equivariant.epn import SeparableBlock
from scapo.equivariant.layers import PointPool
from scapo.equivariant.levels import LevelConfig, levels
from scapo.geometry.numerics import at_least_float32
from scapo.ranges import Neighbours, Positive


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """Sizes; lengths in units of four times the mean radius."""

    LIKE: ClassVar[tuple[tuple[str, ...], ...]] = (("widths", "strides", "radii", "neighbours"),)

    widths: tuple[int, ...] = (64, 64, 128, 128, 256)
    """Channels of each block, of each of the 60 anchors."""
    strides: tuple[int, ...] = (2, 1, 2, 1, 2)
    """Each block keeps one point of so many."""
    radii: tuple[Positive, ...] = (0.12, 0.12, 0.24, 0.24, 0.48)
    """Radii of the groups of each block."""
    neighbours: tuple[Neighbours, ...] = (32, 16, 32, 16, 32)
    """Most points of a group of each block."""
    frames: int = 8
    """Soft frames that anchors are attended to in; a divisor of all widths and of the code."""
    code: int = 128
    """Channels of the whole cloud, from each block."""
    head: tuple[int, ...] = (256, 256, 128)
    """Channels of the layers at each point."""
    recompute: bool = True
    """Compute what the space convolutions correlate again for the gradient, which keeps a
    fraction of the memory and takes a third more time."""

    def __post_init__(self) -> None:
        """Raise ValueError for channels that are not shared evenly by the frames."""
        sizes = (*self.widths, self.code)
        if self.frames > 0 and any(size % self.frames for size in sizes):
            raise ValueError(
                f"network.frames: expected a divisor of all widths and of the code, "
                f"{', '.join(map(str, sizes))}, found {self.frames}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What the network says of each point; all of it unchanged when the cloud is turned."""

    part: Float[Tensor, "B N P"]
    """Logits."""
    coordinate: Float[Tensor, "B N P 3"]
    """In the box of each part, [0, 1]."""
    joint: Float[Tensor, "B N K"]
    """Logits: which joint's axis is near, the last for none."""
    heat: Float[Tensor, "B N"]
    """1 on the axis, 0 a reach away."""
    towards: Float[Tensor, "B N 3"]
    """The unit vector to the axis, in the frame of the point's part."""
    axis: Float[Tensor, "B N 3"]
    """The axis, in the frame of the point's part."""


class NpcsNetwork(nn.Module):
    """EPN's blocks, anchors read in a few soft frames, a pointwise network on what is invariant.

    Attention over the 60 anchors, from the pooled cloud, is a distribution over rotations that
    turns with the cloud. Channels of every level are averaged by it, and so are the rotations
    themselves: in each of the mean matrices the coordinates of all points are invariant too.
    """

    rotations: Tensor

    def __init__(self, config: NetworkConfig, parts: int, joints: int) -> None:
        super().__init__()
        self.frames, self.parts, self.joints = config.frames, parts, joints
        self.layers = tuple(
            LevelConfig(radius=radius, neighbours=neighbours, stride=stride)
            for radius, neighbours, stride in zip(
                config.radii, config.neighbours, config.strides, strict=True
            )
        )
        inputs = (1, *config.widths[:-1])
        self.blocks = nn.ModuleList(
            SeparableBlock(i, o, recompute=config.recompute, skip_norm=number > 0)  # first: ones
            for number, (i, o) in enumerate(zip(inputs, config.widths, strict=True))
        )
        self.pools = nn.ModuleList(
            PointPool(width, config.code, ROTATIONS) for width in config.widths
        )
        whole = config.code * len(config.widths)
        self.attend = nn.Sequential(
            nn.ReLU(), nn.Linear(whole, config.code), nn.ReLU(),
            nn.Linear(config.code, config.frames),
        )  # fmt: skip
        known = 3 * config.frames + sum(config.widths) + whole
        sizes = (known, *config.head)
        self.head = nn.Sequential(*(Block(i, o) for i, o in zip(sizes, config.head, strict=False)))
        self.say = nn.Linear(config.head[-1], 4 * parts + (joints + 1) + 1 + 3 + 3)
        rotations = icosahedron().rotations.float()
        self.register_buffer("rotations", rotations, persistent=False)

    def forward(self, points: Float[Tensor, "B K 3"], asked: Float[Tensor, "B N 3"]) -> Answer:
        """Look at `points`, speak of the points `asked`."""
        near, ends = levels(points, self.layers)
        features = torch.ones_like(points[:, :, :1, None])  # (B, K, 1, 1)
        found = []
        for block, one in zip(self.blocks, near, strict=True):
            features = block(features, one)  # (B, K', 60, C)
            found.append(features)
        pooled = zip(self.pools, found, ends, strict=True)
        code = torch.cat([pool(some, end) for pool, some, end in pooled], -1)  # (B, 60, G)
        attention = at_least_float32(self.attend(code)).softmax(1)  # (B, 60, H)
        frames = torch.einsum("bah,aij->bhij", attention, self.rotations)
        known = [torch.einsum("bhij,bni->bnhj", frames, asked).flatten(2)]
        for some, end in zip(found, ends, strict=True):
            mean = self._attended(some, attention[:, None])  # (B, K', C)
            known.append(interpolate(mean, *interpolation(asked, end)))
        whole = self._attended(code, attention)[:, None]  # (B, 1, G)
        known.append(whole.expand(-1, asked.shape[1], -1))
        return self._answer(self.say(self.head(torch.cat(known, -1))))

    def _attended(
        self, x: Float[Tensor, "*B 60 C"], attention: Float[Tensor, "*#B 60 H"]
    ) -> Float[Tensor, "*B C"]:
        """The mean over anchors, each share of the channels by its own attention."""
        split = at_least_float32(x).unflatten(-1, (self.frames, -1))  # (..., 60, H, C / H)
        return (split * attention[..., None]).sum(-3).flatten(-2)

    def _answer(self, said: Float[Tensor, "B N S"]) -> Answer:
        parts, joints = self.parts, self.joints
        sizes = [parts, 3 * parts, joints + 1, 1, 3, 3]
        part, coordinate, joint, heat, towards, axis = at_least_float32(said).split(sizes, -1)
        return Answer(
            part=part,
            coordinate=coordinate.sigmoid().unflatten(-1, (parts, 3)),
            joint=joint,
            heat=heat[..., 0].sigmoid(),
            towards=F.normalize(towards, dim=-1),
            axis=F.normalize(axis, dim=-1),
        )
