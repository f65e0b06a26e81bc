# SPDX-License-Identifier: MIT
"""Gauss-Newton steps of many placements against their views, the template held.

The loss is `view_loss`; each step matches anew, weights every match by the slope of its robust
distance, and solves one small linear system per placement: rotation, translation, three scales, the
states, and for prismatic joints the place on the body. A handful of such steps does what
`bundle_adjust` does in four times as many. They do not leave a wrong state: `search_states` does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.points import gather
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, take
from scapo.registered.gauss_newton import bounded, by_turn, damped_step
from scapo.registered.template import ArticulatedTemplate, Placement, across_axis
from scapo.registered.view_loss import (
    match_weight,
    normal_weight,
    oriented_nearest,
    sharpened,
    should_be_seen,
    view_loss,
)
from scapo.registered.views import PartialViews

SCALE_WEIGHT = 0.05  # Of the squared log scales
SHIFT_WEIGHT = 0.2
"""Of a sliding part's squared place across its axis, per squared normalised length."""
SLIDE_WEIGHT = 0.7
"""Of a sliding joint's states about their mean: without it a part slides right through the body to
explain its far side."""
ALONG = 0.25  # Weight of distances along the surface beside those across it
SHARPNESS = (80.0, 250.0)
"""Of `match_weight`, per squared normalised length, at the first and the last step."""
DAMPING, LEAST_DAMPING = 0.02, 0.2
"""Share of the system's diagonal that is added to it, and what is added beyond: coordinates that no
point tells stay."""
MOST_TURN, MOST_STATE = 0.4, 0.4  # Rad (or normalised length) of one step
MOST_MOVE, MOST_SCALE = 0.1, 0.15  # Normalised length, and log scale, of one step
POSE = 9  # Coordinates of a placement before its states: turn, translation, log scales
SHIFTS = tuple(0.05 * k for k in range(-5, 6))
"""Places of a sliding part across its joint's axis that are tried; the mean radius is 0.25."""
CHUNK = 256  # Hypotheses refined at once, with templates of up to `LIGHT` points
LIGHT = 400  # Points of the template that the search uses until its last steps
RANKED, BACKWARD = 250.0, 2.0
"""Sharpness of the loss that ranks hypotheses, and weight in it of the template's visible points:
what was not seen tells wrong ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepOptions:
    """Of one call of `refine`."""

    steps: int = 6
    points: int = 96
    """Of each view, the same in every step: they come in the order of farthest-point sampling."""
    template_points: int = 128
    """Asked whether the camera would have seen them."""


@torch.no_grad()
def refine(
    template: ArticulatedTemplate, views: PartialViews, start: Placement, options: StepOptions
) -> tuple[Placement, Float[Tensor, " H"]]:
    """Improve hypotheses (as many as views) and give the loss of each.

    The loss is over every second point, or all if the steps use them all.
    """
    placements, losses = [], []
    chunk = max(1, CHUNK * LIGHT // max(LIGHT, len(template.points)))
    for index in torch.arange(len(views.points), device=views.points.device).split(chunk):
        part = take(views, index)
        placement = refine_gauss_newton(template, part, take(start, index), options)
        total = part.points.shape[1]
        every = 1 if options.points >= total else 2
        some = part.thinned(torch.arange(0, total, every, device=index.device))
        loss = view_loss(some, template.place(placement), RANKED, BACKWARD)
        placements.append(placement)
        losses.append(loss + SCALE_WEIGHT * placement.log_scale.square().sum(-1))
    return cat(placements), torch.cat(losses)


@torch.no_grad()
def refine_gauss_newton(
    template: ArticulatedTemplate, views: PartialViews, start: Placement, options: StepOptions
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
    for sharpness in sharpened(SHARPNESS, options.steps):
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
        near = match_weight(off.square().sum(-1), sharpness)
        there = near[:, :count] * normal_weight(cosine) / count
        missed = near[:, count:] * should_be_seen(views, back_points, back_normals) / len(some)
        weight = sharpness * torch.cat([there, missed], 1)
        placement = _step(template, placement, placed.jacobian, (off, normal, weight))
    return placement


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
    turned = by_turn(points - placement.translation[:, None])
    jacobian = torch.cat([turned, eye, by_scale, *by_state, *by_shift], 2)
    return _Placed(points=points, normals=F.normalize(normals, dim=-1), jacobian=jacobian)


def _joint_columns(
    template: ArticulatedTemplate, placement: Placement, j: int, points: Float[Tensor, "H M 3"]
) -> tuple[Float[Tensor, "H M 3"], Float[Tensor, "H 1 3 3"]]:
    """What the state of joint j, and its place across the axis, move its part's points by."""
    turn, axis = placement.rotation, template.directions()[j]
    own = template.own_directions(placement)[:, j, :, None]
    way = (turn @ own)[..., 0][:, None].expand_as(points)
    across = torch.eye(3).to(axis) - axis[:, None] * axis
    shift = (turn @ across).mT[:, None]
    if template.kinds[j] == "prismatic":
        return way, shift
    pivot = template.pivot[j] * placement.log_scale.exp() + placement.shift[:, j]
    spot = (turn @ pivot[..., None])[..., 0] + placement.translation
    return torch.linalg.cross(way, points - spot[:, None]), shift


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
    damping = prior + DAMPING * system.diagonal(dim1=-2, dim2=-1) + LEAST_DAMPING
    return _move(template, placement, damped_step(system, gradient, damping))


def _priors(
    template: ArticulatedTemplate, placement: Placement
) -> tuple[Float[Tensor, " D"], Float[Tensor, "H D"]]:
    """Weight of each coordinate's square in the loss, and the coordinate's value.

    A sliding joint's states are held about 0, where `bundle_adjust` has the views' mean.
    """
    none = torch.zeros_like(placement.translation)
    value = [none, none, placement.log_scale, placement.state]
    weight = [0.0] * (POSE - 3) + [SCALE_WEIGHT] * 3
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
    turn = bounded(step[:, :3], MOST_TURN)
    shift = placement.shift.clone()
    axis = template.directions()
    column = POSE + joints
    for j, kind in enumerate(template.kinds):
        if kind == "prismatic":
            shift[:, j] += bounded(step[:, column : column + 3], MOST_MOVE)
            shift[:, j] -= (shift[:, j] @ axis[j])[:, None] * axis[j]
            column += 3
    return replace(
        placement,
        rotation=rotvec_to_rotmat(turn) @ placement.rotation,
        translation=placement.translation + bounded(step[:, 3:6], MOST_MOVE),
        log_scale=placement.log_scale + bounded(step[:, 6:POSE], MOST_SCALE),
        state=placement.state + step[:, POSE : POSE + joints].clamp(-MOST_STATE, MOST_STATE),
        shift=shift,
    )


@torch.no_grad()
def search_states(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    states: Float[Tensor, "J S"],
    sharpness: float,
) -> Placement:
    """Each joint's best state of a grid, the others held, the present state among them.

    Of a sliding joint also its part's best place across the axis, of `SHIFTS`.
    """
    for j, kind in enumerate(template.kinds):
        here = placement.state[:, j : j + 1]
        tried = torch.cat([here, states[j].to(here).expand(len(here), -1)], 1)
        moved = torch.zeros_like(placement.state)
        moved[:, j] = 1.0
        options = [
            replace(placement, state=placement.state + (column[:, None] - here) * moved)
            for column in tried.T
        ]
        placement = _best_option(template, views, placement, options, sharpness)
        if kind != "prismatic":
            continue
        for across in across_axis(template.directions()[j]):
            place = placement.shift @ across
            options = [placement]
            for amount in SHIFTS:
                step = (moved * (amount - place))[..., None] * across
                options.append(replace(placement, shift=placement.shift + step))
            placement = _best_option(template, views, placement, options, sharpness)
    return placement


def _best_option(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    options: list[Placement],
    sharpness: float,
) -> Placement:
    """For each view the states and shifts of that of the placements which has the least loss."""
    loss = [view_loss(views, template.place(option), sharpness) for option in options]
    best = torch.stack(loss).argmin(0)
    every = torch.arange(len(best), device=best.device)
    return replace(
        placement,
        state=torch.stack([option.state for option in options])[best, every],
        shift=torch.stack([option.shift for option in options])[best, every],
    )
