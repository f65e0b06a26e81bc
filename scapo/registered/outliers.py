# SPDX-License-Identifier: MIT
"""Outliers: points that do not belong to the object, which an imperfect mask let in.

A mask that is a little too wide takes points of the wall behind or the table below. They are few
and lie apart, so clusters that hold a small share of the points are left out. Repeated points, with
which sparse views are filled up, count for the size of a cluster but not for what is near.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import nearest

SPACING = 7  # The distance to the nearest but so many, itself the first, is a point's spacing
REACH = 3.5  # Points nearer than this many typical spacings belong together
LEAST = 0.03  # Share of the points that a cluster must hold
MOST = 2048
"""Points whose distances are taken to one another; of a larger cloud the rest go by the nearest."""


@torch.no_grad()
def inlier_mask(points: Float[Tensor, "B N 3"]) -> Bool[Tensor, "B N"]:
    """Which points belong to the object: those of every cluster that is not small.

    The largest cluster always does.
    """
    return torch.stack([_inliers(cloud) for cloud in points])


def _inliers(cloud: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
    distinct, which = torch.unique(cloud, dim=0, return_inverse=True)
    total = len(distinct)
    if total > MOST:
        some = distinct[torch.linspace(0, total - 1, MOST, device=cloud.device).long()]
        which = nearest(distinct, some)[which]
        distinct = some
    label = _clusters(distinct)[which]
    size = torch.bincount(label, minlength=len(distinct))
    return size[label] >= min(LEAST * len(cloud), float(size.max()))


def _clusters(points: Float[Tensor, "M 3"]) -> Int[Tensor, " M"]:
    """The smallest index of all points that are connected to each by short steps."""
    gap = torch.cdist(points, points)
    spacing = gap.kthvalue(min(SPACING, len(points)), dim=1).values.median()
    apart = (gap > REACH * spacing).fill_diagonal_(False)
    label = torch.arange(len(points), device=points.device)
    while True:
        around = label.expand(len(points), -1).masked_fill(apart, len(points)).amin(1)
        around = around[around]
        if bool((around == label).all()):
            return label
        label = around


def replaced(points: Float[Tensor, "B N 3"], inlier: Bool[Tensor, "B N"]) -> Float[Tensor, "B N 3"]:
    """The clouds with every outlier replaced by an inlier, so that N stays."""
    order = inlier.int().argsort(dim=1, descending=True, stable=True)
    count = inlier.sum(1, keepdim=True)
    place = torch.arange(points.shape[1], device=points.device).expand_as(order)
    source = order.gather(1, place % count)  # outliers come last, and repeat the first ones
    return torch.empty_like(points).scatter(
        1, order[..., None].expand_as(points), points.gather(1, source[..., None].expand_as(points))
    )
