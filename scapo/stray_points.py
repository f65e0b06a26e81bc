# SPDX-License-Identifier: MIT
"""Points that do not belong to the object: what an imperfect mask lets in.

A mask that is a little too wide takes points of the wall behind or the table below. They are few
and lie apart, so clusters that hold a small share of the points are left out.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH = 3.5
"""Points nearer than this many typical spacings belong together."""
LEAST = 0.03
"""Share of the points that a cluster must hold."""


@torch.no_grad()
def belongs(points: Float[Tensor, "B N 3"]) -> Bool[Tensor, "B N"]:
    """Which points belong to the object: those of every cluster that is not small.

    The largest cluster always does.
    """
    return torch.stack([_belongs(cloud) for cloud in points])


def _belongs(cloud: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
    gap = torch.cdist(cloud, cloud)
    spacing = gap.kthvalue(min(7, len(cloud)), dim=1).values.median()
    apart = gap > REACH * spacing
    label = torch.arange(len(cloud), device=cloud.device)
    while True:
        around = label.expand(len(cloud), -1).masked_fill(apart, len(cloud)).amin(1)
        around = around[around]
        if bool((around == label).all()):
            break
        label = around
    size = torch.bincount(label, minlength=len(cloud))
    return size[label] >= min(LEAST * len(cloud), float(size.max()))


def replaced(
    points: Float[Tensor, "B N 3"], belonging: Bool[Tensor, "B N"]
) -> Float[Tensor, "B N 3"]:
    """The clouds with every stray replaced by a point that belongs, so that N stays."""
    order = belonging.int().argsort(dim=1, descending=True, stable=True)
    count = belonging.sum(1, keepdim=True)
    place = torch.arange(points.shape[1], device=points.device).expand_as(order)
    source = order.gather(1, place % count)  # strays come last, and repeat the first ones
    return torch.empty_like(points).scatter(
        1, order[..., None].expand_as(points), points.gather(1, source[..., None].expand_as(points))
    )


def without_strays(points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
    """The clouds with strays replaced by points that belong."""
    return replaced(points, belongs(points))
