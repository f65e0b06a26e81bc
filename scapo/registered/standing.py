# SPDX-License-Identifier: MIT
"""How each object of the training stands, so that all of its views are learned alike.

A template that fits an object upside down nearly as well as upright is placed wrongly in many of
its views, and a network that learns from these learns both. Views of one object need no template
to be brought together: its shape is the same in all. Then one rotation is left open for all of its
views, and two things tell it: on how many of the views' candidates a way agrees, and where the
cameras would have stood, which is much the same for all objects of a category.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.records import cat, take
from scapo.registered.initialisation import registered_together, surest_of
from scapo.registered.object_frames import Ways, ways_of
from scapo.registered.objects import AGREEING
from scapo.registered.pairwise import OWN_HIDDEN_COST, within
from scapo.registered.pose_search import VOTE
from scapo.registered.pseudo_labels import Candidates
from scapo.registered.views import PartialViews

CAMERAS = 0.2  # Share of votes that a way is worth by which cameras are e times likelier
SHARP, LEAST_LIKELY = 8.0, 0.02
"""Concentration of directions about each camera of the other objects, and the density at least."""
SWEEPS = 10  # Over all objects, in which each takes the way that goes best with the others
NEAR = 30.0  # Degrees from its object's way within which a candidate says the same
AGAINST = 1.0  # Loss that another candidate costs


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFrame:
    """Views of one object whose poses in a frame of its own are sure."""

    row: Int[Tensor, " V"]
    """Which of the clouds they are."""
    turn: Float[Tensor, "V 3 3"]
    """view_R_object"""
    camera: Float[Tensor, "V 3"]
    """Directions to the cameras in that frame."""

    def rotation(self, way: Float[Tensor, "3 3"]) -> Float[Tensor, "V 3 3"]:
        """view_R_template, where the template stands in the object's frame so."""
        return self.turn @ way


def frame_of(row: Int[Tensor, " N"], views: PartialViews, rotations: int) -> ObjectFrame:
    """The frame on which registrations of an object's views with one another agree.

    Args:
        row: Which clouds the views are.
        views: All of one size.
        rotations: How many are tried for each pair.
    """
    poses = registered_together(views, rotations, OWN_HIDDEN_COST)
    kept = surest_of(poses, AGREEING)
    turn = poses.rotation[kept]
    camera = (turn @ views.direction()[kept][..., None])[..., 0]
    return ObjectFrame(row=row[kept], turn=turn.mT.contiguous(), camera=camera)


@torch.no_grad()
def how_objects_stand(
    found: Candidates, frames: Sequence[ObjectFrame]
) -> list[Float[Tensor, "3 3"]]:
    """object_R_template of each object.

    Args:
        found: Of all clouds.
        frames: Of objects.
    """
    vote = torch.softmax(-VOTE * found.gap, 1)
    turn = found.placement.rotation.unflatten(0, found.gap.shape)
    ways = [ways_of(one.turn.mT[:, None] @ turn[one.row], vote[one.row]) for one in frames]
    chosen = [0] * len(frames)
    for _ in range(SWEEPS):
        likely = _likely(frames, ways, chosen)
        before = chosen
        chosen = [
            int((way.share + CAMERAS * its).argmax()) for way, its in zip(ways, likely, strict=True)
        ]
        if chosen == before:
            break
    return [way.frame[k] for way, k in zip(ways, chosen, strict=True)]


def _likely(
    frames: Sequence[ObjectFrame], ways: Sequence[Ways], chosen: Sequence[int]
) -> list[Float[Tensor, " M"]]:
    """Mean log density of an object's cameras, for each of its ways, where others' cameras are."""
    cameras = [one.camera @ way.frame[k] for one, way, k in zip(frames, ways, chosen, strict=True)]
    found: list[Tensor] = []
    for k, (one, way) in enumerate(zip(frames, ways, strict=True)):
        others = cameras[:k] + cameras[k + 1 :]
        cosine = (one.camera @ way.frame) @ torch.cat(others or cameras).mT  # (M, V, others)
        density = torch.exp(SHARP * (cosine - 1)).mean(-1)
        found.append((density + LEAST_LIKELY).log().mean(-1))
    return found


def agreeing(
    found: Candidates, frames: Sequence[ObjectFrame], ways: Sequence[Float[Tensor, "3 3"]]
) -> tuple[Candidates, Bool[Tensor, " B"]]:
    """Candidates, charged where they stand otherwise than their object, and whose best does not.

    Clouds of which no object's frame is known stay as they are, and do not agree.

    Args:
        found: Of all clouds.
        frames: Of objects.
        ways: object_R_template of each.
    """
    turn = found.placement.rotation.unflatten(0, found.gap.shape)
    gap, agrees = found.gap.clone(), torch.zeros(len(found.gap), dtype=torch.bool)
    for one, way in zip(frames, ways, strict=True):
        wanted = one.rotation(way)[:, None]
        near = within((turn[one.row] * wanted).sum((-1, -2)), NEAR)
        cost = gap[one.row] + AGAINST * ~near
        gap[one.row], agrees[one.row] = cost - cost.amin(1, keepdim=True), near.any(1)
    return replace(found, gap=gap), agrees


def against(
    agrees: Bool[Tensor, " B"],
    frames: Sequence[ObjectFrame],
    ways: Sequence[Float[Tensor, "3 3"]],
) -> tuple[Int[Tensor, " K"], Float[Tensor, "K 3 3"]]:
    """Clouds that do not agree with their object, and view_R_template as if they did."""
    row = torch.cat([one.row for one in frames])
    wanted = torch.cat([one.rotation(way) for one, way in zip(frames, ways, strict=True)])
    left = ~agrees[row]
    return row[left], wanted[left]


def exchanged(found: Candidates, row: Int[Tensor, " K"], other: Candidates) -> Candidates:
    """Candidates, those of some clouds in place of what they were."""
    count, total = found.gap.shape[1], len(found.gap)
    every = torch.arange(total * count).view(total, count)
    every[row] = total * count + torch.arange(len(row) * count).view(-1, count)
    placement = take(cat([found.placement, other.placement]), every.flatten())
    rest = {
        field.name: getattr(found, field.name).index_copy(0, row, getattr(other, field.name))
        for field in fields(found)
        if field.name != "placement"
    }
    return Candidates(placement=placement, **rest)
