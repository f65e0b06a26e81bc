# SPDX-License-Identifier: MIT
"""States of the views of one object, and the part that has them: pairs vote, then points answer.

Bodies are in one frame and the joint is known; the state of every view is not, nor which points
belong to the part. What may have moved in one view is carried by every amount into the others; the
states are those whose differences explain most of all pairs. With the states known, a point belongs
to the part if other views confirm it there rather than where it stood (`motion_segmentation`), and
the pairs are asked again with those points alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.registered.joint_proposals import (
    AMOUNT,
    TIE,
    JointProposal,
    PosedViews,
    matched,
    most_moved,
    motions,
)
from scapo.registered.motion_segmentation import favouring_base, gather_evidence, smooth
from scapo.registered.pairwise import NearestGrid
from scapo.registered.template import PartPoses

STEPS = 24  # Amounts to either side
ROUNDS = 2  # Of states and parts
LEAST_CARRIED = 6  # Points of a view that must have moved for it to be asked
SWEEPS = 20  # Over all views, in which each takes the state that agrees best with the others
BEYOND = 3  # Steps beyond the states of all others that a view may take
ENDS = (0.1, 0.9)  # Quantiles of the states whose middle is the part's own place


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """What one joint did in B views of one object."""

    state: Float[Tensor, " B"]
    """Rad or normalised length, 0 in the middle of those that were seen."""
    moved: Bool[Tensor, "B K"]
    """The part's among the first K points of each view."""
    score: float
    """Mean share of the part's points that other views show at their states."""
    support: float
    """Mean over all points of the log support by the motion, of the two, that fits better."""

    def back(
        self, posed: PosedViews, joint: JointProposal, kind: JointKind
    ) -> tuple[Float[Tensor, "B K 3"], Float[Tensor, "B K 3"]]:
        """Points and normals in the common frame, those of the part moved back to state 0."""
        points, normals = posed.world(self.moved.shape[1])
        turn, move = _motion(joint, -self.state, kind)
        own = self.moved[..., None]
        points = torch.where(own, points @ turn.mT + move[:, None], points)
        return points, torch.where(own, normals @ turn.mT, normals)


@torch.no_grad()
def motion_of(
    posed: PosedViews, moved: Bool[Tensor, "B K"], joint: JointProposal, kind: JointKind
) -> Motion:
    """States and part of a joint.

    Args:
        posed: Views of one object.
        moved: Points that may have moved, many of which did not.
        joint: In the frame of the views.
        kind: Of the joint.
    """
    count = moved.shape[1]
    state, score, log_support = torch.zeros(len(moved)), 0.0, torch.zeros(1)
    for _ in range(ROUNDS):
        table = _pair_scores(posed, moved, joint, kind)
        state, score = synchronised_states(table, AMOUNT[kind][1] / STEPS)
        part, log_support = _parts_of(posed, [joint], [state], [kind], count)
        moved = part == 1
    middle = state.quantile(torch.tensor(ENDS)).mean()
    mean = float(log_support.amax(-1).mean())
    return Motion(state=state - middle, moved=moved, score=score, support=mean)


@torch.no_grad()
def apart(
    posed: PosedViews,
    joints: Sequence[JointProposal],
    motions: Sequence[Motion],
    kinds: Sequence[JointKind],
) -> tuple[Motion, ...]:
    """The motions of all joints of one object, every point of one part.

    Each joint by itself takes what another has moved for its own as readily as for the body's.
    """
    if len(motions) == 1:
        return tuple(motions)
    states, count = [motion.state for motion in motions], motions[0].moved.shape[1]
    part, _ = _parts_of(posed, joints, states, kinds, count)
    return tuple(replace(one, moved=part == j + 1) for j, one in enumerate(motions))


def _parts_of(
    posed: PosedViews,
    joints: Sequence[JointProposal],
    states: Sequence[Float[Tensor, " B"]],
    kinds: Sequence[JointKind],
    count: int,
) -> tuple[Int[Tensor, "B {count}"], Float[Tensor, "B {count} P"]]:
    """Of which part the first points of each view are, and the log support of each part."""
    poses = _part_poses(posed, joints, states, kinds)
    own = torch.arange(len(posed.translation))
    none = torch.zeros_like(posed.translation)
    evidence = gather_evidence(posed.views, poses, none, count=count, observers=own)
    support = smooth(posed.views, evidence.log_support)
    part = favouring_base(support - support.mean(-1, keepdim=True)).argmax(-1)
    return part, evidence.log_support


def _pair_scores(
    posed: PosedViews, moved: Bool[Tensor, "B K"], joint: JointProposal, kind: JointKind
) -> Float[Tensor, "B B D"]:
    """How well what moved in a view is shown by another after each amount, from all to none."""
    count = len(moved)
    spread = torch.linspace(TIE, 0, moved.shape[1]).expand(moved.shape)  # the first are spread out
    points, normals, weight = most_moved(posed, moved, spread)
    grid = NearestGrid.build(*posed.world(posed.views.points.shape[1]))
    step = torch.linspace(-1, 1, 2 * STEPS + 1) * AMOUNT[kind][1]
    turn, move = _motion(joint, step, kind)
    every: Int[Tensor, " B"] = torch.arange(count)
    table = torch.zeros(count, count, len(step))
    for view in (weight.sum(1) >= LEAST_CARRIED).nonzero()[:, 0].tolist():
        there, facing = points[view] @ turn.mT + move[:, None], normals[view] @ turn.mT
        match = matched(posed, grid, (every, every), there, facing)
        table[view] = (match * weight[view]).sum(-1) / weight[view].sum()
    return table


def synchronised_states(
    table: Float[Tensor, "B B D"], step: float
) -> tuple[Float[Tensor, " B"], float]:
    """The states whose differences score most over all pairs, and that score.

    From each view in turn: all others as it sees them, then each as all others see it, until none
    changes.

    Args:
        table: Of the difference of the second view's state to the first's, from least to most.
        step: Between two entries.
    """
    table = table + table.transpose(0, 1).flip(-1)
    count, most = len(table), table.shape[-1] // 2
    every = torch.arange(count)
    best, score = torch.zeros(count, dtype=torch.long), -torch.inf
    for first in range(count):
        told = table[first].amax(-1) > 0  # Views of which it says nothing stay where it is
        state = torch.where(told, table[first].argmax(-1) - most, 0)
        state[first] = 0
        for _ in range(SWEEPS):
            before = state.clone()
            for view in range(count):
                tried = torch.arange(int(state.min()) - BEYOND, int(state.max()) + BEYOND + 1)
                value = _agreement(table[view], state - tried[:, None], view)
                if value.max() > value[state[view] - tried[0]]:  # where nothing tells, none drifts
                    state[view] = tried[value.argmax()]
            if torch.equal(before, state):
                break
        off = (state - state[:, None]).clamp(-most, most) + most
        value = table.gather(2, off[..., None])[..., 0]
        total = float(value.sum() - value[every, every].sum()) / (2 * count * max(1, count - 1))
        if total > score:
            best, score = state, total
    return best * step, score


def _agreement(
    row: Float[Tensor, "B D"], off: Int[Tensor, "S B"], view: int
) -> Float[Tensor, " S"]:
    """What all others say of each state of a view; nothing where they are too far apart."""
    most = row.shape[-1] // 2
    value = row.gather(1, off.T.clamp(-most, most) + most).T
    value = torch.where(off.abs() <= most, value, 0.0)
    return value.sum(1) - value[:, view]


def _part_poses(
    posed: PosedViews,
    joints: Sequence[JointProposal],
    states: Sequence[Float[Tensor, " B"]],
    kinds: Sequence[JointKind],
) -> PartPoses:
    """view_T_body, and view_T_part of each joint's part, at the states."""
    rotations, translations = [posed.rotation], [posed.translation]
    for joint, state, kind in zip(joints, states, kinds, strict=True):
        turn, move = _motion(joint, state, kind)
        rotations.append(posed.rotation @ turn)
        translations.append(posed.translation + (posed.rotation @ move[..., None])[..., 0])
    return PartPoses(rotation=torch.stack(rotations, 1), translation=torch.stack(translations, 1))


def _motion(
    joint: JointProposal, amount: Float[Tensor, " D"], kind: JointKind
) -> tuple[Float[Tensor, "D 3 3"], Float[Tensor, "D 3"]]:
    turn, move = motions(joint.axis, joint.pivot[None], amount, kind)
    return turn[0], move[0]
