# SPDX-License-Identifier: MIT
"""Distances of EAP: whole shapes, parts with their slots' weights, pivots near both parts.

Squared distances to the nearest point throughout; lengths in normalised units. Neighbours are
searched without gradient, which then passes through the matched points.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.geometry.points import chamfer, squared_distances

Scalar = Float[Tensor, ""]


@torch.no_grad()
def shape_distances(
    clouds: Float[Tensor, "B K N 3"], shape: Float[Tensor, "B M 3"]
) -> Float[Tensor, "B K"]:
    """Two-way Chamfer distance of a shape from a cloud in the frames of K hypotheses."""
    shapes = shape[:, None].expand(-1, clouds.shape[1], -1, -1)
    return chamfer(clouds, shapes)


def slot_distances(
    posed: Float[Tensor, "B S K M 3"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N S"],
) -> Float[Tensor, "B K"]:
    """Every point from every slot's shape, as far as its weight gives it to that slot.

    One way: squared distance of a point to the nearest of the slot's shape times its weight of
    the slot, summed over slots, mean over points. So the weights are drawn to the slot that fits.

    Args:
        posed: Shapes of all slots under K hypotheses.
        points: The cloud.
        weights: Of the slots, rows on the simplex.
    """
    cloud = points[:, None, None].expand(-1, *posed.shape[1:3], -1, -1)
    return (squared_distances(cloud, posed) * weights.mT[:, :, None]).sum(1).mean(-1)


def whole(
    posed: Float[Tensor, "B S M 3"], points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B S"]
) -> Scalar:
    """Two-way Chamfer distance of all shapes of slots with points from the cloud.

    Shapes of other slots are left out both ways: no point is near to them, and they count nowhere.
    """
    rows = torch.arange(len(posed), device=posed.device)
    stand_in = posed[rows, present.long().argmax(1)][:, None]  # of a slot that is there anyway
    shape = torch.where(present[..., None, None], posed, stand_in).flatten(1, 2)
    share = present.to(posed.dtype).repeat_interleave(posed.shape[2], 1)  # (B, S M)
    back = (squared_distances(shape, points) * share).sum(1) / share.sum(1)
    return (squared_distances(points, shape).mean(1) + back).mean()


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
