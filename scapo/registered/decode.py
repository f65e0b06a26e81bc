# SPDX-License-Identifier: MIT
"""A placement of the template as a prediction in metres and the camera frame."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.points import Similarity, smoothed
from scapo.geometry.rigid import rigid
from scapo.registered.joint_limits import JointLimits
from scapo.registered.template import ArticulatedTemplate, PartPoses, Placement, oriented
from scapo.types import Joints, Prediction


@torch.no_grad()
def placed_prediction(
    template: ArticulatedTemplate,
    placement: Placement,
    rest: Float[Tensor, "B J"],
    origin: Float[Tensor, " 3"],
    part_weight: Float[Tensor, "B N P"],
    similarity: Similarity,
) -> Prediction:
    """The prediction that a placement in normalised frames stands for.

    States count from `rest`, so that every part is its base moved by its joint.

    Args:
        template: The category's.
        placement: Of each cloud.
        rest: States at which the frames of a part and the base are the same (`lying_rest`).
        origin: The template's point at which part frames sit, in its own size.
        part_weight: Of the points.
        similarity: The normalisation to undo.
    """
    poses = part_frames(template, placement, rest)
    origin = origin * placement.log_scale.exp()
    move = (poses.rotation @ origin[:, None, :, None])[..., 0] + poses.translation
    pivot, axis = template.joints_in_view(placement)
    metric = placement.state / similarity.scale[:, None]
    state = torch.where(template.sliding[:, 0] > 0, metric, placement.state - rest)
    shape, normals = canonical_surface(template, placement, rest)
    part = template.logit.argmax(-1)
    return Prediction(
        part_weight=part_weight,
        camera_T_part=similarity.inverse_pose(rigid(poses.rotation, move)),
        joints=Joints(pivot=similarity.inverse(pivot), axis=axis, state=state),
        canonical_points=(shape - origin[:, None]) / similarity.scale[:, None, None],
        canonical_normals=normals,
        canonical_part=part.expand(len(shape), -1),
    )


@torch.no_grad()
def metric_limits(
    template: ArticulatedTemplate,
    limits: JointLimits,
    rest: Float[Tensor, "B J"],
    similarity: Similarity,
) -> Float[Tensor, "B J 2"]:
    """Joint limits in the units and from the zero of the predicted states."""
    ends = torch.stack([limits.low, limits.high], -1)
    metric = ends / similarity.scale[:, None, None]
    return torch.where(template.sliding > 0, metric, ends - rest[..., None])


@torch.no_grad()
def lying_rest(template: ArticulatedTemplate, placement: Placement) -> Float[Tensor, "B J"]:
    """States from which hinged parts have turned as far as they lie turned, rad.

    A placement stretches the template along its base's directions before joints move. A door that
    is half open in the template lies askew to these: stretched, it is sheared, and lies as its
    points do, not as its state says. Of the shear the nearest rotation about the hinge (Procrustes)
    counts as the state's; what is left is the template's own rest.
    """
    share, scale = template.logit.softmax(-1), placement.log_scale.exp()
    turns = []
    for j, axis in enumerate(template.directions()):
        weight = share[:, j + 1, None] / share[:, j + 1].sum()
        arm = template.points - (weight * template.points).sum(0)
        moment = ((weight * arm).mT @ arm) * scale[:, None]  # (B, 3, 3): mean of x (S x)^T
        curl = torch.stack([(moment - moment.mT)[:, k - 2, k - 1] for k in range(3)], -1)
        along = (moment @ axis) @ axis
        turns.append(torch.atan2(curl @ axis, moment.diagonal(dim1=1, dim2=2).sum(1) - along))
    return template.rest - torch.stack(turns, 1) * (1 - template.sliding[:, 0])


def part_frames(
    template: ArticulatedTemplate, placement: Placement, rest: Float[Tensor, "B J"]
) -> PartPoses:
    """view_T_part with frames that all parts share with the base when joints are at `rest`.

    Where a joint sits on the body moves its part, not that frame.
    """
    poses = template.part_poses(placement)
    rested = template.part_poses(replace(placement, state=rest))
    turn = poses.rotation @ rested.rotation.mT
    gap = placement.translation[:, None] - rested.translation
    aside = F.pad(_aside(template, placement), (0, 0, 1, 0)) @ placement.rotation.mT
    return PartPoses(
        rotation=turn @ placement.rotation[:, None],
        translation=poses.translation + aside + (turn @ (gap - aside)[..., None])[..., 0],
    )


def _aside(template: ArticulatedTemplate, placement: Placement) -> Float[Tensor, "B J 3"]:
    """Of the object's own hinges from where the template's are, on the base; 0 of what slides."""
    if placement.pivot is None:
        return torch.zeros_like(placement.shift)
    return (placement.pivot - template.pivots(placement)) * (1 - template.sliding)


@torch.no_grad()
def canonical_surface(
    template: ArticulatedTemplate, placement: Placement, rest: Float[Tensor, "B J"]
) -> tuple[Float[Tensor, "B M 3"], Float[Tensor, "B M 3"]]:
    """Points and normals of the template in each cloud's size, at the states `rest`, which are 0.

    They are in the template's frame. Moved by its joint, each part lies as it is placed.
    """
    still = replace(placement, state=rest)
    own, aside = placement.rotation[:, None], _aside(template, placement)
    rested, turned = (template.part_poses(some).rotation[:, 1:] for some in (still, placement))
    returned = (own.mT @ rested @ turned.mT @ own @ aside[..., None])[..., 0]
    still = replace(
        still,
        shift=still.shift + aside - returned,
        rotation=torch.eye(3).to(placement.rotation).expand_as(placement.rotation),
        translation=torch.zeros_like(placement.translation),
    )
    return template.place(still)


@torch.no_grad()
def nearest_weights(
    template: ArticulatedTemplate,
    points: Float[Tensor, "B N 3"],
    normals: Float[Tensor, "B N 3"],
    placement: Placement,
) -> Float[Tensor, "B N P"]:
    """Part weights of the placed template's points that are nearest in position and normal."""
    placed, placed_normals = template.place(placement)
    source, target = oriented(points, normals), oriented(placed, placed_normals)
    weight = template.logit.softmax(-1)
    return torch.stack(
        [smoothed(one, other, weight) for one, other in zip(source, target, strict=True)]
    )
