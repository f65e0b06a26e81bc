# SPDX-License-Identifier: MIT
"""Nearest neighbours, Chamfer distance, farthest-point sampling and normalisation of clouds.

Neighbours are found without autograd and gradients pass through the matched points only: the
gradient is the same and no (N, M) matrix is kept for the backward pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@torch.no_grad()
def nearest(
    source: Float[Tensor, "*B N 3"], target: Float[Tensor, "*B M 3"]
) -> Int[Tensor, "*B N"]:
    """Index into `target` of the nearest neighbour of each source point.

    Works on |t|^2 - 2 s.t, one matrix product, with the clouds moved to the target's centroid
    first: without that, coordinates a metre off cost float32 three digits.
    """
    centre = target.mean(-2, keepdim=True)
    source, target = source - centre, target - centre
    score = torch.matmul(source, target.mT).mul_(-2).add_(target.square().sum(-1)[..., None, :])
    return score.argmin(-1)


@torch.no_grad()
def k_nearest(
    source: Float[Tensor, "*B N 3"], target: Float[Tensor, "*B M 3"], k: int
) -> Int[Tensor, "*B N {k}"]:
    """Indices into `target` of the k nearest neighbours of each source point, nearest first."""
    centre = target.mean(-2, keepdim=True)
    source, target = source - centre, target - centre
    score = torch.matmul(source, target.mT).mul_(-2).add_(target.square().sum(-1)[..., None, :])
    return score.topk(k, dim=-1, largest=False).indices


def gather(points: Float[Tensor, "*B M C"], index: Int[Tensor, "*B K"]) -> Float[Tensor, "*B K C"]:
    """points[..., index, :] per batch element."""
    return points.gather(-2, index[..., None].expand(*index.shape, points.shape[-1]))


def squared_distances(
    source: Float[Tensor, "*B N 3"], target: Float[Tensor, "*B M 3"]
) -> Float[Tensor, "*B N"]:
    """Squared distance of each source point to its nearest target point, with gradients."""
    return (source - gather(target, nearest(source, target))).square().sum(-1)


def chamfer(a: Float[Tensor, "*B N 3"], b: Float[Tensor, "*B M 3"]) -> Float[Tensor, "*B"]:
    """Mean squared nearest-neighbour distance, both ways added."""
    return squared_distances(a, b).mean(-1) + squared_distances(b, a).mean(-1)


def robust_chamfer(
    a: Float[Tensor, "*B N 3"],
    b: Float[Tensor, "*B M 3"],
    *,
    forward: float,
    backward: float,
) -> Float[Tensor, "*B"]:
    """mean(1 - exp(-f D_ab)) + (f / b) mean(1 - exp(-b D_ba)), D squared distances.

    OP-Align's form for partial clouds (PROTOCOL 3.1, L_rigid), f = `forward`, b = `backward`:
    a point of the shape far from every observed point costs a bounded amount.
    """
    there = 1 - torch.exp(-forward * squared_distances(a, b))
    back = 1 - torch.exp(-backward * squared_distances(b, a))
    return there.mean(-1) + forward / backward * back.mean(-1)


@torch.no_grad()
def farthest_points(
    points: Float[Tensor, "*B N 3"], count: int, *, start: int = 0
) -> Int[Tensor, "*B {count}"]:
    """Indices of farthest-point sampling, beginning with point `start`."""
    chosen = torch.full(points.shape[:-2], start, device=points.device)
    distance = torch.full(points.shape[:-1], torch.inf, dtype=points.dtype, device=points.device)
    indices = [chosen]
    for _ in range(count - 1):
        latest = gather(points, chosen[..., None])
        distance = torch.minimum(distance, (points - latest).square().sum(-1))
        chosen = distance.argmax(-1)
        indices.append(chosen)
    return torch.stack(indices, -1)


MEAN_RADIUS = 0.25
"""Mean distance of the points from their centroid after `normalise` (PROTOCOL 1.7): a length of 1
is 4 times the mean radius of that cloud."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """normalised = (metric - centre) * scale."""

    scale: Float[Tensor, "*B"]
    centre: Float[Tensor, "*B 3"]

    def forward(self, points: Float[Tensor, "*B K 3"]) -> Float[Tensor, "*B K 3"]:
        """Metres to normalised units."""
        return (points - self.centre[..., None, :]) * self.scale[..., None, None]

    def inverse(self, points: Float[Tensor, "*B K 3"]) -> Float[Tensor, "*B K 3"]:
        """Normalised units to metres."""
        return points / self.scale[..., None, None] + self.centre[..., None, :]

    def inverse_pose(self, pose: Float[Tensor, "*B P 4 4"]) -> Float[Tensor, "*B P 4 4"]:
        """normalised_T_part, translations in normalised units, to metres about `centre`."""
        out = pose.clone()
        out[..., :3, 3] = self.inverse(pose[..., :3, 3])
        return out


def normalise(points: Float[Tensor, "*B N 3"]) -> tuple[Float[Tensor, "*B N 3"], Similarity]:
    """Centre on the centroid and scale to mean radius 0.25.

    Raises:
        ValueError: All points of a cloud coincide, or a coordinate is not finite.
    """
    centre = points.mean(-2)
    radius = (points - centre[..., None, :]).norm(dim=-1).mean(-1)
    if not bool((torch.isfinite(radius) & (radius > 0)).all()):
        raise ValueError("cloud: expected finite points that differ, found mean radius 0 or NaN")
    similarity = Similarity(scale=MEAN_RADIUS / radius, centre=centre)
    return similarity.forward(points), similarity
