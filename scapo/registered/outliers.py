# SPDX-License-Identifier: MIT
"""Outliers: points that do not belong to the object, which an imperfect mask let in.

A mask that is a little too wide takes points of the wall behind or the table below. They are few
and lie apart, so clusters that hold a small share of the points are left out. Repeated points, with
which sparse views are filled up, count for the size of a cluster but not for what is near.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
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
    distinct, which = _distinct(cloud)
    total = len(distinct)
    if total > MOST:
        some = distinct[torch.linspace(0, total - 1, MOST, device=cloud.device).long()]
        which = nearest(distinct, some)[which]
        distinct = some
    label = _clusters(distinct)[which]
    size = torch.bincount(label, minlength=len(distinct))
    return size[label] >= min(LEAST * len(cloud), float(size.max()))


def _distinct(cloud: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "M 3"], Int[Tensor, " N"]]:
    """Every point once, and which of these each point is; several times as fast as torch.unique."""
    points = cloud.cpu().numpy()
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    first = np.r_[True, (ordered[1:] != ordered[:-1]).any(1)]
    which = np.zeros(len(points), np.int64)
    which[order] = first.cumsum() - 1
    found, index = torch.from_numpy(ordered[first]), torch.from_numpy(which)
    return found.to(cloud.device), index.to(cloud.device)


def _clusters(points: Float[Tensor, "M 3"]) -> Int[Tensor, " M"]:
    """A number for each point, the same for all that short steps connect."""
    found = points.cpu().numpy()
    tree = KDTree(found)
    gap, near = tree.query(found, k=min(SPACING, len(found)))
    gap, near = gap.reshape(len(found), -1), near.reshape(len(found), -1)
    reach = REACH * float(torch.from_numpy(gap[:, -1]).median())
    rows, columns = np.nonzero(gap <= reach)
    label = _connected(rows, near[rows, columns], len(found))
    if label.any():  # not all in one piece by the nearest alone: all short steps are asked
        pairs = tree.query_pairs(reach, output_type="ndarray")
        label = _connected(pairs[:, 0], pairs[:, 1], len(found))
    return torch.from_numpy(label).to(points.device, torch.long)


def _connected(
    rows: Int[np.ndarray, " E"], columns: Int[np.ndarray, " E"], count: int
) -> Int[np.ndarray, " {count}"]:
    """Number of the connected component of each point, from 0 on."""
    edges = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(count, count))
    return connected_components(edges, directed=False)[1]


def replaced(points: Float[Tensor, "B N 3"], inlier: Bool[Tensor, "B N"]) -> Float[Tensor, "B N 3"]:
    """The clouds with every outlier replaced by an inlier, so that N stays."""
    order = inlier.int().argsort(dim=1, descending=True, stable=True)
    count = inlier.sum(1, keepdim=True)
    place = torch.arange(points.shape[1], device=points.device).expand_as(order)
    source = order.gather(1, place % count)  # outliers come last, and repeat the first ones
    return torch.empty_like(points).scatter(
        1, order[..., None].expand_as(points), points.gather(1, source[..., None].expand_as(points))
    )
