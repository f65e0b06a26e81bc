# SPDX-License-Identifier: MIT
"""Stage 2's networks begin at parts and joints that are known: regression before their losses.

Not in the paper. For some training clouds the search of parts, or another run (`warm_start`), tells
how the template lies in them; here that becomes what Theta_J, Theta_K and Theta_Delta should say of
them, in the aligned frame of the encoder, and the networks are fitted to it. No label is involved.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from scapo.categories import JointKind
from scapo.geometry.rigid import apply, joint_motion, rotation_between
from scapo.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from scapo.method import NO_JOURNAL, Journal
from scapo.paper.heads import JointNetwork, JointPairs, KeypointNetwork, ResidualNetwork
from scapo.paper.part_search import Placements, Skeleton
from scapo.records import take


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstTargets:
    """What the networks should say of each cloud."""

    joints: JointPairs
    """Aligned frame."""
    template_joints: JointPairs
    residual: Float[Tensor, "B M 3"]
    keypoints: Float[Tensor, "B P 3"]
    """Aligned frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lying:
    """Each cloud's own shape with its joints at rest, template frame, and how it lies."""

    points: Float[Tensor, "B M 3"]
    keypoints: Float[Tensor, "B P 3"]
    pivot: Float[Tensor, "B J 3"]
    axis: Float[Tensor, "J 3"]
    """Unit vectors, the same for all."""
    turn: Float[Tensor, "B 3 3"]
    """aligned_R_template, of the base."""
    shift: Float[Tensor, "B 3"]
    state: Float[Tensor, "B J"]


def lying(s: Skeleton, at: Placements) -> Lying:
    """A skeleton as it was placed: in three sizes, its parts where they sit on each body."""
    size = at.size.exp()[:, None]
    aside = F.pad(at.aside, (0, 0, 1, 0))  # (B, P, 3); the base's is 0
    return Lying(
        points=s.points * size + s.weights() @ aside,
        keypoints=s.keypoints * size + aside,
        pivot=s.pivot * size + at.aside,
        axis=F.normalize(s.axis, dim=-1),
        turn=rotvec_to_rotmat(at.turn),
        shift=at.shift,
        state=at.state,
    )


def first_targets(
    template: Float[Tensor, "M 3"], own: Lying, kinds: tuple[JointKind, ...]
) -> FirstTargets:
    """Targets from where the template lies in each cloud.

    The base's turn about the joint's axis is its state; the rest of its pose is in axis and pivot.
    """
    turn = own.turn
    axis_y = own.axis.expand(len(turn), -1, -1)
    axis_x = axis_y @ turn.mT
    twist = turn.mT[:, None] @ rotation_between(axis_x, axis_y).mT  # about axis_y (B, J, 3, 3)
    angle = (rotmat_to_rotvec(twist) * axis_y).sum(-1)
    hinge = torch.tensor([kind == "revolute" for kind in kinds], device=angle.device)
    angle = torch.where(hinge, angle, 0.0)
    keypoints = [own.keypoints[:, :1]]
    for j, kind in enumerate(kinds):
        motion = joint_motion(own.pivot[:, j], axis_y[:, j], own.state[:, j], kind)
        keypoints.append(apply(motion, own.keypoints[:, j + 1, None]))
    place = torch.cat(keypoints, 1) @ turn.mT + own.shift[:, None]
    return FirstTargets(
        joints=JointPairs(
            pivot=own.pivot @ turn.mT + own.shift[:, None],
            axis=axis_x,
            state=torch.stack([-angle, own.state - angle], -1),
        ),
        template_joints=JointPairs(
            pivot=own.pivot,
            axis=axis_y,
            state=torch.zeros_like(own.state)[..., None].expand(-1, -1, 2),
        ),
        residual=own.points - template,
        keypoints=place,
    )


def joint_error(said: JointPairs, wanted: JointPairs) -> Float[Tensor, ""]:
    """Squared errors of pivots, axes and states."""
    return (
        3 * (said.pivot - wanted.pivot).square().sum(-1).mean()
        + (said.axis - wanted.axis).square().sum(-1).mean()
        + (said.state - wanted.state).square().sum(-1).mean()
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What the networks see of the clouds, constant while the encoder is."""

    template: Float[Tensor, "M 3"]
    """Y_base."""
    aligned: Float[Tensor, "B N 3"]
    code: Float[Tensor, "B Z"]
    features: Float[Tensor, "B M C"]


RATE = 2e-3
"""Learning rate at the beginning."""


@torch.enable_grad()
def fit_networks(
    networks: tuple[JointNetwork, KeypointNetwork, ResidualNetwork],
    inputs: Inputs,
    wanted: FirstTargets,
    generator: torch.Generator,
    steps: int,
    journal: Journal = NO_JOURNAL,
) -> list[float]:
    """Fit the three networks to the targets; the mean loss of every 50 steps.

    Args:
        networks: Theta_J, Theta_K, Theta_Delta.
        inputs: Of the clouds.
        wanted: Of the same clouds.
        generator: Chooses batches and points.
        steps: Of Adam, 32 clouds each, the rate on half a cosine from RATE.
        journal: Told how far it is.
    """
    joints, keypoints, residual = networks
    parameters = trainable(networks)
    optimizer = torch.optim.Adam(parameters, lr=RATE)
    count, number = inputs.aligned.shape[:2]
    history: list[float] = []
    began = time.monotonic()
    for k in range(steps):
        if k % 50 == 1:
            left = (time.monotonic() - began) / k * (steps - k)
            journal.tell("networks fitted to it", k / steps, left)
        index = torch.randint(count, (32,), generator=generator, device=generator.device)
        order = torch.randperm(number, generator=generator, device=generator.device)
        want = take(wanted, index)
        change = residual(inputs.features[index])
        own, its = joints.pair(inputs.aligned[index][:, order], inputs.template + change.detach())
        loss = (
            joint_error(own, want.joints)
            + joint_error(its, want.template_joints)
            + 10 * (change - want.residual).square().sum(-1).mean()
            + (keypoints(inputs.code[index]) - want.keypoints).square().sum(-1).mean()
        )
        for group in optimizer.param_groups:
            group["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * k / steps))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        history.append(float(loss.detach()))
    return [sum(history[k : k + 50]) / 50 for k in range(0, steps - 49, 50)]


def trainable(networks: Sequence[nn.Module]) -> list[nn.Parameter]:
    """Their parameters, which can be learned from here on."""
    for network in networks:
        network.train().requires_grad_(True)
    return [parameter for network in networks for parameter in network.parameters()]
