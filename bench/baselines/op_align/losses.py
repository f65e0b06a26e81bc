# SPDX-License-Identifier: MIT
"""OP-Align's terms, one pure function each; lengths are in normalised units (mean radius 0.25).

Chamfer terms take squared distances D to the nearest point in the robust form 1 - exp(-k D).
Neighbours are searched without gradient, which then passes through the matched points.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.points import gather, k_nearest, robust_chamfer, squared_distances
from scapo.geometry.rigid import rotation_between
from scapo.paper.heads import JointPairs

Scalar = Float[Tensor, ""]
FORWARD, BACKWARD = 30.0, 120.0
"""k of observed to canonical, and of canonical to observed, which counts 30/120."""


def rigid(observed: Float[Tensor, "B N 3"], canonical: Float[Tensor, "B M 3"]) -> Scalar:
    """L_rigid: the whole aligned cloud against the canonical shape, both ways."""
    return robust_chamfer(observed, canonical, forward=FORWARD, backward=BACKWARD).mean()


def articulated(
    moved: Float[Tensor, "B P N C"],
    canonical: Float[Tensor, "B M C"],
    weights: Float[Tensor, "B N P"],
    canonical_weights: Float[Tensor, "B M P"],
) -> Scalar:
    """L_art: the cloud under each part's map against the shape, weighted by the parts' weights.

    Args:
        moved: The aligned cloud carried to the canonical frame by the map of each part; weighted
            colours may follow the coordinates.
        canonical: The shape, likewise.
        weights: Of the aligned cloud.
        canonical_weights: Of the shape.
    """
    shape = canonical[:, None].expand(-1, moved.shape[1], -1, -1)
    there = 1 - torch.exp(-FORWARD * squared_distances(moved, shape))  # (B, P, N)
    back = 1 - torch.exp(-BACKWARD * squared_distances(shape, moved))  # (B, P, M)
    observed = (there * weights.mT).sum(1).mean()
    return observed + FORWARD / BACKWARD * (back * canonical_weights.mT).sum(1).mean()


def density(canonical: Float[Tensor, "B M 3"], neighbours: int) -> Scalar:
    """Variance over the points of the distance to the k-th neighbour, mean over k: even density."""
    with torch.no_grad():
        near = k_nearest(canonical, canonical, neighbours + 1)[..., 1:]  # (B, M, k)
    others = gather(canonical, near.flatten(1)).unflatten(1, near.shape[1:])
    square = (canonical[:, :, None] - others).square().sum(-1)
    return (square + 1e-12).sqrt().var(1).mean()


def centroid(canonical: Float[Tensor, "B M 3"]) -> Scalar:
    """Squared distance of the shape's centroid from the origin."""
    return canonical.mean(1).square().sum(-1).mean()


def pivot_near_points(
    pivot: Float[Tensor, "B J 3"], points: Float[Tensor, "B N 3"], neighbours: int = 8
) -> Scalar:
    """1 - exp(-30 r^2), r the mean distance of a pivot to its nearest points, which are fixed."""
    points = points.detach()
    near = k_nearest(pivot.detach(), points, min(neighbours, points.shape[1]))  # (B, J, k)
    others = gather(points, near.flatten(1)).unflatten(1, near.shape[1:])
    square = (pivot[:, :, None] - others).square().sum(-1)
    distance = (square + 1e-12).sqrt().mean(-1)
    return (1 - torch.exp(-FORWARD * distance.square())).mean()


def same_turn(source: JointPairs, target: JointPairs) -> Scalar:
    """Two joints should turn the frame alike, for three parts.

    Mean squared difference of the rotations between their axes in both shapes.
    """
    turn = rotation_between(source.axis, target.axis)  # (B, J, 3, 3)
    return (turn[:, 0] - turn[:, 1]).square().mean()


def same_base(first: Float[Tensor, "B N 3"], second: Float[Tensor, "B N 3"]) -> Scalar:
    """Mean squared distance between the cloud under the base's map of either joint."""
    return (first - second).square().sum(-1).mean()


def attention(weight: Float[Tensor, "B K"], distance: Float[Tensor, "B K"]) -> Scalar:
    """Expected distance under the attention: it learns which hypothesis fits."""
    return (weight * distance).sum(-1).mean()


def part_share(
    weights: Float[Tensor, "B N P"],
    canonical_weights: Float[Tensor, "B M P"],
    least: float = 0.05,
    floor: float = 0.01,
) -> Scalar:
    """No part of the shape is empty, and no point's weight of a part quite 0.

    A hinge on every part's mean weight in the shape, and one on the smallest weight of every
    point of both.
    """
    empty = F.relu(least - canonical_weights.mean(1)).mean()
    flat = [F.relu(floor - weight.amin(-1)).mean() for weight in (weights, canonical_weights)]
    return empty + flat[0] + flat[1]


BLOCK = 1 << 15
"""Distances held at a time on the CPU; a few thousand times as many elsewhere."""


@torch.no_grad()
def hypothesis_distances(
    aligned: Float[Tensor, "B K N C"], canonical: Float[Tensor, "B M C"]
) -> Float[Tensor, "B K"]:
    """Mean L1 distance of the points under each hypothesis to the nearest of the shape."""
    count, (n, m) = aligned.shape[1], (aligned.shape[2], canonical.shape[1])
    block = BLOCK if aligned.device.type == "cpu" else 4096 * BLOCK
    shape = canonical[:, None].expand(-1, count, -1, -1).flatten(0, 1)
    some = max(1, block // (n * m))
    pairs = zip(aligned.flatten(0, 1).split(some), shape.split(some), strict=True)
    means = [torch.cdist(a, b, p=1.0).amin(-1).mean(-1) for a, b in pairs]
    return torch.cat(means).view(-1, count)
