# SPDX-License-Identifier: MIT
"""What the heads of a supervised network say, what they should, and poses and states read off it.

Where a symmetry of the category exchanges parts, either order is right: `exchanged` is the truth in
the other one, `as_seen_by` an answer in the order of another.

Lengths are in units of twice the mean radius: the cloud is centred with mean radius 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.categories import Category
from scapo.geometry.part_order import joint_order, part_orders
from scapo.geometry.points import Similarity, gather
from scapo.geometry.rigid import apply, invert, mean_rotation, random_rotations, rigid
from scapo.geometry.rotations import rotmat_to_rotvec
from scapo.records import either
from scapo.registered.network import procrustes
from scapo.types import Labels

ROUNDS, TRUST = 4, 0.05
"""Repetitions of the Procrustes step, each with votes weighed by 1 / (1 + (off / TRUST)^2)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What the heads say, in the frame and unit of the points."""

    part: Float[Tensor, "B N P"]
    """Logits."""
    votes: Float[Tensor, "B N P 3"] | None
    """Each point in the frame of each part; None when pooled."""
    pose: Float[Tensor, "B P 4 4"] | None
    """None as long as there are only votes."""
    pivot: Float[Tensor, "B J 3"]
    """In the frame of the base, as the axis."""
    axis: Float[Tensor, "B J 3"]
    """Not of unit length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What the answer should be, in the frame and unit of the points."""

    part: Int[Tensor, "B N"]
    """-1: not known."""
    pose: Float[Tensor, "B P 4 4"]
    pivot: Float[Tensor, "B J 3"]
    axis: Float[Tensor, "B J 3"]
    """Unit vectors."""

    @staticmethod
    def of(labels: Labels, similarity: Similarity, who: str, size: float = 1.0) -> Target:
        """The labels of clouds that were normalised and then made `size` times as large.

        Args:
            labels: Camera frame, metres.
            similarity: The normalisation.
            who: Name of the method, for the message.
            size: By which lengths are multiplied after it.

        Raises:
            ValueError: Some are withheld.
        """
        if labels.part is None or labels.camera_T_part is None or labels.joints is None:
            raise ValueError(f"{who}: expected parts, poses and joints, found some withheld")
        pose = labels.camera_T_part.clone()
        pose[..., :3, 3] = size * similarity.forward(pose[..., :3, 3])
        return Target(
            part=labels.part.long(),
            pose=pose,
            pivot=size * similarity.forward(labels.joints.pivot),
            axis=F.normalize(labels.joints.axis, dim=-1),
        )


def turned_at_random(
    points: Float[Tensor, "B N 3"],
    target: Target,
    count: int | None,
    share: float,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "B K 3"], Target]:
    """Some of the points of each cloud, and some clouds turned with their truth.

    Args:
        points: Of the clouds.
        target: Theirs.
        count: Of points; None: all, as where there are no more.
        share: Of the clouds that are turned.
        generator: On the device of the clouds.
    """
    batch, number, _ = points.shape
    draw = {"generator": generator, "device": points.device}
    part = target.part
    if count is not None and count < number:
        chosen = torch.rand(batch, number, **draw).topk(count, dim=1).indices
        points, part = gather(points, chosen), part.gather(1, chosen)
    turned = torch.rand(batch, 1, 1, **draw) < share
    rotation = random_rotations(batch, generator, dtype=points.dtype)
    rotation = torch.where(turned, rotation, torch.eye(3).to(points))
    pose = rigid(rotation, rotation.new_zeros(batch, 3))
    return apply(pose, points), Target(
        part=part,
        pose=pose[:, None] @ target.pose,
        pivot=apply(pose, target.pivot),
        axis=target.axis @ rotation.mT,
    )


def exchange(parts: int) -> tuple[list[int], list[int], float]:
    """Parts and joints in the evaluator's other order, and the sign of their axes.

    Where base and child change roles, the joint turns the other way.
    """
    order = part_orders(parts)[1]
    return order.tolist(), joint_order(order[None])[0].tolist(), -1.0 if order[0] else 1.0


def exchanged(target: Target, symmetry: Float[Tensor, "3 3"]) -> Target:
    """The same truth with the parts exchanged that the category's symmetry exchanges.

    Rotations times the symmetry from the right.
    """
    turn = rigid(symmetry, symmetry.new_zeros(3))
    order, joints, sign = exchange(target.pose.shape[1])
    slot = torch.tensor(order).to(target.part)
    return Target(
        part=torch.where(target.part >= 0, slot[target.part], target.part),
        pose=target.pose[:, order] @ turn,
        pivot=target.pivot[:, joints],
        axis=sign * target.axis[:, joints],
    )


def as_seen_by(
    first: Float[Tensor, "B P 4 4"],
    points: Float[Tensor, "B N 3"],
    answer: Answer,
    symmetry: Float[Tensor, "3 3"],
) -> Answer:
    """The answer, for each cloud with the parts exchanged where its poses so lie nearer to others.

    A network that may take either order may take another for each hand of a cloud's points.

    Args:
        first: Poses that the answer's are compared with.
        points: That the answer is for.
        answer: With axes of unit length.
        symmetry: Of the category.
    """
    pose = poses_of(points, answer)
    base = pose[:, 0]
    order = exchange(pose.shape[1])[0]
    other = exchanged(
        Target(
            part=answer.part.argmax(-1),
            pose=pose,
            pivot=apply(base, answer.pivot),
            axis=answer.axis @ base[:, :3, :3].mT,
        ),
        symmetry,
    )
    gaps = [(some - first)[..., :3, :3].square().sum((1, 2, 3)) for some in (pose, other.pose)]
    back = invert(other.pose[:, 0])
    turned = Answer(
        part=answer.part[..., order],
        votes=None if answer.votes is None else answer.votes[:, :, order] @ symmetry,
        pose=None if answer.pose is None else other.pose,
        pivot=apply(back, other.pivot),
        axis=other.axis @ back[:, :3, :3].mT,
    )
    return either(gaps[1] < gaps[0], turned, answer)


@torch.no_grad()
def poses_by_vote(
    points: Float[Tensor, "B N 3"],
    votes: Float[Tensor, "B N P 3"],
    weight: Float[Tensor, "B N P"],
) -> Float[Tensor, "B P 4 4"]:
    """The pose of each part that its votes agree on best, those far off counting less."""
    batch, _, parts, _ = votes.shape
    source = votes.transpose(1, 2).flatten(0, 1)  # (B P, N, 3)
    target = points[:, None].expand(-1, parts, -1, -1).flatten(0, 1)
    given = weight.transpose(1, 2).flatten(0, 1)
    rotation, shift = procrustes(target, source, given)
    for _ in range(ROUNDS):
        off = (source @ rotation.mT + shift[:, None] - target).square().sum(-1)
        rotation, shift = procrustes(target, source, given / (1 + off / TRUST**2))
    return rigid(rotation, shift).unflatten(0, (batch, parts))


def poses_of(points: Float[Tensor, "B N 3"], answer: Answer) -> Float[Tensor, "B P 4 4"]:
    """The answer's own, or those that its votes agree on."""
    if answer.votes is not None:
        return poses_by_vote(points, answer.votes, answer.part.softmax(-1))
    assert answer.pose is not None  # noqa: S101 - heads answer with votes or poses
    return answer.pose


def mean_pose(poses: Float[Tensor, "H *B 4 4"]) -> Float[Tensor, "*B 4 4"]:
    """Chordal mean of the rotations, mean of the translations."""
    rotation = mean_rotation(poses[..., :3, :3].movedim(0, -3))
    return rigid(rotation, poses[..., :3, 3].mean(0))


def states(
    pose: Float[Tensor, "B P 4 4"],
    axis: Float[Tensor, "B J 3"],
    category: Category,
    scale: Float[Tensor, " B"],
) -> Float[Tensor, "B J"]:
    """How far each joint is from rest, by the poses of its parts: about or along the axis; rad, m.

    Args:
        pose: Of the parts.
        axis: Unit vectors, in the frame of the base.
        category: Says which parts a joint links and how.
        scale: Length of a metre in the unit of the poses, of each cloud.
    """
    found = []
    for j, joint in enumerate(category.joints):
        motion = invert(pose[:, joint.parent]) @ pose[:, joint.child]
        if joint.kind == "revolute":
            found.append((rotmat_to_rotvec(motion[:, :3, :3]) * axis[:, j]).sum(-1))
        else:
            found.append((motion[:, :3, 3] * axis[:, j]).sum(-1) / scale)
    return torch.stack(found, 1)
