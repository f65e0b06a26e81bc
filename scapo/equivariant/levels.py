# SPDX-License-Identifier: MIT
"""Sampled points and their neighbours with kernel weights: found once, shared by all layers.

The kernel of every convolution is the 12 vertices of the icosahedron at 0.7 of the radius and the
centre (Zhu et al., CVPR 2023). A rotation of the group maps this set to itself: correlations with
13 points serve all anchors, and a rotated kernel is a permuted one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.equivariant.anchors import VERTICES, icosahedron
from scapo.geometry.numerics import uncompiled
from scapo.geometry.points import farthest_points, gather

Sampling = Literal["stride", "farthest"]
KERNEL = VERTICES + 1
"""Kernel points: the vertices in their order, then the centre."""
SHELL = 0.7
"""Distance of the vertices from the centre in radii (EPN, E2PN)."""
SIGMA = 0.5
"""Squared reach of a kernel point in squared radii (EPN)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbourhood:
    """From M source points to K centres; no gradient passes through it."""

    centre: Int[Tensor, "B K"]
    """Which of the source points the centres are."""
    index: Int[Tensor, "B K L"]
    """Source points near each centre."""
    weight: Float[Tensor, "B K 13 L"]
    """How much each of them counts at each kernel point; sums over L are means of the group."""


def kernel_points(radius: float) -> Float[Tensor, "13 3"]:
    """The 12 vertices at 0.7 of the radius and the centre, float64."""
    return torch.cat([SHELL * radius * icosahedron().vertices, torch.zeros(1, 3).double()])


@torch.no_grad()
def in_ball(
    centres: Float[Tensor, "B K 3"], points: Float[Tensor, "B M 3"], radius: float, count: int
) -> tuple[Int[Tensor, "B K L"], Bool[Tensor, "B K L"]]:
    """The first `count` points, in the cloud's order, within the radius of each centre.

    The order is none of distance, so that a group is spread over its ball. L is `count`, or the
    number of points where there are fewer.

    Returns:
        Indices into `points`, and whether each is within the radius: a group with fewer is filled
        up with any.
    """
    number = points.shape[1]
    # By products, the distance of points a step apart would lose half of its digits.
    distance = torch.cdist(centres, points, compute_mode="donot_use_mm_for_euclid_dist")
    order = torch.arange(number, 0, -1, device=points.device, dtype=torch.float32)
    top, index = (order * (distance <= radius)).topk(min(count, number), -1)
    return index, top > 0


@torch.no_grad()
@uncompiled
def neighbourhood(
    points: Float[Tensor, "B M 3"], centre: Int[Tensor, "B K"], radius: float, count: int
) -> Neighbourhood:
    """Neighbours of some of the points among all, and their weights at the kernel points.

    A weight is relu(1 - d^2 / (SIGMA radius^2)) over the number of neighbours, d the distance of
    the neighbour from the kernel point (Chen et al., CVPR 2021, with the mean for the sum, so that
    the density of a cloud does not matter).

    Args:
        points: In any frame and unit.
        centre: Which points are centres.
        radius: Of the group, in the unit of the points.
        count: Most neighbours of a group.
    """
    centres = gather(points, centre)
    index, inside = in_ball(centres, points, radius, count)
    near = gather(points, index.flatten(1)).unflatten(1, index.shape[1:]) - centres[:, :, None]
    kernel = kernel_points(radius).to(near)
    squares = (near[:, :, None] - kernel[:, None]).square().sum(-1)  # (B, K, 13, L)
    weight = (1 - squares / (SIGMA * radius**2)).relu() * inside[:, :, None]
    weight = weight / inside.sum(-1).clamp_min(1)[..., None, None]
    return Neighbourhood(centre=centre, index=index, weight=weight)


@torch.no_grad()
@uncompiled
def sample(points: Float[Tensor, "B M 3"], stride: int, how: Sampling) -> Int[Tensor, "B K"]:
    """Every `stride`-th point of the cloud's order, or as many by farthest-point sampling."""
    batch, number, _ = points.shape
    count = max(1, number // stride)
    if how == "farthest" and stride > 1:
        return farthest_points(points, count)
    return (torch.arange(count, device=points.device) * stride).expand(batch, count)


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelConfig:
    """One convolution of a network."""

    radius: float
    """Radius of the groups, in the unit of the points."""
    neighbours: int
    """Most points of a group."""
    stride: int = 1
    """The layer keeps one point of so many."""


@torch.no_grad()
def levels(
    points: Float[Tensor, "B N 3"], layers: tuple[LevelConfig, ...], how: Sampling = "stride"
) -> tuple[list[Neighbourhood], list[Float[Tensor, "B _ 3"]]]:
    """What every layer of a network needs to know of a cloud, equal layers once.

    Returns:
        A neighbourhood for each layer, and the points that each layer ends at.
    """
    found: list[Neighbourhood] = []
    ends: list[Tensor] = []
    before: LevelConfig | None = None
    for layer in layers:
        if layer != before or layer.stride > 1:
            centre = sample(points, layer.stride, how)
            found.append(neighbourhood(points, centre, layer.radius, layer.neighbours))
            points = gather(points, centre)
        else:
            found.append(found[-1])
        ends.append(points)
        before = layer
    return found, ends
