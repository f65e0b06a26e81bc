# SPDX-License-Identifier: MIT
"""OP-Align after its backbone: pose hypotheses, decoder, and the point network.

Che et al., "OP-Align: Object-level and Part-level Alignment for Self-supervised Category-level
Articulated Object Pose Estimation", ECCV 2024. Lengths are in normalised units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from scapo.categories import Category, JointKind
from scapo.equivariant.layers import ChannelNorm
from scapo.first_weights import uniform
from scapo.geometry.numerics import at_least_float32, exact
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.heads import MOST_BLOCKS, JointPairs, ResidualBlock, ZeroLinear, joint_pairs


def layers(*sizes: int, slope: float = 0.0) -> list[nn.Module]:
    """Linear layers, each with batch norm and (leaky) ReLU."""
    out: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        out += [nn.Linear(inputs, outputs), ChannelNorm(outputs), nn.LeakyReLU(slope)]
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class HypothesisConfig:
    """Sizes of the pose head."""

    pooled: int = 256
    """Channels per anchor after all levels are joined."""
    width: int = 512
    """Channels per rotation."""
    hidden: int = 128
    """Channels of the attention and of the residual pose."""
    code: int = 256
    """Numbers of the invariant shape code."""
    residual_range: float = math.pi / 10
    """Largest angle between a hypothesis and its anchor, rad. A random rotation is 29.6 degrees
    from the nearest anchor on average and up to 44.5, which the published 18 do not reach."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypotheses:
    """Poses that the head proposes, K = 60: aligned = R^T x - t."""

    rotation: Float[Tensor, "B K 3 3"]
    translation: Float[Tensor, "B K 3"]
    """In the aligned frame."""
    attention: Float[Tensor, "B K"]
    """Sums to 1."""
    code: Float[Tensor, "B C"]
    """Invariant to the anchor rotations."""


class HypothesisHead(nn.Module):
    """Features per rotation -> one pose for each of the 60 anchor rotations, and a code."""

    anchors: Tensor

    def __init__(
        self, config: HypothesisConfig, inputs: int, anchors: Float[Tensor, "K 3 3"]
    ) -> None:
        """`inputs` channels for each of the `anchors`."""
        super().__init__()
        width, hidden = config.width, config.hidden
        self.feature = nn.Sequential(*layers(inputs, width))
        self.attention = nn.Sequential(*layers(width, hidden), nn.Linear(hidden, 1))
        self.reach = config.residual_range
        self.residual = nn.Sequential(*layers(width, hidden))
        self.turn = nn.Linear(hidden, 4)
        # A cloud that starts beyond the robust terms' reach has no gradient to come back by.
        self.shift = ZeroLinear(hidden, 3)
        self.code = nn.Sequential(*layers(width, width), nn.Linear(width, config.code))
        self.register_buffer("anchors", anchors, persistent=False)

    def forward(self, features: Float[Tensor, "B K C"]) -> Hypotheses:
        """R_k = anchor_k Exp(axis x angle), the angle within its range by a sigmoid."""
        x = self.feature(features)  # (B, K, width)
        residual = self.residual(x)
        axis, angle = at_least_float32(self.turn(residual)).split((3, 1), -1)
        angle = 2 * self.reach * (torch.sigmoid(angle) - 0.5)
        with exact(angle.device.type):
            rotation = self.anchors @ rotvec_to_rotmat(F.normalize(axis, dim=-1) * angle)
        attention = torch.softmax(at_least_float32(self.attention(x))[..., 0], -1)
        return Hypotheses(
            rotation=rotation,
            translation=at_least_float32(self.shift(residual)),
            attention=attention,
            code=self.code(x.amax(1)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DecoderConfig:
    """Sizes of the decoder."""

    width: int = 256
    """Channels of the decoder's layers."""
    points: int = 1024
    """Points of the canonical shape."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CanonicalShape:
    """What the decoder says."""

    points: Float[Tensor, "B M 3"]
    offset: Float[Tensor, "B M 3"]
    """Of the points from the base shape that all clouds share."""
    color: Float[Tensor, "B M 3"] | None
    """None without a colour branch."""


class Decoder(nn.Module):
    """Invariant code -> canonical shape: offsets added to a learned base shape.

    Offsets start at 0. Of random ones, batch norm lets one cloud of a batch take all the variance:
    its shape is far off, where the robust terms are flat, and the others share the base.
    """

    def __init__(self, config: DecoderConfig, code: int, *, color: bool) -> None:
        """With a colour branch or without."""
        super().__init__()
        width, outputs = config.width, 3 * config.points
        self.trunk = nn.Sequential(*layers(code, width, width, slope=0.01))
        self.offset = nn.Sequential(*layers(width, width, slope=0.01), ZeroLinear(width, outputs))
        self.color = None
        if color:
            self.color = nn.Sequential(*layers(width, width, slope=0.01), nn.Linear(width, outputs))
        self.base = nn.Parameter(torch.zeros(config.points, 3))

    def reset(self, generator: torch.Generator) -> None:
        """The base shape: Xavier uniform."""
        uniform(self.base, (6 / (self.base.shape[0] + 3)) ** 0.5, generator)

    def forward(self, code: Float[Tensor, "B C"]) -> CanonicalShape:
        """Points in the canonical frame."""
        x = self.trunk(code)
        offset = at_least_float32(self.offset(x)).unflatten(-1, (-1, 3))
        color = None if self.color is None else self.color(x).unflatten(-1, (-1, 3))
        return CanonicalShape(points=self.base + offset, offset=offset, color=color)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointNetConfig:
    """Sizes of the network that segments and finds joints."""

    width: int = 256
    """Channels of the residual blocks."""
    blocks: int = 5
    """Residual blocks."""
    segmentation: tuple[int, ...] = (128, 32)
    """Channels of the layers that segment."""
    joint: tuple[int, int] = (256, 128)
    """Channels of the layers that find joints."""
    revolute_range: float = 2.0944
    """Width of the interval of states, rad (120 degrees)."""
    prismatic_range: float = 2.0944
    """Width of the interval of ways, normalised units: the published code has one number."""

    def __post_init__(self) -> None:
        """Raise ValueError for more blocks than any network has, as damaged files ask for."""
        if not 1 <= self.blocks <= MOST_BLOCKS:
            raise ValueError(f"blocks: expected 1 to {MOST_BLOCKS}, found {self.blocks}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Articulation:
    """Parts and joints of one shape, in its own frame."""

    weights: Float[Tensor, "B N P"]
    """Rows on the simplex."""
    joints: JointPairs
    """States of the base and of the child."""


class PointNetwork(nn.Module):
    """Points -> parts and joints; the aligned cloud and the canonical shape share it."""

    def __init__(self, config: PointNetConfig, category: Category) -> None:
        """Layers for the parts and joints of a category."""
        super().__init__()
        self.config = config
        self.kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        width, (wide, narrow) = config.width, config.joint
        self.lift = nn.Linear(3, 2 * width)
        self.blocks = nn.ModuleList([ResidualBlock(2 * width, width) for _ in range(config.blocks)])
        sizes = (width, *config.segmentation)
        self.segmentation = nn.Sequential(
            *layers(*sizes), nn.Linear(sizes[-1], len(category.parts))
        )
        self.joint = nn.Sequential(  # two linear layers in a row, as published
            *layers(width, wide), nn.Linear(wide, narrow), nn.Linear(narrow, 8 * len(self.kinds))
        )

    def forward(
        self, first: Float[Tensor, "B N 3"], second: Float[Tensor, "B M 3"]
    ) -> tuple[Articulation, Articulation]:
        """Both shapes as one batch, so that they share its statistics."""
        sizes = [shape.shape[:2] for shape in (first, second)]
        rows = [number * count for number, count in sizes]
        x = self.lift(torch.cat([first.flatten(0, 1), second.flatten(0, 1)]))

        def pooled(x: Float[Tensor, "R C"]) -> list[Float[Tensor, "B C"]]:
            pieces = zip(x.split(rows), sizes, strict=True)
            return [piece.unflatten(0, size).amax(1) for piece, size in pieces]

        for number, block in enumerate(self.blocks):
            x = block(x[None])[0]
            if number + 1 < len(self.blocks):
                spread = [
                    pool.repeat_interleave(count, 0)
                    for pool, (_, count) in zip(pooled(x), sizes, strict=True)
                ]
                x = torch.cat([x, torch.cat(spread)], -1)
        weights = torch.softmax(at_least_float32(self.segmentation(x)), -1)
        ranges = self.config.revolute_range, self.config.prismatic_range
        numbers = at_least_float32(self.joint(torch.cat(pooled(x))))
        joints = numbers.unflatten(1, (len(self.kinds), 8)).chunk(2)
        one, other = (
            Articulation(
                weights=weight.unflatten(0, size), joints=joint_pairs(joint, self.kinds, *ranges)
            )
            for weight, size, joint in zip(weights.split(rows), sizes, joints, strict=True)
        )
        return one, other
