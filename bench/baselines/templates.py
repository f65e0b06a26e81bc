# SPDX-License-Identifier: MIT
"""Templates fused from labelled training clouds: whole training objects, part by part.

One partial view is no training shape. Of each drawn object all training clouds are taken: true
part poses bring a part's points from every state and view into the part's own frame, where they
make its surface together, thinned by farthest-point sampling. Whole shapes are put together again
at some of the states in which the object was seen. Lengths are normalised as its clouds are: by the
median of the scales that `normalise` gives them, so that views and templates have one unit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.points import farthest_points, k_means, normalise
from scapo.geometry.rigid import apply, invert
from scapo.records import cat, take
from scapo.types import FullyLabelled, Labels, Observation

LEAST_POINTS = 11
"""Points of a part that can be registered, or registered to: small_gicp warns of fewer."""
ROUNDS = 20  # Of k-means over the states


@dataclass(frozen=True, slots=True, kw_only=True)
class Templates:
    """T fused objects of P parts, K points each, whole at S states; normalised lengths."""

    points: Float[Tensor, "T P K 3"]
    """Each part's in its own frame."""
    base_T_part: Float[Tensor, "T S P 4 4"]
    """Where the parts are at each of the states."""
    pivot: Float[Tensor, "T J 3"]
    """Frame of the base, as the axis."""
    axis: Float[Tensor, "T J 3"]

    @staticmethod
    def empty(parts: int) -> Templates:
        """None yet."""
        return Templates(
            points=torch.zeros(0, parts, 0, 3),
            base_T_part=torch.zeros(0, 0, parts, 4, 4),
            pivot=torch.zeros(0, parts - 1, 3),
            axis=torch.zeros(0, parts - 1, 3),
        )

    def whole(self) -> Float[Tensor, "T S N 3"]:
        """All parts at each state, one after the other, in the frame of the base."""
        return apply(self.base_T_part, self.points[:, None]).flatten(2, 3)


NAMES = tuple(field.name for field in fields(Templates))


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfig:
    """How many templates there are, and how fine."""

    templates: int = 5
    """Training objects that are drawn, all different (EAP's appendix: 5)."""
    states: int = 3
    """States of each object at which its parts make a whole template."""
    part_points: int = 1024
    """Points of each part of a template, by farthest-point sampling."""


@torch.no_grad()
def fuse(
    observation: Observation, labels: Labels, config: FusionConfig, generator: torch.Generator
) -> Templates:
    """Templates of objects drawn from the training clouds.

    Args:
        observation: Training clouds.
        labels: Parts, poses, joints and objects of those clouds.
        config: How many.
        generator: Draws the objects.

    Raises:
        ValueError: Labels are withheld, or fewer objects than templates show every part.
    """
    seen = FullyLabelled.of(observation, labels, "templates")
    whole = _shown_whole(seen.part, seen.instance, seen.camera_T_part.shape[1])
    if len(whole) < config.templates:
        raise ValueError(
            f"templates: expected at least {config.templates} training objects whose clouds show "
            f"every part (--templates), found {len(whole)}"
        )
    order = torch.randperm(len(whole), generator=generator, device=generator.device)
    chosen = whole[order[: config.templates].to(whole.device)]
    return cat([_fused(take(seen, seen.instance == number), config) for number in chosen])


def _shown_whole(
    part: Int[Tensor, "B N"], instance: Int[Tensor, " B"], parts: int
) -> Int[Tensor, " I"]:
    """Objects whose clouds have points enough of every part, in the order of their numbers."""
    known, which = instance.unique(return_inverse=True)
    count = F.one_hot(part + 1, parts + 1).sum(1)[:, 1:]
    total = count.new_zeros(len(known), parts).index_add(0, which, count)
    return known[(total >= LEAST_POINTS).all(1)]


def _fused(seen: FullyLabelled, config: FusionConfig) -> Templates:
    """The template of the one object that all these clouds show."""
    scale = normalise(seen.points)[1].scale.median()
    part_T_camera = invert(seen.camera_T_part)
    clouds = []
    for p in range(part_T_camera.shape[1]):
        own = (apply(part_T_camera[:, p], seen.points) * scale)[seen.part == p]
        index = farthest_points(own, min(config.part_points, len(own)))
        repeated = torch.arange(config.part_points, device=own.device) % len(index)
        clouds.append(own[index[repeated]])
    base_T_part = part_T_camera[:, :1] @ seen.camera_T_part
    base_T_part[..., :3, 3] *= scale
    state = spread_states(base_T_part[:, 1:, :3].flatten(1), config.states)
    base_T_camera = part_T_camera[:, 0]
    return Templates(
        points=torch.stack(clouds)[None],
        base_T_part=base_T_part[state][None],
        pivot=(apply(base_T_camera, seen.joints.pivot) * scale)[:1],
        axis=(seen.joints.axis @ base_T_camera[:, :3, :3].mT)[:1],
    )


def spread_states(feature: Float[Tensor, "B D"], count: int) -> Int[Tensor, " {count}"]:
    """Rows that stand for all: the nearest to each of the centres of k-means.

    Rows are repeated where there are fewer than `count`.
    """
    few = min(count, len(feature))
    centres = k_means(feature, feature[farthest_points(feature, few)], ROUNDS)
    index = torch.cdist(centres, feature).argmin(-1)
    return index[torch.arange(count, device=index.device) % few]
