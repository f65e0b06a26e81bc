# SPDX-License-Identifier: MIT
"""A small network that sees a view as an image along the camera's ray, and votes for its pose.

A single view has one depth in every direction, so an image loses nothing of it, and convolutions
read one in a fraction of the time that groups of neighbours take. The cloud is turned so that the
camera's ray is z (about it any roll is as good, and all are learned from) and drawn on a grid; an
encoder and a decoder give every point features, from which it says where it lies in the frame of
every part of the template, and which part it belongs to. A Procrustes step for each part turns
the votes into poses, these into a placement of the template. The image's code says the rest of a
placement: sizes, where joints sit, how axes deviate.

It is taught placements that a search found (`targets`). Where the search left several open, the
one counts that costs the network least beside what it costs the search: what many views have in
common decides which way an object of two like halves lies.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.geometry.points import MEAN_RADIUS
from scapo.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from scapo.registered.network import procrustes
from scapo.registered.template import ArticulatedTemplate, PartPoses, Placement
from scapo.registered.views import look_along

CELLS, REACH = 32, 0.62
"""Of the image along either side, and half that side in normalised lengths."""
WIDTHS = (1, 2, 4, 6)
"""Channels of the encoder's levels, each half as fine as the one before, in units of `channels`."""
POINT_WIDTH = 4  # Of a point's hidden layers, likewise
POINT_SCALE = 1 / MEAN_RADIUS  # By which coordinates are brought to about 1
FULL = 4.0  # Points of a cell that count as 1
ROUNDS, TRUST = 4, 0.025
"""Repetitions of the Procrustes step, each with votes weighed by 1 / (1 + (off / TRUST)^2)."""
OTHERS = 0.02  # Weight in a part's pose of points that are not its own
GOOD = 0.06  # Normalised length by which the confidence falls that votes are consistent
SMOOTH = 1e-6  # Squared normalised length within which the distance of votes is smooth
WEIGHTS = {"votes": 10.0, "part": 0.5, "size": 1.0, "hinge": 1.0}
"""Of the terms of the loss: the votes make the pose, the others should not outweigh them."""
BESIDE = 0.06  # Rad: standard deviation of what a view is turned from the ray while learning
TINY = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewVotes:
    """What the network says of B views of K points, in the frame it was given."""

    points: Float[Tensor, "B K P 3"]
    """Each point in every part's frame: part_T_view of scaled template points."""
    part: Float[Tensor, "B K P"]
    """Logits."""
    log_scale: Float[Tensor, "B 3"]
    shift: Float[Tensor, "B J 3"]
    deviation: Float[Tensor, "B J 3"]
    hinge: Float[Tensor, "B J 3"]
    """Of the object's own hinges from the template's, scaled; template frame. What it has along the
    axes says nothing."""

    def pivot(self, template: ArticulatedTemplate) -> Float[Tensor, "B J 3"]:
        """Where the object's own hinges sit on the base."""
        axis = template.directions().detach()
        aside = self.hinge - (self.hinge * axis).sum(-1, keepdim=True) * axis
        return template.pivot.detach() * self.log_scale.detach().exp()[:, None] + aside


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewTarget:
    """What the votes should be, by C candidates for each of B views."""

    poses: PartPoses
    """view_T_part of B * C placements, those of a view in a row."""
    part: Int[Tensor, "B C K"]
    log_scale: Float[Tensor, "B C 3"]
    shift: Float[Tensor, "B C J 3"]
    deviation: Float[Tensor, "B C J 3"]
    price: Float[Tensor, "B C"]
    """What a candidate costs beside its loss."""
    trust: Float[Tensor, " B"]
    """Weight of each view, in [0, 1]."""
    aside: Float[Tensor, "B C J"] | None = None
    """How far the hinges that the votes say are from the object's own, weighed by what is known of
    these; None where nothing is."""


def image_of(
    points: Float[Tensor, "B N 3"], normals: Float[Tensor, "B N 3"]
) -> Float[Tensor, "B 8 G G"]:
    """Whether a cell is filled, mean depth, normal and place in the cell, how many points.

    Args:
        points: With the ray along z.
        normals: Unit, towards the camera.
    """
    place = (points[..., :2] / REACH + 1) / 2 * CELLS
    cell = place.floor().clamp(0, CELLS - 1)
    ones = torch.ones_like(points[..., :1])
    each = torch.cat([ones, POINT_SCALE * points[..., 2:], normals, place - cell - 0.5], -1)
    index = (cell[..., 1:] * CELLS + cell[..., :1]).long().expand(-1, -1, each.shape[-1])
    total = points.new_zeros(points.shape[0], CELLS**2, each.shape[-1]).scatter_add(1, index, each)
    count = total[..., :1]
    shown = total[..., 1:] / count.clamp_min(1)
    image = torch.cat([(count > 0).to(points), shown, count.clamp_max(2 * FULL) / FULL], -1)
    return image.mT.unflatten(2, (CELLS, CELLS))


def _layer(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs)
    )


class _Residual(nn.Module):
    """Layers whose result is added to their input."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        inner = [nn.Sequential(_layer(width, width), nn.ReLU()) for _ in range(layers - 1)]
        self.layers = nn.Sequential(*inner, _layer(width, width))

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        return F.relu(x + self.layers(x))


class ViewNetwork(nn.Module):
    """An image of a view, an encoder and a decoder, and heads for its points and the whole."""

    learned: Tensor
    """1 once it was taught; before, nothing that it says is asked for."""
    hinged: Tensor
    """1 once it was taught where hinges of objects sit."""

    def __init__(self, parts: int, joints: int, *, channels: int) -> None:
        super().__init__()
        self.parts, self.joints = parts, joints
        first, second, third, last = (channels * times for times in WIDTHS)
        hidden = POINT_WIDTH * channels
        self.stem = nn.Sequential(_layer(8, first), nn.ReLU())
        self.levels = nn.ModuleList(
            nn.Sequential(_layer(inputs, outputs, 2), nn.ReLU(), _Residual(outputs, 2))
            for inputs, outputs in ((first, second), (second, third), (third, last))
        )
        self.code = nn.Sequential(
            nn.Linear(2 * last, 2 * last), nn.ReLU(), nn.Linear(2 * last, last), nn.ReLU()
        )
        self.spread = nn.Linear(last, last)
        self.down = nn.ModuleList([nn.Conv2d(last, third, 1), nn.Conv2d(third, second, 1)])
        self.back = nn.ModuleList([_Residual(third, 1), _Residual(second, 1)])
        self.own = nn.Linear(second + first + 6, hidden)
        self.whole = nn.Linear(last, hidden, bias=False)
        self.point = nn.Linear(hidden, hidden)
        self.vote = nn.Linear(hidden, 4 * parts)
        self.rest = nn.Linear(last, 3 + 6 * joints)
        self.hinge = nn.Linear(last, 3 * joints)
        self.register_buffer("learned", torch.zeros(()))
        self.register_buffer("hinged", torch.zeros(()))

    def forward(
        self, points: Float[Tensor, "B N 3"], normals: Float[Tensor, "B N 3"], count: int
    ) -> ViewVotes:
        """Votes of the first `count` points of normalised clouds.

        Args:
            points: Of each cloud, with the ray along z.
            normals: Unit, towards the camera.
            count: Of points that vote.
        """
        image = image_of(points, normals).contiguous(memory_format=torch.channels_last)
        fine, asked = self.stem(image), points[:, :count]
        seen = [fine]
        for level in self.levels:
            seen.append(level(seen[-1]))
        top = seen[-1]
        code = self.code(torch.cat([top.mean((2, 3)), top.amax((2, 3))], -1))  # (B, last)
        coarse = top + self.spread(code)[:, :, None, None]
        for down, back, beside in zip(self.down, self.back, (seen[2], seen[1]), strict=True):
            coarse = back(beside + F.interpolate(down(coarse), scale_factor=2.0))
        features = torch.cat([_sampled(coarse, asked), _sampled(fine, asked)], -1)
        own = torch.cat([features, POINT_SCALE * asked, normals[:, :count]], -1)
        hidden = self.own(own) + self.whole(code)[:, None]
        vote = self.vote(self.point(hidden.relu()).relu())
        rest, j = self.rest(code), self.joints
        return ViewVotes(
            points=MEAN_RADIUS * vote[..., self.parts :].unflatten(-1, (self.parts, 3)),
            part=vote[..., : self.parts],
            log_scale=rest[:, :3],
            shift=rest[:, 3 : 3 + 3 * j].unflatten(1, (j, 3)),
            deviation=rest[:, 3 + 3 * j :].unflatten(1, (j, 3)),
            # What else it learns does not change for what it says of hinges.
            hinge=self.hinge(code.detach()).unflatten(1, (j, 3)),
        )


class PlainViewVotes(nn.Module):
    """The network with one tensor in and plain tensors out, for other runtimes (`scapo.export`)."""

    OUTPUTS: ClassVar = tuple(item.name for item in fields(ViewVotes))

    def __init__(self, network: ViewNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, cloud: Float[Tensor, "B K 6"]) -> tuple[Tensor, ...]:
        """The fields of `ViewVotes` in their order, of all points.

        Args:
            cloud: Points with the ray along z, and their normals.
        """
        votes = self.network(cloud[..., :3], cloud[..., 3:], cloud.shape[1])
        return tuple(getattr(votes, name) for name in self.OUTPUTS)


def _sampled(
    image: Float[Tensor, "B C H W"], points: Float[Tensor, "B K 3"]
) -> Float[Tensor, "B K C"]:
    """What stands in an image where points are, between cells."""
    place = (points[..., :2] / REACH)[:, None]
    found = F.grid_sample(image, place, padding_mode="border", align_corners=False)
    return found[:, :, 0].mT


@torch.no_grad()
def placed_by_votes(
    votes: ViewVotes, points: Float[Tensor, "B K 3"], template: ArticulatedTemplate
) -> tuple[Placement, Float[Tensor, " B"]]:
    """The placements that votes stand for, and how well the votes of the bases agree, 1 to 0.

    The base is where its frame's votes put it; states are read off the poses of the parts.

    Args:
        votes: Of the points, in their frame.
        points: The points that voted.
        template: Whose joints link the parts.
    """
    share = votes.part.softmax(-1)
    every = share.shape[-1]  # Parts: the steps of all are taken at once, for they are small
    whole = points.repeat(every, 1, 1)
    own, mine = votes.points.movedim(2, 0).flatten(0, 1), share.movedim(2, 0).flatten(0, 1)
    turns, moves, offs = (x.unflatten(0, (every, -1)) for x in _fitted(whole, own, mine))
    rotation, translation, off = turns[0], moves[0], offs[0]
    states = []
    for j, kind in enumerate(template.kinds):
        turn, move = turns[j + 1], moves[j + 1]
        axis = template.directions()[j]
        if kind == "prismatic":
            apart = (rotation.mT @ (move - translation)[..., None])[..., 0]
            states.append(apart @ axis)
            continue
        own = (rotvec_to_rotmat(votes.deviation[:, j]) @ axis[:, None])[..., 0]
        back = rotvec_to_rotmat(-axis * template.rest[j])
        turned = rotmat_to_rotvec(rotation.mT @ turn @ back)
        states.append(template.rest[j] + (turned * own).sum(-1))
    placement = Placement(
        rotation=rotation,
        translation=translation,
        log_scale=votes.log_scale,
        state=torch.stack(states, 1),
        shift=votes.shift,
        deviation=votes.deviation,
    )
    return placement, _agreement(off)


@torch.no_grad()
def base_by_votes(
    votes: ViewVotes, points: Float[Tensor, "B K 3"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, " B"]]:
    """view_R_base of `placed_by_votes`, and how well the votes of the bases agree, 1 to 0."""
    base = votes.part.softmax(-1)[..., 0]
    rotation, _, off = _fitted(points, votes.points[:, :, 0], base)
    return rotation, _agreement(off)


def _agreement(off: Float[Tensor, "B K"]) -> Float[Tensor, " B"]:
    return torch.exp(-(off / GOOD).square()).mean(1)


def _fitted(
    points: Float[Tensor, "B K 3"], votes: Float[Tensor, "B K 3"], share: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"], Float[Tensor, "B K"]]:
    """Pose that takes votes to points, robustly, and how far off each vote is."""
    prior = weight = share + OTHERS
    rotation, translation = procrustes(points, votes, weight)
    off = share
    for _ in range(ROUNDS):
        off = (points - votes @ rotation.mT - translation[:, None]).norm(dim=-1)
        weight = prior / (1 + (off / TRUST).square())
        rotation, translation = procrustes(points, votes, weight)
    return rotation, translation, off


def view_losses(
    votes: ViewVotes, points: Float[Tensor, "B K 3"], target: ViewTarget
) -> dict[str, Tensor]:
    """Distance of the votes (not squared: some targets are wrong), parts, and the rest.

    Each view is compared with the candidate that costs it least.
    """
    count = target.price.shape[1]
    turn = target.poses.rotation.unflatten(0, (-1, count))  # (B, C, P, 3, 3)
    move = target.poses.translation.unflatten(0, (-1, count))
    own = (points[:, None, None] - move[..., None, :]) @ turn  # (B, C, P, K, 3)
    apart = votes.points.transpose(1, 2)[:, None] - own
    off = (apart.square().sum(-1) + SMOOTH).sqrt().mean((2, 3))
    said = votes.part.mT[:, None].expand(-1, count, -1, -1)  # (B, C, P, K)
    part = F.cross_entropy(said.flatten(0, 1), target.part.flatten(0, 1), reduction="none")
    size = (votes.log_scale[:, None] - target.log_scale).abs().mean(-1)
    for name in ("shift", "deviation"):
        size = size + (getattr(votes, name)[:, None] - getattr(target, name)).abs().mean((-1, -2))
    terms = {"votes": off, "part": part.mean(1).view_as(off), "size": size}
    terms = {name: WEIGHTS[name] * value for name, value in terms.items()}
    cost = torch.stack(list(terms.values())).sum(0) + target.price
    best = cost.argmin(1, keepdim=True)
    if target.aside is not None:
        terms["hinge"] = WEIGHTS["hinge"] * target.aside.mean(-1)
    trust = target.trust / target.trust.sum().clamp_min(TINY)
    return {name: (trust * value.gather(1, best)[:, 0]).sum() for name, value in terms.items()}


def along_rays(camera: Float[Tensor, "B 3"], generator: torch.Generator) -> Float[Tensor, "B 3 3"]:
    """Turns of views that bring the camera's ray to z, a little beside it, rolled at random.

    Args:
        camera: Its centre, in the frame of each view.
        generator: On the device of the cameras.
    """
    draw = {"generator": generator, "device": camera.device}
    roll = 2 * torch.pi * torch.rand(len(camera), **draw)
    turn = F.pad(BESIDE * torch.randn(len(camera), 2, **draw), (0, 1))
    about = F.pad(roll[:, None], (2, 0))
    return rotvec_to_rotmat(turn) @ rotvec_to_rotmat(about) @ look_along(camera)
