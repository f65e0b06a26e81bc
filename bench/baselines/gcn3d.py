# SPDX-License-Identifier: MIT
"""3D-GCN, supervised: graph convolutions with deformable kernels on the directions to neighbours.

A kernel is a set of unit directions with a weight each. Its answer at a point is the sum over its
directions of the greatest, over the point's neighbours, of cosine (where positive) times the
weighted feature of the neighbour; so a cloud may be moved and scaled without any change. Layers
alternate with pools that keep a quarter of the points (Lin et al., CVPR 2020). The published pool
draws that quarter at random whenever it runs; here it does so in training alone, and a prediction
keeps every fourth point of the cloud's order. Heads and losses: `supervised`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import torch
import torch.nn.functional as F
import tyro
from jaxtyping import Float, Int
from torch import Tensor, nn

from bench.baselines.body import Body, Features
from bench.baselines.supervised import LEAN, LearningConfig, SupervisedMethod
from scapo.categories import Category
from scapo.first_weights import uniform
from scapo.geometry.numerics import at_least_float32
from scapo.geometry.points import gather, k_nearest, nearest
from scapo.method import evenly
from scapo.ranges import Neighbours


@dataclass(frozen=True, slots=True, kw_only=True)
class Gcn3dConfig:
    """3DGCN, supervised; as published for segmentation, with seven directions a kernel."""

    preset: Literal["paper", "cpu"] = "paper"
    """Where the other defaults come from."""
    support: int = 7
    """Directions of a kernel."""
    neighbours: Neighbours = 10
    """Points that a point is convolved with."""
    widths: tuple[int, int, int, int, int] = (128, 128, 256, 256, 512)
    """Channels of the five convolutions; a pool follows the second and the fourth."""
    pool_neighbours: Neighbours = 4
    """Points of which a pool takes the greatest feature."""
    fuse: tuple[int, int] = (512, 512)
    """Channels of the layers on all features of a point together."""
    learning: Annotated[LearningConfig, tyro.conf.arg(name="")] = field(
        default_factory=LearningConfig
    )
    """Heads and training."""


def cpu_config() -> Gcn3dConfig:
    """The same network with three directions a kernel, fewer channels and points."""
    return Gcn3dConfig(
        preset="cpu",
        support=3,
        widths=(32, 32, 64, 64, 128),
        fuse=(128, 128),
        learning=LEAN,
    )


KEEP = 4
"""A pool keeps one point of so many."""
ROWS = 1 << 11
"""Points convolved at a time on the CPU, so that what is held fits a core's cache."""


class GreatestResponse(torch.autograd.Function):
    """max over neighbours n of relu(direction_n . kernel_c) * feature_nc, for every channel c.

    One neighbour at a time: neither forward nor backward pass holds a tensor with neighbours and
    channels. Directions get no gradient, as points are no parameters.
    """

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        directions: Tensor,
        kernels: Tensor,
        features: Tensor | None,
        index: Tensor,
    ) -> Tensor:
        """Directions (M, K, 3), kernels (3, C), features (R, C) or None for 1, index (M, K)."""
        rows = ROWS if directions.device.type == "cpu" else max(1, directions.shape[0])
        number = torch.uint8 if index.shape[1] <= 256 else torch.int16
        values, winners = [], []
        for there, near in zip(directions.split(rows), index.split(rows), strict=True):
            best = winner = None
            for n in range(there.shape[1]):
                value = (there[:, n] @ kernels).relu_()
                value = value if features is None else value.mul_(features[near[:, n]])
                if best is None or winner is None:
                    best, winner = value, torch.zeros_like(value, dtype=number)
                    continue
                winner.masked_fill_(value > best, n)
                best = torch.maximum(best, value)
            values.append(best)
            winners.append(winner)
        out, winner = torch.cat(values), torch.cat(winners)
        ctx.save_for_backward(directions, kernels, features, index, winner)
        return out

    @staticmethod
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        gradient: Tensor,
    ) -> tuple[None, Tensor, Tensor | None, None]:
        """To kernels and features, through the neighbour that won."""
        directions, kernels, features, index, winner = ctx.saved_tensors
        winner = winner.long()
        steps = [directions[..., axis].gather(1, winner) for axis in range(3)]  # (M, C) each
        x, y, z = (step * kernel for step, kernel in zip(steps, kernels, strict=True))
        cosine = (x + y + z).relu_()
        to_features = None
        to_cosine = gradient * (cosine > 0)
        if features is not None:
            row = index.gather(1, winner)
            to_features = torch.zeros_like(features).scatter_add_(0, row, gradient * cosine)
            to_cosine = to_cosine * features.gather(0, row)
        to_kernels = torch.stack([(step * to_cosine).sum(0) for step in steps])
        return None, to_kernels, to_features, None


@dataclass(frozen=True, slots=True, kw_only=True)
class Graph:
    """The neighbours of every point of a level, found once for all its layers."""

    index: Int[Tensor, "M K"]
    """Rows of all clouds, one after the other."""
    directions: Float[Tensor, "M K 3"]
    """Unit vectors to them; 0 to a point in the same place."""


@torch.no_grad()
def graph(points: Float[Tensor, "B N 3"], neighbours: int) -> Graph:
    """Each point's nearest neighbours but itself, fewer in a cloud with too few points."""
    count = points.shape[1]
    index = k_nearest(points, points, min(neighbours + 1, count))
    index = index[..., 1:] if count > 1 else index
    near = gather(points, index.flatten(1)).unflatten(1, index.shape[1:])
    directions = F.normalize(near - points[:, :, None], dim=-1)
    start = torch.arange(len(points), device=points.device)[:, None, None] * count
    return Graph(index=(index + start).flatten(0, 1), directions=directions.flatten(0, 1))


class Surface(nn.Module):
    """The first convolution, of a cloud without features: the greatest cosine of each direction."""

    def __init__(self, outputs: int, support: int) -> None:
        super().__init__()
        self.support = support
        self.directions = nn.Parameter(torch.zeros(3, support * outputs))

    def reset(self, generator: torch.Generator) -> None:
        """Uniform, by the number of kernels."""
        uniform(self.directions, self.directions.shape[1] ** -0.5, generator)

    def forward(self, neighbours: Graph) -> Float[Tensor, "M O"]:
        """One feature a point."""
        kernels = F.normalize(self.directions, dim=0)
        found = GreatestResponse.apply(neighbours.directions, kernels, None, neighbours.index)
        return found.unflatten(1, (self.support, -1)).sum(1)


class Convolution(nn.Module):
    """A linear map of the point itself plus the greatest responses of its neighbours."""

    def __init__(self, inputs: int, outputs: int, support: int) -> None:
        super().__init__()
        self.outputs, self.support = outputs, support
        self.weight = nn.Parameter(torch.zeros((support + 1) * outputs, inputs))
        self.bias = nn.Parameter(torch.zeros((support + 1) * outputs))
        self.directions = nn.Parameter(torch.zeros(3, support * outputs))

    def reset(self, generator: torch.Generator) -> None:
        """Uniform, by the number of channels that leave."""
        bound = self.weight.shape[0] ** -0.5
        for parameter in (self.weight, self.bias, self.directions):
            uniform(parameter, bound, generator)

    def forward(self, neighbours: Graph, x: Float[Tensor, "M I"]) -> Float[Tensor, "M O"]:
        """One feature a point."""
        x = at_least_float32(F.linear(x, self.weight, self.bias))
        own, others = x[:, : self.outputs], x[:, self.outputs :].contiguous()
        kernels = F.normalize(self.directions, dim=0)
        found = GreatestResponse.apply(neighbours.directions, kernels, others, neighbours.index)
        return own + found.unflatten(1, (self.support, -1)).sum(1)


def pooled(
    points: Float[Tensor, "B N 3"],
    x: Float[Tensor, "B N C"],
    neighbours: int,
    generator: torch.Generator | None,
) -> tuple[Float[Tensor, "B M 3"], Float[Tensor, "B M C"]]:
    """A quarter of the points, each with the greatest features of its neighbours, not its own.

    Args:
        points: Of a level.
        x: Their features.
        neighbours: Nearest points but itself of which the greatest counts, as many as there are.
        generator: Draws the quarter; None: every fourth point.
    """
    count = points.shape[1]
    kept = max(1, count // KEEP)
    if generator is None:
        chosen = evenly(count, kept)
    else:
        chosen = torch.randperm(count, generator=generator, device=generator.device)[:kept]
    centres = points[:, chosen.to(points.device)]
    index = k_nearest(centres, points, min(neighbours + 1, count))
    index = index[..., 1:] if count > 1 else index
    near = gather(x, index.flatten(1)).unflatten(1, index.shape[1:])
    return centres, near.amax(2)


class Gcn3dBody(Body):
    """Five convolutions on three levels, all features of a point and its place joined and fused.

    The place is ours: kernels see directions alone, and votes are places.
    """

    def __init__(self, config: Gcn3dConfig) -> None:
        super().__init__()
        self.config = config
        w, s = config.widths, config.support
        self.surface = Surface(w[0], s)
        self.convolutions = nn.ModuleList([Convolution(w[i], w[i + 1], s) for i in range(4)])
        self.norms = nn.ModuleList([nn.BatchNorm1d(w[i]) for i in (1, 2, 3)])
        joined = 3 + sum(w) + w[4]
        self.fuse = nn.Sequential(
            nn.Linear(joined, config.fuse[0]),
            nn.ReLU(),
            nn.Linear(config.fuse[0], config.fuse[1]),
            nn.ReLU(),
        )
        self.features, self.code, self.least_points = config.fuse[1], w[4], 1

    def forward(
        self, points: Float[Tensor, "B N 3"], generator: torch.Generator | None
    ) -> Features:
        """The pools are random where a generator is given."""
        config, batch = self.config, len(points)
        near = graph(points, config.neighbours)
        x0 = F.relu(self.surface(near))
        x1 = self._convolve(0, near, x0).unflatten(0, (batch, -1))
        middle, x = pooled(points, x1, config.pool_neighbours, generator)
        near = graph(middle, config.neighbours)
        x2 = self._convolve(1, near, x.flatten(0, 1))
        x3 = self._convolve(2, near, x2)
        coarse, x = pooled(middle, x3.unflatten(0, (batch, -1)), config.pool_neighbours, generator)
        x4 = self.convolutions[3](graph(coarse, config.neighbours), x.flatten(0, 1))
        code = x4.unflatten(0, (batch, -1)).amax(1)
        to_middle, to_coarse = nearest(points, middle), nearest(points, coarse)
        levels = [
            points,
            x0.unflatten(0, (batch, -1)),
            x1,
            *(gather(x.unflatten(0, (batch, -1)), to_middle) for x in (x2, x3)),
            gather(x4.unflatten(0, (batch, -1)), to_coarse),
            code[:, None].expand(-1, points.shape[1], -1),
        ]
        return Features(points=self.fuse(torch.cat(levels, -1)), code=code)

    def _convolve(self, number: int, near: Graph, x: Float[Tensor, "M I"]) -> Float[Tensor, "M O"]:
        """A convolution with its norm and ReLU."""
        return F.relu(self.norms[number](self.convolutions[number](near, x)))


class Gcn3d(SupervisedMethod):
    """3D-GCN with the heads of the supervised baselines."""

    name: ClassVar[str] = "gcn3d"

    def __init__(self, config: Gcn3dConfig, category: Category, generator: torch.Generator) -> None:
        """Draw the weights from `generator`."""
        super().__init__(config, category, lambda: Gcn3dBody(config), generator)

    @property
    def default(self) -> Gcn3dConfig:
        """Of its preset."""
        return Gcn3dConfig() if self.config.preset == "paper" else cpu_config()
