# SPDX-License-Identifier: MIT
"""The networks begin at what a trained run of `registered` says of the training clouds.

Not in the paper, whose stage 1 does not canonicalise partial views. Frames, shapes, joints and
states are read off that run's predictions, which saw no label either: in place of stage 1 the
encoder learns the frames and the decoder the whole shapes, and stage 2 begins at networks that were
fitted to the joints and states (`first_targets`). Its losses are the paper's.

Frame `base`: that of the base part, the aligned frame of a network that errs nowhere.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.points import chamfer, fibonacci_sphere, normalise
from scapo.geometry.rigid import apply, invert, joint_motion, rigid
from scapo.method import NO_JOURNAL, AbstractMethod, Journal, Mode
from scapo.paper import losses
from scapo.paper.autoencoder import Encoding
from scapo.paper.first_targets import Lying
from scapo.paper.objectives import LossConfig
from scapo.paper.part_search import Kinds, Skeleton, matched, split_skeleton
from scapo.records import cat, either, map_tensors, take
from scapo.types import Observation

POINTS = 1024
"""Of a shape that are learned from: the first, which `registered` leaves spread out."""
LOT = 100
"""Clouds that are asked about at a time."""
USUAL: dict[Mode, float] = {"fast": 0.04, "quick": 0.06, "refine": 0.3, "whole": 0.3}
"""Seconds of one core that a cloud takes, before it is known better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """What the run says of clouds, in normalised units."""

    rotation: Float[Tensor, "B 3 3"]
    """input_R_base."""
    translation: Float[Tensor, "B 3"]
    shape: Float[Tensor, "B M 3"]
    """Base frame, all states 0; the same points in the same order for every cloud."""
    part: Int[Tensor, "B M"]
    pivot: Float[Tensor, "B J 3"]
    """Base frame, as the axis."""
    axis: Float[Tensor, "B J 3"]
    state: Float[Tensor, "B J"]

    def observed(self, kinds: Kinds) -> Float[Tensor, "B M 3"]:
        """The shape with its joints in their states, base frame."""
        shape = self.shape
        for j, kind in enumerate(kinds):
            motion = joint_motion(self.pivot[:, j], self.axis[:, j], self.state[:, j], kind)
            moved = apply(motion, self.shape)
            shape = torch.where((self.part == j + 1)[..., None], moved, shape)
        return shape

    def exchanged(self, exchange: Exchange) -> Told:
        """The same surfaces in the same places, told as if two parts were each other.

        Of one hinge base and child: the new base is the old child seen through the half turn about
        the cloud's own pivot, which reverses the axis; so the motion of the old base against the
        old child has the old state. Of two hinges the children: the half turn is about the middle
        of the base.
        """
        if self.state.shape[1] == 2:
            return self._with_children_exchanged(exchange)
        turn, pivot, state = exchange.turn, self.pivot[:, 0], self.state[:, 0]
        motion = joint_motion(pivot, self.axis[:, 0], state, "revolute")
        child = rigid(self.rotation, self.translation) @ motion
        pose = child @ rigid(turn.expand_as(self.rotation), pivot - pivot @ turn.mT)
        back = (self.shape[:, exchange.order] - self.pivot) @ turn + self.pivot
        return replace(self, rotation=pose[:, :3, :3], translation=pose[:, :3, 3], shape=back)

    def _with_children_exchanged(self, exchange: Exchange) -> Told:
        turn, middle = exchange.turn, self.middle()[:, None]
        axis = self.axis.flip(1) @ turn
        sign = (axis * self.axis.mean(0)).sum((0, 2)).sign()  # as each joint counts in the mean
        away = (self.rotation @ (middle - middle @ turn.mT).mT)[..., 0]
        return replace(
            self,
            rotation=self.rotation @ turn,
            translation=self.translation + away,
            shape=(self.shape[:, exchange.order] - middle) @ turn + middle,
            pivot=(self.pivot.flip(1) - middle) @ turn + middle,
            axis=axis * sign[:, None],
            state=self.state.flip(1) * sign,
        )

    def middle(self) -> Float[Tensor, "B 3"]:
        """Of the base, base frame."""
        base = (self.part == 0).to(self.shape)[..., None]
        return (base * self.shape).sum(1) / base.sum(1).clamp_min(1)

    def nearer(self, other: Told, encoding: Encoding) -> Told:
        """Of two readings of each cloud the one whose frame is nearer to the encoder's."""
        gap = [frame_errors(encoding, told) for told in (self, other)]
        return either(gap[1] < gap[0], other, self)

    def turned(self, pose: Float[Tensor, "B 4 4"]) -> Told:
        """Of the same clouds moved by a pose."""
        moved = apply(pose, self.translation[:, None])[:, 0]
        return replace(self, rotation=pose[:, :3, :3] @ self.rotation, translation=moved)

    def order(self, shape: Float[Tensor, "K 3"], cloud: int, kinds: Kinds) -> Int[Tensor, " K"]:
        """Points that are as many and lie as those of a shape, spread over all parts.

        Args:
            shape: What a decoder says of one of the clouds.
            cloud: Which.
            kinds: Of the joints.
        """
        number, count = self.shape.shape[1], len(shape)
        some = torch.arange(count, device=shape.device)
        some = some * number // count if count <= number else some % number
        return some[matched(shape, self.observed(kinds)[cloud, some])]

    def skeleton(self, order: Int[Tensor, " K"], spread: float) -> Skeleton:
        """What the clouds share, of the points that are named, with bones as their parts are."""
        points, part = self.shape[:, order].mean(0), self.part[0, order]
        children = [part == j + 1 for j in range(self.state.shape[1])]
        return replace(
            split_skeleton(points, children, spread),
            pivot=self.pivot.mean(0),
            axis=F.normalize(self.axis.mean(0), dim=-1),
        )

    def lying(self, order: Int[Tensor, " K"], encoding: Encoding) -> Lying:
        """The shapes of the points that are named, and how they lie in the encoder's frames."""
        shape = self.shape[:, order]
        member = F.one_hot(self.part[:, order], self.state.shape[1] + 1).to(shape)
        back = encoding.rotation.mT
        away = self.translation - encoding.translation
        return Lying(
            points=shape,
            keypoints=member.mT @ shape / member.sum(1).clamp_min(1)[..., None],
            pivot=self.pivot,
            axis=F.normalize(self.axis.mean(0), dim=-1),
            turn=back @ self.rotation,
            shift=(back @ away[..., None])[..., 0],
            state=self.state,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """How two parts may change places: the two plates of a laptop, the temples of glasses."""

    turn: Float[Tensor, "3 3"]
    """Half a turn, base frame with the states 0: of one hinge about an axis across it."""
    order: Int[Tensor, " M"]
    """For each point of a shape, which comes to lie nearest to it that takes its part's place."""

    @staticmethod
    def of(told: Told) -> Exchange:
        """The half turn that lays the parts of the mean shape upon each other best."""
        shape, part = told.shape.mean(0), told.part[0]
        two = told.state.shape[1] == 2
        centre = told.middle().mean(0) if two else told.pivot.mean((0, 1))
        becomes = torch.tensor([0, 2, 1] if two else [1, 0]).to(part)[part]

        def gap(turn: Tensor, some: slice) -> Float[Tensor, "M M"]:
            laid = (shape - centre) @ turn.mT + centre
            strange = part[some, None] != becomes[some]
            return torch.cdist(shape[some], laid[some]) + APART * strange

        def best(across: Tensor) -> tuple[Tensor, Tensor]:
            turns = 2 * across[:, :, None] * across[:, None] - torch.eye(3).to(shape)
            thin = slice(None, None, 4)
            gaps = [gap(turn, thin) for turn in turns]
            chosen = int(torch.stack([g.amin(1).mean() + g.amin(0).mean() for g in gaps]).argmin())
            return across[chosen], turns[chosen]

        if two:
            rough, _ = best(_half_sphere(shape, WAYS))
            near = NEAR * _half_sphere(shape, HALF_TURNS)
            _, turn = best(F.normalize(rough + torch.cat([near, -near]), dim=-1))
        else:
            _, turn = best(_across(told, shape, centre))
        return Exchange(turn=turn, order=gap(turn, slice(None)).argmin(1))


HALF_TURNS = 120
"""Axes that are tried."""
WAYS = 400
"""Axes in all directions that are tried first."""
NEAR = 0.1
"""Of axes in all directions: how far those that are tried next lie from the best."""
APART = 10.0
"""Length that is added between points of which none is to be laid upon the other."""


def _across(
    told: Told, shape: Float[Tensor, "M 3"], pivot: Float[Tensor, " 3"]
) -> Float[Tensor, "A 3"]:
    """Directions across the one hinge."""
    axis = F.normalize(told.axis.mean((0, 1)), dim=0)
    first = F.normalize(shape[told.part[0] == 1].mean(0) - pivot, dim=0)
    first = F.normalize(first - (first @ axis) * axis, dim=0)
    angle = torch.arange(0, torch.pi, torch.pi / HALF_TURNS).to(shape)[:, None]
    return angle.cos() * first + angle.sin() * torch.linalg.cross(axis, first)


def _half_sphere(like: Tensor, count: int) -> Float[Tensor, "{count} 3"]:
    return fibonacci_sphere(2 * count)[:count].to(like)


def frame_errors(encoding: Encoding, told: Told) -> Float[Tensor, " B"]:
    """What `pose_agreement` is a mean of."""
    cosine = F.cosine_similarity(encoding.rotation, told.rotation, dim=-2)
    return (1 - cosine).mean(1) + (encoding.translation - told.translation).square().mean(1)


class WarmStart:
    """A trained method that is asked for each training cloud once, before it is needed.

    Where a symmetry of the category exchanges two parts, the method cannot tell which is which
    (nor does the evaluation ask): each cloud then has two readings, and of these the one nearer to
    what the encoder says is learned. How the parts change places is told by all clouds that are
    asked about at first, so that a training which continues reads them as before.
    """

    def __init__(self, method: AbstractMethod, mode: Mode = "quick") -> None:
        """A method whose predictions have canonical points with parts, in one order for all."""
        self.method = method
        self.mode: Mode = mode
        self.known: dict[int, Told] = {}
        kinds = [joint.kind for joint in method.category.joints]
        hinges = kinds in (["revolute"], ["revolute"] * 2)
        self.two_readings = method.category.symmetry is not None and hinges
        self.exchange: Exchange | None = None

    def ask(
        self,
        observation: Observation,
        index: Int[Tensor, " B"],
        generator: torch.Generator,
        journal: Journal = NO_JOURNAL,
    ) -> None:
        """Ask about many clouds before a training begins.

        Args:
            observation: All training clouds.
            index: Rows of those to be asked about; what is known of them is not asked again.
            generator: Of the training; nothing is drawn.
            journal: Told how far it is; keeps the answers until the start is over.
        """
        new = [k for k, row in enumerate(index.tolist()) if row not in self.known]
        lots = index[new].split(LOT) if new else ()
        clouds = (map_tensors(take(observation, lot), Tensor.cpu) for lot in lots)
        jobs = journal.ahead([partial(self._ask, some) for some in clouds])
        began = time.monotonic()
        for number, (lot, job) in enumerate(zip(lots, jobs, strict=True)):
            pace = (time.monotonic() - began) / number if number else LOT * USUAL[self.mode]
            journal.tell("asked about clouds", number / len(lots), pace * (len(lots) - number))
            found = journal.once(f"told {number}", job, generator, {Told.__name__: Told})
            self._keep(lot, found)
        if self.two_readings and self.exchange is None:
            self.exchange = Exchange.of(self.of(observation, index))

    def _keep(self, index: Int[Tensor, " B"], told: Told) -> None:
        self.known |= {row: take(told, torch.tensor([i])) for i, row in enumerate(index.tolist())}

    def read(
        self,
        observation: Observation,
        index: Int[Tensor, " B"],
        encoding: Encoding,
        pose: Float[Tensor, "B 4 4"] | None = None,
    ) -> Told:
        """What it says of clouds, in the reading that is nearer to their encoding.

        Args:
            observation: The clouds, as the training has them.
            index: Their rows among all training clouds.
            encoding: What the encoder says of them.
            pose: How they were moved before that; None: not at all.
        """
        told = self.of(observation, index)
        moved = told if pose is None else told.turned(pose)
        return (
            moved
            if self.exchange is None
            else moved.nearer(moved.exchanged(self.exchange), encoding)
        )

    def of(self, observation: Observation, index: Int[Tensor, " B"]) -> Told:
        """What it says of clouds.

        Args:
            observation: The clouds, as the training has them.
            index: Their rows among all training clouds, by which they are known again.
        """
        rows: Sequence[int] = index.tolist()
        new = [k for k, row in enumerate(rows) if row not in self.known]
        if new:
            some = map_tensors(take(observation, torch.tensor(new).to(index)), Tensor.cpu)
            self._keep(index[new], self._ask(some))
        every = cat([self.known[row] for row in rows])
        return map_tensors(every, lambda tensor: tensor.to(observation.points.device))

    @torch.no_grad()
    def _ask(self, observation: Observation) -> Told:
        said = self.method.predict(observation, self.mode)
        pose, joints = said.camera_T_part, said.joints
        shape, part = said.canonical_points, said.canonical_part
        if pose is None or joints is None or shape is None or part is None:
            raise ValueError(f"{self.method.name}: expected poses, joints and a shape with parts")
        _, similarity = normalise(observation.points)
        scale, base = similarity.scale[:, None], pose[:, 0]
        slide = torch.tensor([one.kind == "prismatic" for one in self.method.category.joints])
        return Told(
            rotation=base[:, :3, :3],
            translation=similarity.forward(base[:, None, :3, 3])[:, 0],
            shape=shape[:, :POINTS] * scale[..., None],
            part=part[:, :POINTS],
            pivot=apply(invert(base), joints.pivot) * scale[..., None],
            axis=joints.axis @ base[:, :3, :3],
            state=torch.where(slide, joints.state * scale, joints.state),
        )


def imitation(
    encoding: Encoding,
    shape: Float[Tensor, "B K 3"],
    told: Told,
    kinds: Kinds,
    config: LossConfig,
) -> dict[str, Float[Tensor, ""]]:
    """What takes the place of stage 1's losses: frames as told, and whole shapes in them.

    Args:
        encoding: Of clouds.
        shape: S_dec of their codes.
        told: Of these clouds, in the same frame.
        kinds: Of the joints.
        config: Weights of `rec` and `ortho`.
    """
    frame = losses.pose_agreement(
        encoding.rotation, encoding.translation, told.rotation, told.translation
    )
    return {
        "frame": frame,
        "rec": config.rec * chamfer(told.observed(kinds), shape).mean(),
        "ortho": config.ortho * losses.orthonormality(encoding.frame),
    }
