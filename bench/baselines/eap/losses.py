# SPDX-License-Identifier: MIT
"""Distances of EAP: whole shapes, parts with their slots' weights, pivots near both parts.

Squared distances to the nearest point throughout; lengths in normalised units. Neighbours are
searched without gradient, which then passes through the matched points.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.geometry.points import squared_distances

Scalar = Float[Tensor, ""]


@torch.no_grad()
def shape_distances(
    clouds: Float[Tensor, "B K N 3"], shape: Float[Tensor, "B M 3"]
) -> Float[Tensor, "B K"]:
    """Two-way Chamfer distance of a shape from a cloud in the frames of K hypotheses."""
    shapes = shape[:, None].expand(-1, clouds.shape[1], -1, -1)
    there = squared_distances(clouds, shapes).mean(-1)
    return there + squared_distances(shapes, clouds).mean(-1)


def members_alone(
    points: Float[Tensor, "B N 3"], member: Bool[Tensor, "B N S"]
) -> Float[Tensor, "B S N 3"]:
    """The cloud of each slot: its members, and one of them in the place of every other point.

    A slot without members has the first point of the cloud throughout.
    """
    first = member.long().argmax(1)  # (B, S)
    stand_in = points.gather(1, first[..., None].expand(-1, -1, 3))
    return torch.where(member.mT[..., None], points[:, None], stand_in[:, :, None])


def slot_distances(
    posed: Float[Tensor, "B S K M 3"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N S"],
) -> Float[Tensor, "B S K"]:
    """Each slot's shape from the points that the slot has won, both ways; 0 for a slot with none.

    Points count by their weight of the slot, the shape's points alike.

    Args:
        posed: Shapes of all slots under K hypotheses.
        points: The cloud.
        weights: Of the slots.
    """
    member = torch.nn.functional.one_hot(weights.argmax(-1), weights.shape[-1]).bool()
    own = members_alone(points, member)[:, :, None].expand(-1, -1, posed.shape[2], -1, -1)
    share = (weights * member).mT[:, :, None]  # (B, S, 1, N)
    there = (squared_distances(own, posed) * share).sum(-1) / share.sum(-1).clamp_min(1e-8)
    back = squared_distances(posed, own).mean(-1)
    return (there + back) * member.any(1)[..., None]


def whole(
    posed: Float[Tensor, "B S M 3"], points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B S"]
) -> Scalar:
    """Two-way Chamfer distance of all shapes of slots with points from the cloud."""
    first = present.long().argmax(1)
    kept = posed[torch.arange(len(posed), device=posed.device), first][:, None, :1]
    shape = torch.where(present[..., None, None], posed, kept).flatten(1, 2)
    there = squared_distances(points, shape).mean(-1)
    return (there + squared_distances(shape, points).mean(-1)).mean()


def pivots_near_parts(
    pivot: Float[Tensor, "B J 3"],
    axis: Float[Tensor, "B 3"],
    pairs: Float[Tensor, "B J 2 M 3"],
    steps: Float[Tensor, " T"],
) -> Scalar:
    """Pivots, and they shifted along the axis, near both of the parts that they join.

    Args:
        pivot: One of each moving part.
        axis: Unit vector, of all joints.
        pairs: Points of the base and of the moving part of each joint; they do not move.
        steps: Lengths of the shifts, against the axis; the pivot itself counts once more.

    Returns:
        The sum over joints, parts and shifts of the squared distance, times 4 over the number of
        shifts, the mean over clouds.
    """
    steps = torch.cat([steps.new_zeros(1), steps])
    line = pivot[:, :, None] - steps[:, None] * axis[:, None, None]  # (B, J, T + 1, 3)
    both = line[:, :, None].expand(-1, -1, 2, -1, -1)
    square = squared_distances(both, pairs.detach())
    return 4 / (len(steps) - 1) * square.sum((1, 2, 3)).mean()
