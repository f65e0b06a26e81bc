# SPDX-License-Identifier: MIT
"""Gauss-Newton steps of many placements against their views, the template held.

The loss is that of `joint_fit.view_loss`; each step matches anew, weights every match by the slope
of its robust distance, and solves one small linear system per placement: rotation, translation,
three scales, the states, and for prismatic joints the place on the body. A handful of such steps
does what `joint_fit.fit` does in four times as many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import roma
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.points import gather
from scapo.registered.bundle_adjustment import (
    SCALE_WEIGHT,
    SHIFT_WEIGHT,
    SLIDE_WEIGHT,
    oriented_nearest,
    should_be_seen,
)
from scapo.registered.pairwise import NORMAL_WEIGHT
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import Views

ALONG = 0.25
"""Weight of distances along the surface beside those across it."""
SHARPNESS = (80.0, 250.0)
"""Of the robust distance, per squared normalised length, at the first and the last step."""
DAMPING = 0.02
"""Share of the system's diagonal that is added to it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepOptions:
    """Of one call of `settle`."""

    steps: int = 6
    points: int = 96
    """Of each view, the same in every step: they come in the order of farthest-point sampling."""
    template_points: int = 128
    """Asked whether the camera would have seen them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Placed:
    """Template points in H views, with what each coordinate of the placement moves them by."""

    points: Float[Tensor, "H M 3"]
    normals: Float[Tensor, "H M 3"]
    jacobian: Float[Tensor, "H M D 3"]


def _place(
    template: ArticulatedTemplate, placement: Placement, index: Int[Tensor, "H M"]
) -> _Placed:
    """Chosen template points of every placement, and their derivatives.

    Columns: turn about the placement's origin (view axes), translation, log scales, states, shifts.
    """
    poses, weight = template.part_poses(placement), template.logit.softmax(-1)[index]
    scale, turn = placement.log_scale.exp(), placement.rotation
    scaled = template.points[index] * scale[:, None]
    points, normals = torch.zeros_like(scaled), torch.zeros_like(scaled)
    by_scale = scaled.new_zeros(*scaled.shape, 3)  # (H, M, 3 scales, 3)
    by_state, by_shift = [], []
    for p in range(weight.shape[-1]):
        share, rotation = weight[..., p : p + 1], poses.rotation[:, p]
        part = scaled @ rotation.mT + poses.translation[:, p, None]
        points = points + share * part
        normals = normals + share * (template.normals[index] @ rotation.mT)
        arm = scaled
        if p:
            pivot = template.pivot[p - 1] * scale  # the pivot grows with the body
            arm = scaled - pivot[:, None]
            by_scale = by_scale + share[..., None] * (pivot[:, None, :, None] * turn.mT[:, None])
            state, shift = _joint_columns(template, placement, p - 1, part)
            by_state.append((share * state)[:, :, None])
            by_shift += [share[..., None] * shift] if template.kinds[p - 1] == "prismatic" else []
        by_scale = by_scale + share[..., None] * (arm[..., None] * rotation.mT[:, None])
    eye = torch.eye(3).to(points).expand(*points.shape, 3)
    arm = points - placement.translation[:, None]
    by_turn = torch.linalg.cross(eye, arm[:, :, None].expand_as(eye))
    jacobian = torch.cat([by_turn, eye, by_scale, *by_state, *by_shift], 2)
    return _Placed(points=points, normals=F.normalize(normals, dim=-1), jacobian=jacobian)


def _joint_columns(
    template: ArticulatedTemplate, placement: Placement, j: int, points: Float[Tensor, "H M 3"]
) -> tuple[Float[Tensor, "H M 3"], Float[Tensor, "H 1 3 3"]]:
    """What the state of joint j, and its place across the axis, move its part's points by."""
    turn, axis = placement.rotation, template.directions()[j]
    leaning = template.leaning(placement)[:, j, :, None]
    way = (turn @ leaning)[..., 0][:, None].expand_as(points)
    across = torch.eye(3).to(axis) - axis[:, None] * axis
    shift = (turn @ across).mT[:, None]
    if template.kinds[j] == "prismatic":
        return way, shift
    pivot = template.pivot[j] * placement.log_scale.exp() + placement.shift[:, j]
    spot = (turn @ pivot[..., None])[..., 0] + placement.translation
    return torch.linalg.cross(way, points - spot[:, None]), shift


@torch.no_grad()
def settle(
    template: ArticulatedTemplate, views: Views, start: Placement, options: StepOptions
) -> Placement:
    """Improve as many placements as there are views, each on its own.

    Args:
        template: Held as it is.
        views: H views.
        start: Placements, one of each view.
        options: Steps and weights.
    """
    placement = start
    every = max(1, len(template.points) // options.template_points)
    some = torch.arange(0, len(template.points), every, device=template.points.device)
    view_points = views.points[:, : options.points]
    view_normals = views.normals[:, : options.points]
    for step in range(options.steps):
        low, high = SHARPNESS
        sharpness = low * (high / low) ** (step / max(options.steps - 1, 1))
        points, normals = template.place(placement)
        match = oriented_nearest(view_points, view_normals, points, normals)
        back_points, back_normals = points[:, some], normals[:, some]
        back = oriented_nearest(back_points, back_normals, view_points, view_normals)
        placed = _place(template, placement, torch.cat([match, some.expand(len(back), -1)], 1))
        target = torch.cat([view_points, gather(view_points, back)], 1)
        normal = torch.cat([view_normals, gather(view_normals, back)], 1)
        off = placed.points - target
        count = view_points.shape[1]
        cosine = (placed.normals[:, :count] * view_normals).sum(-1)
        near = torch.exp(-sharpness * off.square().sum(-1))
        there = near[:, :count] * torch.exp(-NORMAL_WEIGHT * (1 - cosine)) / count
        missed = near[:, count:] * should_be_seen(views, back_points, back_normals) / len(some)
        weight = sharpness * torch.cat([there, missed], 1)
        placement = _step(template, placement, placed.jacobian, (off, normal, weight))
    return placement


def _step(
    template: ArticulatedTemplate,
    placement: Placement,
    jacobian: Float[Tensor, "H N D 3"],
    residual: tuple[Float[Tensor, "H N 3"], Float[Tensor, "H N 3"], Float[Tensor, "H N"]],
) -> Placement:
    """Solve for one damped step and take it.

    Args:
        template: For the joints.
        placement: Where the step starts.
        jacobian: Of the points.
        residual: Point minus target, the target's normal, and the weight of the match.
    """
    off, normal, weight = residual
    root = weight.sqrt()
    across = (jacobian @ (normal * root[..., None])[..., None])[..., 0]  # (H, N, D)
    along = (jacobian * (ALONG**0.5 * root)[..., None, None]).transpose(2, 3).flatten(1, 2)
    rows = torch.cat([across, along], 1)
    right = torch.cat(
        [(off * normal).sum(-1) * root, (off * (ALONG**0.5 * root)[..., None]).flatten(1)], 1
    )
    system = rows.mT @ rows
    gradient = (rows.mT @ right[..., None])[..., 0]
    prior, value = _priors(template, placement)
    gradient = gradient + prior * value
    diagonal = system.diagonal(dim1=-2, dim2=-1)
    system = system + torch.diag_embed(prior + DAMPING * diagonal + 0.2)
    step = -torch.linalg.solve(system, gradient)
    return _move(template, placement, step)


def _priors(
    template: ArticulatedTemplate, placement: Placement
) -> tuple[Float[Tensor, " D"], Float[Tensor, "H D"]]:
    """Weight of each coordinate's square in the loss, and the coordinate's value.

    A sliding joint's states are held about 0, where `joint_fit` has the views' mean.
    """
    none = torch.zeros_like(placement.translation)
    value = [none, none, placement.log_scale, placement.state]
    weight = [0.0] * 6 + [SCALE_WEIGHT] * 3
    weight += [SLIDE_WEIGHT * (kind == "prismatic") for kind in template.kinds]
    for j, kind in enumerate(template.kinds):
        if kind == "prismatic":
            value.append(placement.shift[:, j])
            weight += [SHIFT_WEIGHT] * 3
    return torch.tensor(weight).to(none), torch.cat(value, 1)


def _move(
    template: ArticulatedTemplate, placement: Placement, step: Float[Tensor, "H D"]
) -> Placement:
    joints = len(template.kinds)
    turn = _bounded(step[:, :3], 0.4)
    shift = placement.shift.clone()
    axis = template.directions()
    column = 9 + joints
    for j, kind in enumerate(template.kinds):
        if kind == "prismatic":
            shift[:, j] += _bounded(step[:, column : column + 3], 0.1)
            shift[:, j] -= (shift[:, j] @ axis[j])[:, None] * axis[j]
            column += 3
    return replace(
        placement,
        rotation=roma.rotvec_to_rotmat(turn) @ placement.rotation,
        translation=placement.translation + _bounded(step[:, 3:6], 0.1),
        log_scale=placement.log_scale + _bounded(step[:, 6:9], 0.15),
        state=placement.state + step[:, 9 : 9 + joints].clamp(-0.4, 0.4),
        shift=shift,
    )


def _bounded(step: Float[Tensor, "H 3"], length: float) -> Float[Tensor, "H 3"]:
    """The step, shortened where it is longer: matches hold near the present placement only."""
    return step * (length / step.norm(dim=-1, keepdim=True).clamp_min(length))
