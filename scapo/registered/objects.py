# SPDX-License-Identifier: MIT
"""First templates where it is known which views show the same object.

As a robot knows that walks around one, or opens it; nothing is known of poses, parts and joints.

The body of one object is the same shape in all of its views, so these agree to a degree, and what
moved in them is one joint's. Two objects differ in all their proportions; how the frames of theirs
go together, few directions tell: where the cameras were on average (people look at the front, from
above), the axes of the joints, and which way the parts lie from the body. The boxes of the bodies
are then brought to one size, and a template is fitted to views of all objects together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import ends
from scapo.method import evenly
from scapo.records import cat, take
from scapo.registered.bundle_adjustment import Candidate, Inliers, first_fit
from scapo.registered.config import DiscoveryConfig
from scapo.registered.initialisation import common_frame, first_template
from scapo.registered.inliers import OwnedViews
from scapo.registered.joint_proposals import JointProposal, PosedViews, propose_joints
from scapo.registered.orientation import quarter_turns
from scapo.registered.template import Placement
from scapo.registered.view_states import Motion, apart, motion_of
from scapo.registered.views import TINY, PartialViews

LEAST_OBJECTS = 4  # That a first template is made of
LEAST_SHOWN = 8  # Clouds of an object, at least, that are registered with one another
AGREEING = 0.8  # Share of an object's views, those that agree best, that are gone on with
FITTED = 60  # Views, at most, that a template is fitted to
SURE, SHOWN = 0.67, 0.42
"""Share of the objects whose frames are surest, and of all those among them whose parts other views
show best: a first template is made of these."""
LEAST_HALF = 0.02  # Normalised length: half the side of a body's box at least
FARTHEST = 1.5  # Halves of the body's box beyond which a part is not farther away
SIZES = 1.0  # Largest log scale of a body's box against the others'
WEIGHT_CAMERA, WEIGHT_SPREAD, WEIGHT_WAY, WEIGHT_AXIS = 1.3, 2.0, 1.0, 1.0
"""Of what two objects are compared by; their sums of products are what agrees."""
SUPPORT = 3.0  # Of mean log support against the log of how far cameras are spread
SURER = 30.0  # Power of a proposal's score against the best one's, by which its axis counts
SWEEPS = 10  # Over all objects, in which each takes the frame that agrees best with the others


@dataclass(frozen=True, slots=True, kw_only=True)
class OneObject:
    """Views of one object in a frame along its main directions, and what moved in them."""

    posed: PosedViews
    moved: tuple[Bool[Tensor, "B K"], ...]
    """By each joint."""
    proposals: tuple[list[JointProposal], ...]
    """Of each joint, best first."""
    motions: tuple[Motion, ...]
    """Of each joint along its best proposal."""
    centre: Float[Tensor, " 3"]
    half: Float[Tensor, " 3"]
    """Of the box (`ends`) of what did not move."""

    def ways(self) -> Float[Tensor, "J 3"]:
        """From the body's middle to what each joint moved, in halves of the body's box."""
        points, _ = self.posed.world(self.moved[0].shape[1])
        middle = [
            points[rows].median(0).values if rows.any() else self.centre for rows in self.moved
        ]
        return ((torch.stack(middle) - self.centre) / self.half).clamp(-FARTHEST, FARTHEST)

    def cameras(self) -> Float[Tensor, "B 3"]:
        """Directions to the cameras."""
        direction = self.posed.views.direction()[:, :, None]
        return (self.posed.rotation.mT @ direction)[..., 0]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reading:
    """One way to read an object: how its frame is turned, and which joint is which."""

    turn: Float[Tensor, "3 3"]
    order: tuple[int, ...]
    joints: tuple[JointProposal, ...]
    """In that order, in the object's own frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Start:
    """Views of several objects in one frame, before a template is fitted to them."""

    posed: PosedViews
    points: Float[Tensor, "B K 3"]
    """In that frame, moved back to state 0 and to the size that objects have on average."""
    normals: Float[Tensor, "B K 3"]
    moved: tuple[Bool[Tensor, "B K"], ...]
    state: Float[Tensor, "B J"]
    log_scale: Float[Tensor, "B 3"]
    """Of each view's object against the others."""

    def placement(self) -> Placement:
        """Of the views."""
        still = Placement.at(self.posed.rotation, self.posed.translation, self.state.clone())
        return replace(still, log_scale=self.log_scale.clone())


def owned_views(objects: Sequence[OneObject], kinds: tuple[JointKind, ...]) -> OwnedViews:
    """All views of the objects, as these stand when they are read together (`agreeing`)."""
    posed, readings = [one.posed for one in objects], agreeing(objects, kinds)
    number = [torch.full((len(one.rotation),), k) for k, one in enumerate(posed)]
    turned = [one.rotation @ x.turn.mT for one, x in zip(posed, readings, strict=True)]
    return OwnedViews(
        views=cat([one.views for one in posed]),
        rotation=torch.cat(turned),
        owner=torch.cat(number),
        variance=float(torch.stack([one.cameras().var(0).sum() for one in objects]).mean()),
    )


def surest_first(known: Sequence[OneObject]) -> list[OneObject]:
    """The objects, those whose frames are surest first.

    Where views of two sides of an object were taken for one side, cameras gather; where poses are
    right, views confirm each other's points.
    """
    spread = torch.stack([one.cameras().var(0).sum() for one in known])
    support = torch.tensor([min(motion.support for motion in one.motions) for one in known])
    sure = spread * (SUPPORT * support).exp()
    return [known[k] for k in sure.argsort(descending=True).tolist()]


def draws_of(objects: Sequence[OneObject], count: int) -> list[list[OneObject]]:
    """So many draws, 4 at most, of sure objects whose motions are surest.

    Args:
        objects: The surest first (`surest_first`).
        count: Of the draws, before those with too few objects are left out.
    """
    sure = objects[: max(LEAST_OBJECTS, round(SURE * len(objects)))]
    shown = sorted(sure, key=lambda one: -min(motion.score for motion in one.motions))
    return [[shown[k] for k in rows] for rows in rows_of_draws(len(objects), count)]


def rows_of_draws(total: int, count: int) -> list[list[int]]:
    """Which of the objects whose motions are surest each draw has: all, then two thirds of them."""
    shown = range(min(total, max(LEAST_OBJECTS, round(SHOWN * total))))
    draws = [list(shown), *([k for k in shown if k % 3 != d] for d in range(3))]
    return [draw for draw in draws[:count] if len(draw) >= LEAST_OBJECTS]


def object_candidate(
    known: Sequence[OneObject],
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> Candidate:
    """The first template of several objects."""
    readings = agreeing(known, kinds)
    halves = torch.stack([x.turn.abs() @ one.half for one, x in zip(known, readings, strict=True)])
    size = (halves.log() - halves.log().mean(0)).clamp(-SIZES, SIZES)
    joints = _mean_joints(known, readings, size)
    parts = [
        _in_common(one, x, scale, joints, kinds)
        for one, x, scale in zip(known, readings, size, strict=True)
    ]
    start = _joined(parts)
    surface = start.points, start.normals
    template = first_template(surface, start.moved, joints, kinds, config.template_points)
    views, placement = start.posed.views, start.placement()
    placement, _ = first_fit(template, views, placement, config, generator, known=True)
    return Candidate(template=template, inliers=Inliers(views=views, placement=placement))


def rows_by_object(instance: Int[Tensor, " N"]) -> list[Int[Tensor, " _"]]:
    """Which clouds show the same object, where there are enough of them (`LEAST_SHOWN`)."""
    every = [(instance == number).nonzero()[:, 0] for number in instance.unique()]
    return [rows for rows in every if len(rows) >= LEAST_SHOWN]


def grouped(instance: Int[Tensor, " N"], config: DiscoveryConfig) -> list[Int[Tensor, " _"]]:
    """Which clouds are looked at of which objects, spread over all.

    Objects of too few clouds (`LEAST_SHOWN`) are passed over, and all where few objects are left.
    """
    every = rows_by_object(instance)
    if len(every) < LEAST_OBJECTS:
        return []
    some = [every[k] for k in evenly(len(every), config.objects)]
    return [rows[evenly(len(rows), config.object_views)] for rows in some]


def one_object(
    views: PartialViews,
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> OneObject:
    """The frame and joints of one object from views of it alone."""
    posed = common_frame(views, config.rotations, AGREEING, own=True)
    moved, proposals = zip(*propose_joints(posed, kinds, generator), strict=True)
    points, _ = posed.world(moved[0].shape[1])
    still = points[~torch.stack(moved).any(0)]
    low, high = ends(still)
    motions = tuple(
        motion_of(posed, rows, found[0], kind)
        for rows, found, kind in zip(moved, proposals, kinds, strict=True)
    )
    return OneObject(
        posed=posed,
        moved=moved,
        proposals=proposals,
        motions=motions,
        centre=(low + high) / 2,
        half=((high - low) / 2).clamp_min(LEAST_HALF),
    )


def agreeing(objects: Sequence[OneObject], kinds: tuple[JointKind, ...]) -> list[_Reading]:
    """How each object is read so that all agree.

    Every object starts a consensus in turn; each object takes the reading nearest to the mean of
    the others' until none changes, and the consensus with the most agreement stays.
    """
    readings = [_readings(one, kinds) for one in objects]
    tables = [
        torch.stack([_signature(one, x) for x in some])
        for one, some in zip(objects, readings, strict=True)
    ]
    best, most = [0] * len(objects), -torch.inf
    for start in range(len(objects)):
        mean, chosen = tables[start][0], list[int]()
        for _ in range(SWEEPS):
            old, chosen = chosen, [int((table @ mean).argmax()) for table in tables]
            mean = torch.stack([table[k] for table, k in zip(tables, chosen, strict=True)]).mean(0)
            if chosen == old:
                break
        if float(mean.square().sum()) > most:
            best, most = chosen, float(mean.square().sum())
    return [some[k] for some, k in zip(readings, best, strict=True)]


def _readings(one: OneObject, kinds: tuple[JointKind, ...]) -> list[_Reading]:
    orders = [
        order
        for order in permutations(range(len(kinds)))
        if all(kinds[k] == kinds[j] for j, k in enumerate(order))
    ]
    return [
        _Reading(turn=turn, order=order, joints=joints)
        for turn, order in product(quarter_turns(), orders)
        for joints in product(*(one.proposals[k] for k in order))
    ]


def _signature(one: OneObject, reading: _Reading) -> Float[Tensor, " D"]:
    """Numbers whose products tell how well two objects agree.

    Where the cameras were counts by its first and second moments: from the front and to either
    side of it, but from above only.
    """
    ways = one.ways()[list(reading.order)] @ reading.turn.T
    cameras = one.cameras() @ reading.turn.T
    best = torch.tensor([max(one.proposals[k][0].score, TINY) for k in reading.order])
    sure = (torch.tensor([joint.score for joint in reading.joints]) / best) ** SURER
    axes = torch.stack([joint.axis for joint in reading.joints]) @ reading.turn.T
    return torch.cat(
        [
            WEIGHT_CAMERA * F.normalize(cameras.mean(0), dim=0),
            WEIGHT_SPREAD * (cameras.mT @ cameras / len(cameras)).flatten(),
            WEIGHT_WAY * ways.flatten(),
            WEIGHT_AXIS * (sure[:, None, None] * axes[:, :, None] * axes[:, None]).flatten(),
        ]
    )


def _in_common(
    one: OneObject,
    reading: _Reading,
    log_scale: Float[Tensor, " 3"],
    joints: tuple[JointProposal, ...],
    kinds: tuple[JointKind, ...],
) -> _Start:
    """The object's views about the middle of its body, as it is read.

    Args:
        one: The object.
        reading: How its frame is turned and its joints are ordered.
        log_scale: Of its body against the others'.
        joints: Of all objects; states count along their axes.
        kinds: Of them.
    """
    posed = one.posed
    points, normals = posed.world(one.moved[0].shape[1])
    motions = [
        one.motions[k] if own is one.proposals[k][0] else motion_of(posed, one.moved[k], own, kind)
        for k, own, kind in zip(reading.order, reading.joints, kinds, strict=True)
    ]
    motions = apart(posed, reading.joints, motions, kinds)
    moved, states = list[Bool[Tensor, "B K"]](), list[Tensor]()
    for motion, own, joint, kind in zip(motions, reading.joints, joints, kinds, strict=True):
        rows = motion.moved[..., None]
        back, facing = motion.back(posed, own, kind)
        points, normals = torch.where(rows, back, points), torch.where(rows, facing, normals)
        moved.append(motion.moved)
        states.append(motion.state * torch.sign(joint.axis @ reading.turn @ own.axis))
    middle = (posed.rotation @ one.centre[:, None])[..., 0]
    return _Start(
        posed=PosedViews(
            views=posed.views,
            rotation=posed.rotation @ reading.turn.T,
            translation=posed.translation + middle,
        ),
        points=(points - one.centre) @ reading.turn.T / log_scale.exp(),
        normals=normals @ reading.turn.T,
        moved=tuple(moved),
        state=torch.stack(states, 1),
        log_scale=log_scale.expand(len(middle), 3),
    )


def _joined(parts: list[_Start]) -> _Start:
    """Some views of all."""
    whole = cat(parts)
    return take(whole, evenly(len(whole.log_scale), FITTED))


def _mean_joints(
    objects: Sequence[OneObject], readings: list[_Reading], log_scale: Float[Tensor, "O 3"]
) -> tuple[JointProposal, ...]:
    """The direction that most of the objects' axes follow, and the middle of their pivots."""
    joints = []
    for j in range(len(readings[0].joints)):
        axes = torch.stack([x.turn @ x.joints[j].axis for x in readings])
        axis = torch.linalg.eigh(axes.mT @ axes).eigenvectors[:, -1]
        pivots = [
            (x.turn @ (x.joints[j].pivot - one.centre)) / size.exp()
            for one, x, size in zip(objects, readings, log_scale, strict=True)
        ]
        score = sum(x.joints[j].score for x in readings) / len(readings)
        pivot = torch.stack(pivots).median(0).values
        joints.append(JointProposal(axis=axis, pivot=pivot, score=score))
    return tuple(joints)
