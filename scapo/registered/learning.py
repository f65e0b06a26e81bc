# SPDX-License-Identifier: MIT
"""What the network is shown of clouds, what it is taught of them, and what it says.

Clouds are looked at in frames of their own that turn with them (`SeenClouds`). The network learns
from the placements between which `quick` would choose (`candidates`), in views that are rolled
about their ray and thinned (`taught`), and is asked for a placement (`voted`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import Similarity, farthest_points, gather, nearest, normalise
from scapo.geometry.rigid import rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import Step, evenly
from scapo.records import cat, map_tensors, take
from scapo.registered.axis_deviation import refine_deviations
from scapo.registered.decode import nearest_weights
from scapo.registered.joint_limits import JointLimits
from scapo.registered.network import PointVotes, Target, random_frames, vote_losses
from scapo.registered.outliers import replaced
from scapo.registered.pose_search import LOSS_SHARE, Hypotheses
from scapo.registered.pseudo_labels import Candidates, PseudoLabels, ViewTargets
from scapo.registered.template import (
    ArticulatedTemplate,
    Placement,
    oriented,
    turn_placement,
)
from scapo.registered.view_network import (
    SMOOTH,
    TINY,
    ViewNetwork,
    ViewTarget,
    ViewVotes,
    along_rays,
    base_by_votes,
    placed_by_votes,
    view_losses,
)
from scapo.registered.views import PartialViews

FIRST = "votes"  # Stage of the network's first round; those after it are `round-2` and so on
NOISE = 0.003  # Normalised length: standard deviation of the points' noise while a network learns
SAMPLED = 2  # Times `count` points that are drawn from a cloud, of which the farthest are learned
THINNED = 0.2  # Share of a cloud's points that the network may not be shown in a step
OTHER_WAY = 0.4  # Rad: from about there on a part is turned another way than the network says
UNIT = 127  # Of stored normals
PRICE = 5.0  # Of a unit of loss by which the search prefers another candidate, in the network's
WORD, LEAST = 0.35, 0.02  # The network's share in a point's part, beside a search; a floor for both


@dataclass(frozen=True, slots=True, kw_only=True)
class Said:
    """What a network or a search says of clouds."""

    placement: Placement
    part_weight: Float[Tensor, "B N P"]
    sure: Float[Tensor, " B"]
    """Of the network 1 where its votes agree, to 0; of a search the margin of the best."""
    loss: Float[Tensor, " B"] | None = None
    """Of a search: of the best."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenClouds:
    """Clouds as every mode looks at them, normalised, in frames of their own."""

    points: Float[Tensor, "B N 3"]
    clean: Float[Tensor, "B N 3"]
    """With inliers in place of the outliers."""
    views: PartialViews
    frame: Float[Tensor, "B 3 3"]
    """own_R_cloud"""
    similarity: Similarity
    inlier: Bool[Tensor, "B N"]
    normals: Float[Tensor, "B N 3"]
    """Of `clean`, towards the camera."""
    up: Float[Tensor, "B 3"] | None = None
    """Against gravity, where that is known."""

    def part_weights(
        self, template: ArticulatedTemplate, placement: Placement, said: Said | None = None
    ) -> Float[Tensor, "B N P"]:
        """Of all points, by a placement of the template and by what the network says, if it does.

        A logarithmic pool (Genest and Zidek, 1986): a part that the template is sure of stays.
        """
        normals = self.normals * self.inlier[..., None]  # an outlier goes by where it lies
        weight = nearest_weights(template, self.points, normals, placement)
        if said is None:
            return weight
        word = (said.part_weight + LEAST).log()
        return ((weight + LEAST).log() + WORD * word).softmax(-1)


def taught_rows(total: int, count: int, stage: str) -> Int[Tensor, " K"]:
    """Training clouds that a round of the network learns from: so many, evenly spread, in order.

    Others than those of the round before, where there are enough: what a network says of clouds
    that it was taught is what it was taught, right or wrong.

    >>> taught_rows(10, 4, "votes"), taught_rows(10, 4, "round-2"), taught_rows(10, 4, "round-3")
    (tensor([0, 3, 6, 9]), tensor([0, 1, 4, 7]), tensor([0, 3, 6, 9]))
    """
    number = 0 if stage == FIRST else int(stage.rpartition("-")[2]) - 1
    apart = number % max(1, total // count)
    return ((evenly(total, count) + apart) % total).sort().values


def learned_row(step: Step, count: int) -> Int[Tensor, " B"]:
    """Which of the clouds that its round learns from, so many, a batch holds.

    Raises:
        ValueError: A cloud whose placement was not searched for.
    """
    learned = taught_rows(step.total, count, step.stage).to(step.index.device)
    row = torch.searchsorted(learned, step.index).clamp(max=len(learned) - 1)
    if bool((learned[row] != step.index).any()):
        raise ValueError("expected clouds whose placements were found, found others")
    return row


@torch.no_grad()
def candidates(
    template: ArticulatedTemplate,
    seen: SeenClouds,
    left: Hypotheses,
    limits: JointLimits,
) -> Candidates:
    """What `quick` would choose between, in each cloud's normalised frame.

    Args:
        template: Was searched for.
        seen: The clouds.
        left: What is left of the search.
        limits: Of states, outside which candidates are charged.
    """
    placement, best = left.placement, left.best(limits)
    penalty = limits.penalty(placement.state.unflatten(0, left.loss.shape))
    cost = left.loss + left.unlike + penalty
    rows = torch.arange(cost.numel(), device=cost.device).view_as(cost)
    if template.deviates():  # told of the best alone: it takes longer than all that was before
        row = rows.gather(1, cost.argmin(1, keepdim=True))[:, 0]
        fine, _ = refine_deviations(template, seen.views, take(placement, row), rounds=1, turns=1)
        index = rows.flatten().clone()
        index[row] = cost.numel() + torch.arange(len(row), device=row.device)
        placement = take(cat([placement, fine]), index)
    source, label = oriented(seen.points, seen.normals), template.logit.argmax(-1).to(torch.uint8)
    part = []
    for row in rows.unbind(1):
        placed = oriented(*template.place(take(placement, row)))
        part.append(label[nearest(source, placed)])
    back = seen.frame.mT.repeat_interleave(cost.shape[1], 0)
    return Candidates(
        placement=turn_placement(placement, back),
        part=torch.stack(part, 1),
        gap=cost - cost.amin(1, keepdim=True),
        margin=best.margin - LOSS_SHARE * best.loss,
        inlier=seen.inlier,
        normals=(UNIT * seen.normals @ seen.frame).round().to(torch.int8),
    )


def taught(
    network: ViewNetwork,
    template: ArticulatedTemplate,
    targets: ViewTargets,
    clouds: tuple[Float[Tensor, "B N 3"], Int[Tensor, " B"]],
    count: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Terms of the loss of a step: votes of some points of views, rolled at random and thinned.

    Args:
        network: Learns.
        template: Whose placements it learns.
        targets: Of all clouds that it learns from.
        clouds: Points in the camera's frame, and which of those clouds they are.
        count: Points of each that vote.
        generator: On the device of the clouds.
    """
    cloud, row = clouds
    points, similarity = normalise(replaced(cloud, targets.inlier[row]))
    camera = -similarity.centre * similarity.scale[:, None]  # the camera is the origin
    order = torch.randperm(points.shape[1], generator=generator, device=points.device)
    left_out = THINNED * torch.rand((), generator=generator, device=points.device)
    shown = order[: int(len(order) * (1 - left_out))]
    asked = shown[:count]
    turn = along_rays(camera, generator)
    part = targets.part[row].long()
    placement = targets.placement(row)
    placement = turn_placement(placement, turn.repeat_interleave(part.shape[1], 0))
    with torch.no_grad():
        poses = template.part_poses(placement)
    noise = torch.randn(points.shape, generator=generator, device=points.device)
    points = points @ turn.mT + NOISE * noise
    normals = targets.normals[row].to(points) / UNIT @ turn.mT
    votes = network(points[:, shown], normals[:, shown], len(asked))
    target = ViewTarget(
        poses=poses,
        part=part[..., asked],
        log_scale=targets.log_scale[row],
        shift=targets.shift[row],
        deviation=targets.deviation[row],
        price=PRICE * targets.gap[row],
        trust=targets.trust[row],
        aside=_aside(votes, template, targets, row) if len(targets.hinge) else None,
    )
    return view_losses(votes, points[:, asked], target)


def _aside(
    votes: ViewVotes, template: ArticulatedTemplate, targets: ViewTargets, row: Int[Tensor, " B"]
) -> Float[Tensor, "B C J"]:
    """How far hinges are from where the votes say, across their axes, by the trust in them."""
    axis = template.directions().detach()
    off = votes.pivot(template)[:, None] - targets.hinge[row]
    off = off - (off * axis).sum(-1, keepdim=True) * axis
    return targets.hung[row][:, None] * (off.square().sum(-1) + SMOOTH).sqrt()


def taught_in_principal_frames(
    network: PointVotes,
    template: ArticulatedTemplate,
    pseudo: PseudoLabels,
    clouds: tuple[Float[Tensor, "B N 3"], Int[Tensor, " B"]],
    count: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """The same for the network that is asked where nobody knows the camera.

    Args:
        network: Learns.
        template: Whose placements it learns.
        pseudo: Those of all clouds that it learns from.
        clouds: Points in the camera's frame, and which of those clouds they are.
        count: Points of each that vote.
        generator: On the device of the clouds.
    """
    cloud, row = clouds
    points, _ = normalise(replaced(cloud, pseudo.belonging[row]))
    index = torch.randperm(points.shape[1], generator=generator, device=points.device)
    points = points[:, index[: SAMPLED * count]]
    points = gather(points, farthest_points(points, min(count, points.shape[1])))
    frame = random_frames(points, generator)
    noise = torch.randn(points.shape, generator=generator, device=points.device) * NOISE
    with torch.no_grad():
        placement = take(pseudo.placement(), row)
        placed, _ = template.place(placement)
        target = Target(
            points=(points - placement.translation[:, None]) @ placement.rotation,
            part=template.logit.softmax(-1)[nearest(points, placed)],
            state=placement.state,
            log_scale=placement.log_scale,
            shift=placement.shift,
            camera=pseudo.camera[row],
            trust=pseudo.trust[row],
        )
    return vote_losses(network((points + noise) @ frame.mT), target)


@torch.no_grad()
def voted(
    network: ViewNetwork, template: ArticulatedTemplate, seen: SeenClouds, looks: int = 1
) -> Said:
    """What the network says, placements in the clouds' frames.

    It sees each cloud in as many rolls about the camera's ray as it has looks. What it says in them
    is averaged, where the base lies as in the look in which the votes agree best.
    """
    turns = 2 * torch.pi / looks * torch.arange(looks).to(seen.clean)
    roll = rotvec_to_rotmat(F.pad(turns[:, None], (2, 0)))
    turn = (roll[:, None] @ seen.views.look).flatten(0, 1)  # (L B, 3, 3)
    points, normals = (x.repeat(looks, 1, 1) @ turn.mT for x in (seen.clean, seen.normals))
    votes = network(points, normals, points.shape[1])
    rotation, sure = base_by_votes(votes, points)
    rotation = (turn.mT @ rotation).unflatten(0, (looks, -1))
    sure = sure.unflatten(0, (looks, -1))
    best = rotation[sure.argmax(0), torch.arange(sure.shape[1], device=sure.device)]
    weight = (rotation_angle(rotation, best.expand_as(rotation)) < OTHER_WAY) * sure.clamp_min(TINY)
    weight = weight / weight.sum(0)

    def mean(said: Tensor) -> Tensor:
        share = weight.view(looks, -1, *(1,) * (said.ndim - 1))
        return (share * said.unflatten(0, (looks, -1))).sum(0)

    votes = map_tensors(votes, mean)
    placement, sure = placed_by_votes(votes, seen.clean, template)
    if bool(network.hinged):
        placement = replace(placement, pivot=votes.pivot(template))
    return Said(placement=placement, part_weight=votes.part.softmax(-1), sure=sure)


def undeviated(placement: Placement) -> Placement:
    """About the category's axes and hinges, as a search begins."""
    return replace(placement, deviation=torch.zeros_like(placement.deviation), pivot=None)


def hinged_as(template: ArticulatedTemplate, said: Placement, found: Placement) -> Placement:
    """What a search found, with hinges where the network says, if both mean the same frame.

    Args:
        template: Whose placements they are.
        said: The network's of B views.
        found: Of the same views.
    """
    if said.pivot is None:
        return found
    apart = rotation_angle(said.rotation, found.rotation)[:, None, None]
    grown = (found.log_scale - said.log_scale).exp()[:, None]  # hinges sit on the base as it is
    pivot = torch.where(apart < OTHER_WAY, grown * said.pivot, template.pivots(found))
    return replace(found, pivot=pivot)


def dissent(
    template: ArticulatedTemplate,
    said: Said,
    hypotheses: Placement,
    price: float,
) -> Float[Tensor, "B F"]:
    """What hypotheses cost whose parts lie another way than the network says, by how sure it is.

    Args:
        template: Whose parts they are.
        said: The network's of B views.
        hypotheses: F of each, those of a view in a row.
        price: Loss that a part costs which is turned another way.
    """
    own = template.part_poses(said.placement).rotation[:, None]  # (B, 1, P, 3, 3)
    other = template.part_poses(hypotheses).rotation.unflatten(0, (len(own), -1))
    apart = rotation_angle(other, own.expand_as(other))
    return price * said.sure[:, None] * (1 - torch.exp(-(apart / OTHER_WAY).square())).sum(-1)
