# SPDX-License-Identifier: MIT
"""How each object of the training stands, so that all of its views are learned alike.

A template that fits an object upside down nearly as well as upright is placed wrongly in many of
its views, and a network that learns from these learns both. Views of one object need no template
to be brought together: its shape is the same in all. Then one rotation is left open for all of its
views, a quarter turn of the main directions of its surface. Which, a scorer tells that has learned
how views look that stand right (`orientation`), and the network once it has learned, by all views
of the object: they are wrong of these less often than of one, and seldom of the same objects. Views
of which both say another turn are left out: nearly half of them stand wrongly. So are objects of
which another turn is told nearly as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.records import cat, take
from scapo.registered.gauge import principal_frame
from scapo.registered.initialisation import FRAME_EVERY, registered_together, surest_of
from scapo.registered.objects import AGREEING
from scapo.registered.orientation import OrientationScorer, quarter_turns
from scapo.registered.pairwise import within
from scapo.registered.pseudo_labels import Candidates
from scapo.registered.views import PartialViews

NEAREST = 45.0  # Degrees within which a view is nearer to one quarter turn than to the others
NEAR = 30.0  # Degrees from its object's way within which a candidate says the same
AGAINST = 1.0  # Loss that another candidate costs
LEAST_NATS = -4.0  # What a view can hold against a way at most
LEAST_SHARE = 0.03  # Of the views that the network has standing in a way, beside what it says
MARGIN = 1.0  # Nats by which a way of standing has to lead the next: where it does not, it is open


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFrame:
    """Views of one object whose poses in a frame of its own are sure."""

    row: Int[Tensor, " V"]
    """Which of the clouds they are."""
    turn: Float[Tensor, "V 3 3"]
    """view_R_object"""
    views: PartialViews
    """What they show."""

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
    poses = registered_together(views, rotations, own=True)
    kept = surest_of(poses, AGREEING)
    turn = poses.rotation[kept].mT.contiguous()
    return ObjectFrame(row=row[kept], turn=turn, views=take(views, kept))


@torch.no_grad()
def how_objects_stand(
    frames: Sequence[ObjectFrame],
    scorer: OrientationScorer,
    said: Sequence[Float[Tensor, "V 3 3"]] | None = None,
) -> tuple[list[ObjectFrame], list[Float[Tensor, "3 3"]]]:
    """The objects that are told, with the views that say the same, and object_R_template.

    Args:
        frames: Of objects.
        scorer: Of frames of single views.
        said: view_R_template of all their views, by the network; None: it has not learned.
    """
    kept, ways = list[ObjectFrame](), list[Tensor]()
    for k, one in enumerate(frames):
        normals = one.views.normals[:, ::FRAME_EVERY] @ one.turn
        every = principal_frame(normals.flatten(0, 1)).mT @ quarter_turns()
        turns = one.turn[:, None] @ every  # (V, 24, 3, 3)
        nats = scorer(one.views, turns).log_softmax(-1)
        score, same = nats.clamp_min(LEAST_NATS).mean(0), F.one_hot(nats.argmax(1), len(every)) > 0
        if said is not None:
            near = within((turns * said[k][:, None]).sum((-1, -2)), NEAREST)
            score, same = score + (near.float().mean(0) + LEAST_SHARE).log(), same | near
        best = score.topk(2)
        likely = int(best.indices[0])
        if float(best.values[0] - best.values[1]) >= MARGIN:
            kept.append(take(one, same[:, likely]))
            ways.append(every[likely])
    return kept, ways


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
