# SPDX-License-Identifier: MIT
"""Similarities between two sets of matched points, robustly: RANSAC over many clouds at once.

Every cloud draws the same random numbers, so that an answer depends on the cloud alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import gather
from scapo.geometry.rigid import project_rotation
from scapo.records import cat

SAMPLE = 3
"""Matches that fix a similarity."""
CHUNK = 16
"""Clouds at a time: residuals of all draws are held."""
TINY = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarities:
    """target = scale * rotation source + shift."""

    scale: Float[Tensor, "*B"]
    rotation: Float[Tensor, "*B 3 3"]
    shift: Float[Tensor, "*B 3"]

    def residual(
        self, target: Float[Tensor, "*#B N 3"], source: Float[Tensor, "*#B N 3"]
    ) -> Float[Tensor, "*B N"]:
        """Distance of each target from where its source is taken."""
        placed = source @ self.rotation.mT * self.scale[..., None, None] + self.shift[..., None, :]
        return (target - placed).norm(dim=-1)


def fit(
    target: Float[Tensor, "*B N 3"], source: Float[Tensor, "*B N 3"], weight: Float[Tensor, "*B N"]
) -> Similarities:
    """The weighted least squares similarity (Umeyama, PAMI 1991)."""
    weight = (weight / weight.sum(-1, keepdim=True).clamp_min(TINY))[..., None]
    target_mean, source_mean = (weight * target).sum(-2), (weight * source).sum(-2)
    target, source = target - target_mean[..., None, :], source - source_mean[..., None, :]
    cross = (weight * target).mT @ source
    rotation = project_rotation(cross)
    spread = (weight * source.square()).sum((-1, -2))
    scale = (cross * rotation).sum((-1, -2)) / spread.clamp_min(TINY)
    shift = target_mean - scale[..., None] * (rotation @ source_mean[..., None])[..., 0]
    return Similarities(scale=scale, rotation=rotation, shift=shift)


@torch.no_grad()
def ransac(
    target: Float[Tensor, "B N 3"],
    source: Float[Tensor, "B N 3"],
    member: Bool[Tensor, "B N"],
    threshold: float,
    draws: int,
) -> Similarities:
    """The similarity that most of the member matches agree on within the threshold.

    Three members are drawn each time; the best draw is fitted twice to what it explains. Scales
    outside [1/2, 2] are none of a part's.

    Args:
        target: Where the points are.
        source: Where each says that it comes from.
        member: Which matches count, at least three of every cloud.
        threshold: In the unit of the target.
        draws: Of three members each.
    """
    chunks = zip(target.split(CHUNK), source.split(CHUNK), member.split(CHUNK), strict=True)
    return cat([_ransac(a, b, counts, threshold, draws) for a, b, counts in chunks])


def _ransac(
    target: Float[Tensor, "B N 3"],
    source: Float[Tensor, "B N 3"],
    member: Bool[Tensor, "B N"],
    threshold: float,
    draws: int,
) -> Similarities:
    chosen = _draw(member, draws)  # (B, D, 3)
    ones = torch.ones_like(chosen, dtype=target.dtype)
    some = [gather(x, chosen.flatten(1)).unflatten(1, chosen.shape[1:]) for x in (target, source)]
    tried = fit(some[0], some[1], ones)
    good = (tried.residual(target[:, None], source[:, None]) < threshold) & member[:, None]
    sound = (tried.scale > 0.5) & (tried.scale < 2)
    votes = torch.where(sound, good.sum(-1), -1)
    best = votes.argmax(1)[:, None, None].expand(-1, 1, target.shape[1])
    inlier = good.gather(1, best)[:, 0]
    found = _fit_inliers(target, source, member, inlier)
    inlier = (found.residual(target, source) < threshold) & member
    return _fit_inliers(target, source, member, inlier)


def _fit_inliers(
    target: Float[Tensor, "B N 3"],
    source: Float[Tensor, "B N 3"],
    member: Bool[Tensor, "B N"],
    inlier: Bool[Tensor, "B N"],
) -> Similarities:
    """To all members where there are too few inliers."""
    few = inlier.sum(1, keepdim=True) < SAMPLE
    return fit(target, source, torch.where(few, member, inlier).to(target.dtype))


def _draw(member: Bool[Tensor, "B N"], draws: int) -> Int[Tensor, "B D 3"]:
    """Indices of different members, from the same random numbers for every cloud."""
    generator = torch.Generator().manual_seed(0)
    uniform = torch.rand(draws, SAMPLE, generator=generator).to(member.device)
    first = (~member).long().argsort(dim=1, stable=True)  # members come first
    count = member.sum(1)[:, None]  # (B, 1)
    # The second and third skip those before them, so that no match is drawn twice.
    one = (uniform[:, 0] * count).long()
    two = (uniform[:, 1] * (count - 1)).long()
    three = (uniform[:, 2] * (count - 2)).long()
    two = two + (two >= one)
    low, high = torch.minimum(one, two), torch.maximum(one, two)
    three = three + (three >= low)
    three = three + (three >= high)
    picked = torch.stack([one, two, three], -1)  # (B, D, 3)
    return first.gather(1, picked.flatten(1)).view_as(picked)
