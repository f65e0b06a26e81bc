# SPDX-License-Identifier: MIT
"""Stage 1 of EAP: slots win points, each has a shape, an angle per anchor, a pivot; one axis.

Canonical frame: where the shapes of all slots stand placed. Of the hypothesis of anchor k, slot s
is moved by its joint about pivot and axis there and then turned by the anchor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bench.baselines.eap import losses
from bench.baselines.eap.layers import (
    Encoder,
    EncoderConfig,
    PerAnchor,
    PointReadout,
    Readout,
    ShapeDecoder,
    SlotAttention,
)
from scapo.categories import JointKind
from scapo.geometry.points import gather
from scapo.geometry.rigid import apply, invert, joint_motion, rigid


@dataclass(frozen=True, slots=True, kw_only=True)
class PartConfig:
    """Sizes of stage 1."""

    width: int = 256
    """Channels of codes, slots and the layers after the encoders."""
    points: int = 128
    """Points of the shape of each slot."""
    rounds: int = 7
    """Rounds of the slot attention."""
    passes: int = 2
    """Passes over the cloud; each after the first undoes the motions that the last one found."""
    angle_range: float = 0.5 * math.pi
    """Largest angle of a slot, rad."""
    slide_range: float = 0.5
    """Largest way of a slot of a prismatic joint, in normalised units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kinematics:
    """Parts in the canonical frame and their motions under K hypotheses."""

    shapes: Float[Tensor, "B S M 3"]
    """Placed, not moved."""
    pivots: Float[Tensor, "B S 3"]
    """Of the joint between each slot and the base; the base's own has no meaning. Two slots have
    one in common."""
    axis: Float[Tensor, "B K 3"]
    """Unit vector, of all joints."""
    states: Float[Tensor, "B S K"]
    """rad or normalised units, the base's too."""
    base: Int[Tensor, " B"]
    """Which slot is the base."""
    kind: JointKind

    def relative(self) -> Float[Tensor, "B S K"]:
        """States with respect to the base."""
        rows = torch.arange(len(self.base), device=self.base.device)
        return self.states - self.states[rows, self.base][:, None]

    def base_motion(self) -> Float[Tensor, "B K 4 4"]:
        """The base moves about the middle of the pivots of all others."""
        rows = torch.arange(len(self.base), device=self.base.device)
        others = F.one_hot(self.base, self.pivots.shape[1])[..., None] == 0
        middle = (self.pivots * others).sum(1) / (self.pivots.shape[1] - 1)
        return joint_motion(middle[:, None], self.axis, self.states[rows, self.base], self.kind)

    def motions(self) -> Float[Tensor, "B S K 4 4"]:
        """Every slot's: its own about its pivot, then the base's."""
        own = joint_motion(self.pivots[:, :, None], self.axis[:, None], self.relative(), self.kind)
        return self.base_motion()[:, None] @ own

    def order(self) -> Int[Tensor, "B S"]:
        """Slots with the base first."""
        return F.one_hot(self.base, self.pivots.shape[1]).argsort(
            dim=1, descending=True, stable=True
        )

    def only(self, anchor: Int[Tensor, " B"]) -> Kinematics:
        """The hypothesis of one anchor for each cloud, K = 1."""
        rows = torch.arange(len(anchor), device=anchor.device)
        return replace(
            self,
            axis=self.axis[rows, anchor][:, None],
            states=self.states[rows, :, anchor][..., None],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """What one pass over a cloud says."""

    points: Float[Tensor, "B N 3"]
    """The cloud as this pass saw it: with the motions of those before undone."""
    weights: Float[Tensor, "B N S"]
    anchor: Int[Tensor, " B"]
    turn: Float[Tensor, "B 3 3"]
    """The anchor's rotation."""
    chosen: Kinematics
    """Of that anchor."""

    def poses(self) -> Float[Tensor, "B S 4 4"]:
        """Canonical frame to the cloud of this pass, of every slot."""
        turn = rigid(self.turn, torch.zeros_like(self.turn[:, 0]))
        return turn[:, None] @ self.chosen.motions()[:, :, 0]

    def present(self) -> Bool[Tensor, "B S"]:
        """Which slots have won a point."""
        return F.one_hot(self.weights.argmax(-1), self.weights.shape[-1]).bool().any(1)

    def terms(self, steps: Float[Tensor, " T"]) -> dict[str, Tensor]:
        """Reconstruction of the whole and of the slots, pivots near parts; not weighted."""
        posed = apply(self.poses(), self.chosen.shapes)  # (B, S, M, 3)
        slots = losses.slot_distances(posed[:, :, None], self.points, self.weights)
        terms = {
            "whole": losses.whole(posed, self.points, self.present()),
            "slots": slots.mean(),
        }
        if self.chosen.kind == "revolute":
            terms["pivot"] = self._pivots(steps)
        return terms

    def _pivots(self, steps: Float[Tensor, " T"]) -> Tensor:
        """Near the parts as they stand placed, and as they are moved."""
        one, order = self.chosen, self.chosen.order()
        moved = apply(one.motions()[:, :, 0], one.shapes)
        pivots = gather(one.pivots, order[:, 1:])
        shifted = apply(one.base_motion()[:, 0], pivots)
        total = torch.zeros((), device=pivots.device)
        for shapes, pivot in ((one.shapes, pivots), (moved, shifted)):
            sorted_ = gather(shapes.flatten(2), order).view_as(shapes)
            base = sorted_[:, :1].expand_as(sorted_[:, 1:])
            pairs = torch.stack([base, sorted_[:, 1:]], 2)
            total = total + losses.pivots_near_parts(pivot, one.axis[:, 0], pairs, steps)
        return total


@dataclass(frozen=True, slots=True, kw_only=True)
class Usual:
    """What is the same for all clouds; None: each cloud has its own."""

    base: int | None = None
    """The base's slot."""
    anchor: int | None = None

    def anchors(self, points: Float[Tensor, "B N 3"]) -> Int[Tensor, " B"] | None:
        """That anchor for every cloud."""
        if self.anchor is None:
            return None
        return torch.full((len(points),), self.anchor, device=points.device)


@dataclass(frozen=True, slots=True, kw_only=True)
class Passed:
    """A pass, and what those before it have undone."""

    one: Pass
    before: Float[Tensor, "B S 4 4"]
    """The cloud of this pass to the aligned cloud, of every slot."""
    undone: Float[Tensor, "B S 3"]
    """How far each slot was moved back against the base, along the axis of the pass that said so:
    another anchor may name it the other way round."""

    def poses(self) -> Float[Tensor, "B S 4 4"]:
        """Canonical frame to the aligned cloud."""
        return self.before @ self.one.poses()

    def base(self) -> Float[Tensor, "B 4 4"]:
        """That of the base."""
        return gather(self.poses().flatten(2), self.one.chosen.order()[:, :1]).view(-1, 4, 4)

    def axis(self) -> Float[Tensor, "B 1 3"]:
        """Of all joints, in the aligned frame."""
        return (self.base()[:, :3, :3] @ self.one.chosen.axis[:, 0, :, None])[:, None, :, 0]

    def joints(self) -> tuple[Tensor, Tensor, Tensor]:
        """Pivots (B, J, 3), axes (B, J, 3) and states (B, J) of the moving slots, base first."""
        one, order, axis = self.one.chosen, self.one.chosen.order(), self.axis()
        pivots = apply(self.base(), gather(one.pivots, order[:, 1:]))
        state = one.relative()[..., 0] + (self.undone * axis).sum(-1)
        return pivots, axis.expand_as(pivots), state.gather(1, order[:, 1:])


class PartStage(nn.Module):
    """The networks of stage 1, for clouds that stage 0 has aligned."""

    def __init__(
        self, config: PartConfig, encoder: EncoderConfig, slots: int, kind: JointKind
    ) -> None:
        super().__init__()
        self.config, self.slots = config, slots
        self.kind: JointKind = kind
        width, channels = config.width, encoder.channels[-1]
        self.encoder = Encoder(encoder, group=False)
        self.grouping = Encoder(encoder, group=False)
        self.point_readout = PointReadout(channels, width)
        self.slot_attention = SlotAttention(slots, width, config.rounds)
        self.whole_readout = Readout(channels, width)
        self.axis = PerAnchor(width, 3)
        self.readouts = nn.ModuleList(Readout(channels, width) for _ in range(slots))
        self.angles = nn.ModuleList(PerAnchor(width, 1) for _ in range(slots))
        self.shapes = nn.ModuleList(ShapeDecoder(width, width, config.points) for _ in range(slots))
        self.centres = nn.ModuleList(ShapeDecoder(width, width, 1) for _ in range(slots))
        joints = slots if slots > 2 else 1  # two slots turn about one, whichever is the base
        self.pivots = nn.ModuleList(ShapeDecoder(width, width, 1) for _ in range(joints))

    def forward(
        self, clouds: Float[Tensor, "B S N 3"], label: Int[Tensor, "B N"] | None, usual: Usual
    ) -> Pass:
        """One pass.

        Args:
            clouds: The cloud with the motion of each slot undone; all alike in the first pass.
            label: Slot of every point in the pass before; None in the first.
            usual: Base and anchor, where they are fixed.
        """
        points, features, others = self._encode(clouds, label)
        weights = self.slot_attention(self.point_readout(others))
        found = self._kinematics(points, features, weights, usual.base)
        anchor = usual.anchors(points)
        if anchor is None:
            anchor = self._best(found, points, weights)
        rotations = cast("Tensor", self.whole_readout.rotations)
        return Pass(
            points=points,
            weights=weights,
            anchor=anchor,
            turn=rotations[anchor],
            chosen=found.only(anchor),
        )

    def _encode(
        self, clouds: Float[Tensor, "B S N 3"], label: Int[Tensor, "B N"] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Points, and their features of both encoders: each point in the cloud of its slot."""
        if label is None:
            points = clouds[:, 0]
            return points, self.encoder(points), self.grouping(points)
        batch, slots, count, _ = clouds.shape
        flat = clouds.flatten(0, 1)
        row = torch.arange(batch, device=label.device)[:, None]
        column = torch.arange(count, device=label.device)
        both = [one(flat).unflatten(0, (batch, slots)) for one in (self.encoder, self.grouping)]
        features, others = (one[row, label, column] for one in both)
        return clouds[row, label, column], features, others

    def _kinematics(
        self,
        points: Float[Tensor, "B N 3"],
        features: Float[Tensor, "B N 60 C"],
        weights: Float[Tensor, "B N S"],
        base: int | None,
    ) -> Kinematics:
        """Shapes, pivots, and axis and angles of every anchor."""
        member = F.one_hot(weights.argmax(-1), self.slots).bool()
        whole = self.whole_readout(points, features)
        shapes, states = [], []
        for s in range(self.slots):
            part = self.readouts[s](points, features, member[..., s])
            shapes.append(self.shapes[s](part.code) + self.centres[s](part.code))
            states.append(torch.sigmoid(self.angles[s](part.anchors)[..., 0]))
        reach = self.config.angle_range if self.kind == "revolute" else self.config.slide_range
        biggest = member.sum(1).argmax(-1)
        return Kinematics(
            shapes=torch.stack(shapes, 1),
            pivots=torch.cat([one(whole.code) for one in self.pivots], 1).expand(
                -1, self.slots, -1
            ),
            axis=F.normalize(self.axis(whole.anchors), dim=-1),
            states=reach * torch.stack(states, 1),
            base=biggest if base is None else torch.full_like(biggest, base),
            kind=self.kind,
        )

    @torch.no_grad()
    def _best(
        self, found: Kinematics, points: Float[Tensor, "B N 3"], weights: Float[Tensor, "B N S"]
    ) -> Int[Tensor, " B"]:
        """The anchor under which all slots' shapes fit the points best."""
        moved = apply(found.motions(), found.shapes[:, :, None])  # (B, S, 60, M, 3)
        posed = moved @ cast("Tensor", self.whole_readout.rotations).mT
        return losses.slot_distances(posed, points, weights).argmin(-1)

    def passes(self, aligned: Float[Tensor, "B N 3"], usual: Usual) -> list[Passed]:
        """All passes over clouds that stage 0 has aligned."""
        clouds = aligned[:, None].expand(-1, self.slots, -1, -1)
        label = None
        eye = torch.eye(4, dtype=aligned.dtype, device=aligned.device)
        before = eye.expand(len(aligned), self.slots, 4, 4)
        undone = torch.zeros_like(before[..., :3, 3])
        out: list[Passed] = []
        for _ in range(self.config.passes):
            one = self(clouds, label, usual)
            out.append(Passed(one=one, before=before, undone=undone))
            turn = rigid(one.turn, torch.zeros_like(one.turn[:, 0]))
            motion = (one.poses() @ invert(turn)[:, None]).detach()
            clouds = apply(invert(motion), clouds)
            before, label = before @ motion, one.weights.argmax(-1)
            undone = undone + (out[-1].axis() * one.chosen.relative()).detach()
        return out
