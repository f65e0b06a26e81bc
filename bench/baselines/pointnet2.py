# SPDX-License-Identifier: MIT
"""PointNet++, supervised: the part segmentation network with several radii around each centre.

Set abstraction gathers the points within a radius of well-spread centres and takes the greatest
feature of each group, twice and then over the whole cloud; feature propagation carries what was
gathered back to the points by interpolation (Qi et al., NeurIPS 2017). Sizes as in the part
segmentation network of the public PyTorch version; the radii are those of clouds in the unit ball,
which a mean radius of 0.5 is near to. Heads and losses: `supervised`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, Int
from torch import Tensor, nn

from bench.baselines.body import Block, Body, Features
from bench.baselines.supervised import LEAN, LearningConfig, SupervisedMethod
from scapo.categories import Category
from scapo.geometry.points import farthest_points, gather, k_nearest
from scapo.ranges import Neighbours, Positive

Widths = tuple[int, ...]

NEIGHBOURS = 3
"""Points that a point without features of its own takes them from."""
ZERO = 1e-9
"""Squared length added to distances whose inverse is a weight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointNet2Config:
    """PointNet++, supervised; as published for part segmentation."""

    LIKE: ClassVar[tuple[tuple[str, ...], ...]] = (
        ("near_radii", "near_samples", "near_widths"),
        ("far_radii", "far_samples", "far_widths"),
    )
    preset: Literal["paper", "cpu"] = "paper"
    """Where the other defaults come from."""
    centres: tuple[int, int] = (512, 128)
    """Groups of the two levels."""
    near_radii: tuple[Positive, ...] = (0.1, 0.2, 0.4)
    """Radii of the groups of points, in units of twice the mean radius."""
    near_samples: tuple[Neighbours, ...] = (32, 64, 128)
    """Points of a group of each radius."""
    near_widths: tuple[Widths, ...] = ((32, 32, 64), (64, 64, 128), (64, 96, 128))
    """Channels of the layers of each radius."""
    far_radii: tuple[Positive, ...] = (0.4, 0.8)
    """Radii of the groups of groups, in the same unit."""
    far_samples: tuple[Neighbours, ...] = (64, 128)
    """Groups of a group of each radius."""
    far_widths: tuple[Widths, ...] = ((128, 128, 256), (128, 196, 256))
    """Channels of the layers of each radius."""
    whole_widths: Widths = (256, 512, 1024)
    """Channels of the layers on the whole cloud; the last are its code."""
    back_widths: tuple[Widths, Widths, Widths] = ((256, 256), (256, 128), (128, 128))
    """Channels on the way back: to the groups of groups, the groups, the points."""
    learning: Annotated[LearningConfig, tyro.conf.arg(name="")] = field(
        default_factory=LearningConfig
    )
    """Heads and training."""


def cpu_config() -> PointNet2Config:
    """The same network with an eighth of the groups, smaller ones, and half the channels."""
    return PointNet2Config(
        preset="cpu",
        centres=(64, 16),
        near_samples=(8, 12, 16),
        near_widths=((16, 16, 32), (16, 32, 32), (32, 32, 64)),
        far_samples=(8, 16),
        far_widths=((64, 64, 128), (64, 64, 128)),
        whole_widths=(128, 256, 512),
        back_widths=((128, 128), (128, 96), (96, 96)),
        learning=LEAN,
    )


@torch.no_grad()
def in_balls(
    centres: Float[Tensor, "B S 3"],
    points: Float[Tensor, "B N 3"],
    radii: tuple[float, ...],
    samples: tuple[int, ...],
) -> list[Int[Tensor, "B S _"]]:
    """For each radius the first so many points, in the cloud's order, within it of each centre.

    A group with fewer repeats its first. The order is no order of distance, so that a group is
    spread over its ball. Every centre is a point, so that no group is empty.
    """
    number = points.shape[1]
    squares = torch.cdist(centres, points).square_()
    order = torch.arange(number, 0, -1, device=points.device, dtype=torch.float32)
    found = []
    for radius, count in zip(radii, samples, strict=True):
        score = order * (squares <= radius**2)  # the first points have the largest
        top, index = score.topk(min(count, number), -1)
        found.append(torch.where(top > 0, index, index[..., :1]))
    return found


@torch.no_grad()
def interpolation(
    here: Float[Tensor, "B N 3"], there: Float[Tensor, "B M 3"]
) -> tuple[Int[Tensor, "B N K"], Float[Tensor, "B N K"]]:
    """The nearest three of the points `there`, and weights by inverse squared distance, sum 1."""
    index = k_nearest(here, there, min(NEIGHBOURS, there.shape[1]))
    near = gather(there, index.flatten(1)).unflatten(1, index.shape[1:])
    weight = 1 / ((near - here[:, :, None]).square().sum(-1) + ZERO)
    return index, weight / weight.sum(-1, keepdim=True)


def interpolate(
    values: Float[Tensor, "B M C"], index: Int[Tensor, "B N K"], weight: Float[Tensor, "B N K"]
) -> Float[Tensor, "B N C"]:
    """Weighted means of the values of the points that `index` names."""
    batch, rows, near = index.shape
    start = torch.arange(batch, device=index.device)[:, None] * values.shape[1]
    return F.embedding_bag(
        (index.flatten(1) + start).view(-1, near),
        values.flatten(0, 1),
        mode="sum",
        per_sample_weights=weight.flatten(0, 1).to(values.dtype),
    ).view(batch, rows, -1)


class Groups(nn.Module):
    """The layers of one radius, on offsets from the centre and features, and the greatest."""

    def __init__(self, inputs: int, widths: Widths) -> None:
        super().__init__()
        self.layers = nn.ModuleList([Block(i, o) for i, o in pairwise((3 + inputs, *widths))])

    def forward(
        self,
        points: Float[Tensor, "B N 3"],
        features: Float[Tensor, "B N C"],
        centres: Float[Tensor, "B S 3"],
        index: Int[Tensor, "B S K"],
    ) -> Float[Tensor, "B S O"]:
        """One feature for each group.

        The first layer is linear before its norm: it is applied to each point once, and the
        centre's share is subtracted from the gathered rows.
        """
        first, *rest = self.layers
        assert isinstance(first, Block)  # noqa: S101 - ModuleList forgets types
        rows = first.linear(torch.cat([points, features], -1))
        own = F.linear(centres, first.linear.weight[:, :3])
        start = torch.arange(rows.shape[0], device=rows.device)[:, None, None] * rows.shape[1]
        x = rows.flatten(0, 1)[index + start] - own[:, :, None]  # (B, S, K, O)
        x = first.activate(x)
        for layer in rest:
            x = layer(x)
        return x.amax(2)


class PointNet2Body(Body):
    """Set abstraction with several radii, twice; the whole cloud; and back to the points."""

    def __init__(self, config: PointNet2Config) -> None:
        super().__init__()
        self.config = config
        near, far = (
            sum(w[-1] for w in widths) for widths in (config.near_widths, config.far_widths)
        )
        self.near = nn.ModuleList([Groups(3, widths) for widths in config.near_widths])
        self.far = nn.ModuleList([Groups(near, widths) for widths in config.far_widths])
        self.whole = _blocks(3 + far, config.whole_widths)
        first, second, third = config.back_widths
        self.code = config.whole_widths[-1]
        self.back_far = _blocks(far + self.code, first)
        self.back_near = _blocks(near + first[-1], second)
        self.back_points = _blocks(3 + second[-1], third)
        self.features = third[-1]
        self.least_points = 1

    def forward(
        self, points: Float[Tensor, "B N 3"], generator: torch.Generator | None
    ) -> Features:
        """Nothing is random."""
        del generator
        config = self.config
        centres, near = self._abstract(
            points, points, self.near, config.centres[0], (config.near_radii, config.near_samples)
        )
        middles, far = self._abstract(
            centres, near, self.far, config.centres[1], (config.far_radii, config.far_samples)
        )
        code = self.whole(torch.cat([middles, far], -1)).amax(1)
        spread = code[:, None].expand(-1, far.shape[1], -1)
        far = self.back_far(torch.cat([far, spread], -1))
        near = self.back_near(
            torch.cat([near, interpolate(far, *interpolation(centres, middles))], -1)
        )
        back = interpolate(near, *interpolation(points, centres))
        return Features(points=self.back_points(torch.cat([points, back], -1)), code=code)

    def _abstract(
        self,
        points: Float[Tensor, "B N 3"],
        features: Float[Tensor, "B N C"],
        layers: nn.ModuleList,
        count: int,
        groups: tuple[tuple[float, ...], tuple[int, ...]],
    ) -> tuple[Float[Tensor, "B S 3"], Float[Tensor, "B S O"]]:
        """Well-spread centres, and the features of the groups about them."""
        centres = gather(points, farthest_points(points, min(count, points.shape[1])))
        found = [
            layer(points, features, centres, index)
            for layer, index in zip(layers, in_balls(centres, points, *groups), strict=True)
        ]
        return centres, torch.cat(found, -1)


def _blocks(inputs: int, widths: Widths) -> nn.Sequential:
    return nn.Sequential(*[Block(i, o) for i, o in pairwise((inputs, *widths))])


class PointNet2(SupervisedMethod):
    """PointNet++ with the heads of the supervised baselines."""

    name: ClassVar[str] = "pointnet2"

    def __init__(
        self, config: PointNet2Config, category: Category, generator: torch.Generator
    ) -> None:
        """Draw the weights from `generator`."""
        super().__init__(config, category, lambda: PointNet2Body(config), generator)

    @property
    def default(self) -> PointNet2Config:
        """Of its preset."""
        return PointNet2Config() if self.config.preset == "paper" else cpu_config()
