# SPDX-License-Identifier: MIT
"""Gauss-Newton steps of many placements against their views, the template held.

The loss is `view_loss`; each step matches anew, weights every match by the slope of its robust
distance, and solves one small linear system per placement: rotation, translation, three scales, the
states, and the places of joints on the body. A handful of such steps does what
`bundle_adjust` does in four times as many. They do not leave a wrong state: `search_states` does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import gather
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, take
from scapo.registered.gauss_newton import bounded, by_turn, damped_step, weighted_equations
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
SHIFT_WEIGHT: dict[JointKind, float] = {"revolute": 0.4, "prismatic": 0.2}
"""Of a part's squared place across its joint's axis, per squared normalised length: drawers sit
anywhere in a cabinet, hinges seldom far from where others have them."""
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
MOVED = 0.25
"""Of that weight, for points of a part that moves: parts differ more in size than bodies do, and a
narrow door that stands open should not count as shut because the template's is wider."""


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
    placement = improved(template, views, start, options)
    total = views.points.shape[1]
    every = 1 if options.points >= total else 2
    some = views.thinned(torch.arange(0, total, every, device=views.points.device))
    weight = backward_weight(template)
    losses = [
        view_loss(take(some, index), template.place(take(placement, index)), RANKED, weight)
        for index in _chunks(template, views)
    ]
    return placement, torch.cat(losses) + SCALE_WEIGHT * placement.log_scale.square().sum(-1)


def backward_weight(template: ArticulatedTemplate) -> Float[Tensor, " M"]:
    """Of each point of the template in the loss that ranks; of two like halves neither is less."""
    moves = template.logit.argmax(-1) > 0
    return BACKWARD * torch.where(moves & ~template.alike.bool(), MOVED, 1.0)


def improved(
    template: ArticulatedTemplate, views: PartialViews, start: Placement, options: StepOptions
) -> Placement:
    """The same without the losses."""
    parts = [
        refine_gauss_newton(template, take(views, index), take(start, index), options)
        for index in _chunks(template, views)
    ]
    return cat(parts)


def _chunks(template: ArticulatedTemplate, views: PartialViews) -> tuple[Tensor, ...]:
    """Views that are looked at together: a matter of memory."""
    size = max(1, CHUNK * LIGHT // max(LIGHT, len(template.points)))
    return torch.arange(len(views.points), device=views.points.device).split(size)


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
    placement, skin = start, Skin.of(template)
    every = max(1, len(template.points) // options.template_points)
    some = torch.arange(0, len(template.points), every, device=template.points.device)
    points, normals = views.points[:, : options.points], views.normals[:, : options.points]
    count = points.shape[1]
    for sharpness in sharpened(SHARPNESS, options.steps):
        motion = Motion.of(template, placement)
        placed, placed_normals = motion.place(skin)
        match = oriented_nearest(points, normals, placed, placed_normals)
        back_points, back_normals = placed[:, some], placed_normals[:, some]
        back = oriented_nearest(back_points, back_normals, points, normals)
        index = torch.cat([match, some.expand(len(back), -1)], 1)
        target = torch.cat([points, gather(points, back)], 1)
        normal = torch.cat([normals, gather(normals, back)], 1)
        off = gather(placed, index) - target
        cosine = (gather(placed_normals, match) * normals).sum(-1)
        near = match_weight(off.square().sum(-1), sharpness)
        there = near[:, :count] * normal_weight(cosine) / count
        missed = near[:, count:] * should_be_seen(views, back_points, back_normals) / len(some)
        weight = sharpness * torch.cat([there, missed], 1)
        system, gradient = _normal_equations(skin.points[index], motion, (off, normal, weight))
        placement = _step(template, placement, system, gradient)
    return placement


@dataclass(frozen=True, slots=True, kw_only=True)
class Skin:
    """A template's points as its part motions act on them: coordinates times each part's share."""

    points: Float[Tensor, "M Q"]
    """Q = 4 P: (x, y, z, 1) times the weight of part 0, then of part 1, ..."""
    normals: Float[Tensor, "M R"]
    """R = 3 P: the same of the normals."""

    @staticmethod
    def of(template: ArticulatedTemplate) -> Skin:
        """Of a template."""
        share = template.logit.softmax(-1)[:, :, None]
        whole = F.pad(template.points, (0, 1), value=1.0)
        return Skin(
            points=(share * whole[:, None]).flatten(1),
            normals=(share * template.normals[:, None]).flatten(1),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Affine motions of all parts in H views, and what the coordinates of a placement change.

    A part's point is affine in the template's (`Skin`), so is what any coordinate moves it by. The
    D coordinates: turn about the placement's origin (view axes), translation, log scales, states,
    shifts.
    """

    affine: Float[Tensor, "H Q 3"]
    turn: Float[Tensor, "H R 3"]
    """Of normals."""
    jacobian: Float[Tensor, "H Q 3 D"]
    """Of `affine`."""

    @staticmethod
    def of(template: ArticulatedTemplate, placement: Placement) -> Motion:
        """Of H placements."""
        poses, scale = template.part_poses(placement), placement.log_scale.exp()
        linear = poses.rotation * scale[:, None, None]  # (H, P, 3, 3)
        affine = torch.cat([linear, poses.translation[..., None]], -1).mT  # (H, P, 4, 3)
        base = _base_columns(template, placement, affine)
        joints = _joint_columns(template, placement, affine)
        return Motion(
            affine=affine.flatten(1, 2),
            turn=poses.rotation.mT.flatten(1, 2),
            jacobian=torch.cat([base, joints], -1).flatten(1, 2),
        )

    def place(self, skin: Skin) -> tuple[Float[Tensor, "H M 3"], Float[Tensor, "H M 3"]]:
        """Points and unit normals of the template, as `ArticulatedTemplate.place` has them."""
        return skin.points @ self.affine, F.normalize(skin.normals @ self.turn, dim=-1)


def _base_columns(
    template: ArticulatedTemplate, placement: Placement, affine: Float[Tensor, "H P 4 3"]
) -> Float[Tensor, "H P 4 3 9"]:
    """What turn, translation and log scales change of the parts' motions."""
    arm = affine.clone()
    arm[:, :, 3] -= placement.translation[:, None]
    turned = by_turn(arm.flatten(1, 2)).unflatten(1, arm.shape[1:3])
    moved = torch.zeros_like(turned)
    moved[:, :, 3] = torch.eye(3).to(arm)
    linear = affine[:, :, :3]
    stretched = linear[..., None] * torch.eye(3).to(arm)[:, None]
    pivot = F.pad(template.pivot, (0, 0, 1, 0))[..., None]  # it grows with the body
    carried = ((linear[:, :1] - linear) * pivot).mT[:, :, None]
    scaled = torch.cat([stretched, carried], 2)
    return torch.cat([turned, moved, scaled], -1)


def _joint_columns(
    template: ArticulatedTemplate, placement: Placement, affine: Float[Tensor, "H P 4 3"]
) -> Float[Tensor, "H P 4 3 D"]:
    """What the states change, and then the places of joints across their axes: each of its part."""
    own = placement.rotation[:, None]  # (H, 1, 3, 3)
    way = (own @ template.own_directions(placement)[..., None])[..., 0]  # (H, J, 3)
    pivot = template.pivot * placement.log_scale.exp()[:, None] + placement.shift
    arm = affine[:, 1:].clone()
    arm[:, :, 3] -= (own @ pivot[..., None])[..., 0] + placement.translation[:, None]
    turned = torch.linalg.cross(way[:, :, None].expand_as(arm), arm)
    turned = turned * (1 - template.sliding[..., None])
    turned[:, :, 3] += way * template.sliding
    axis, joint = template.directions(), torch.arange(len(template.kinds), device=affine.device)
    across = torch.eye(3).to(axis) - axis[:, :, None] * axis[:, None]  # (J, 3, 3)
    state = affine.new_zeros(*affine.shape, len(joint))
    state[:, joint + 1, :, :, joint] = turned.transpose(0, 1)
    place = affine.new_zeros(*affine.shape, len(joint), 3)
    place[:, joint + 1, 3, :, joint] = (own @ across).transpose(0, 1)
    return torch.cat([state, place.flatten(-2)], -1)


def _normal_equations(
    points: Float[Tensor, "H N Q"],
    motion: Motion,
    residual: tuple[Float[Tensor, "H N 3"], Float[Tensor, "H N 3"], Float[Tensor, "H N"]],
) -> tuple[Float[Tensor, "H D D"], Float[Tensor, "H D"]]:
    """Of distances across the target's surface, and with weight `ALONG` of all.

    The latter need sums of products of `points` only, not the derivatives of each.

    Args:
        points: Of the template, as in `Skin`.
        motion: Where they are.
        residual: Point minus target, the target's normal, and the weight of the match.
    """
    off, normal, weight = residual
    size = motion.jacobian.shape[-1]
    weighted = points * weight[..., None]
    by_normal = (normal[..., None] * points[:, :, None]).flatten(2)  # (H, N, 3 Q)
    across = by_normal @ motion.jacobian.transpose(1, 2).reshape(len(off), -1, size)
    system, gradient = weighted_equations(across, (off * normal).sum(-1), weight)
    every = motion.jacobian.flatten(2)  # (H, Q, 3 D)
    spread = (weighted.mT @ points) @ every
    along = every.unflatten(2, (3, size)).flatten(1, 2)
    system = system + ALONG * along.mT @ spread.unflatten(2, (3, size)).flatten(1, 2)
    pull = ALONG * along.mT @ (weighted.mT @ off).flatten(1)[..., None]
    return system, gradient + pull[..., 0]


def _step(
    template: ArticulatedTemplate,
    placement: Placement,
    system: Float[Tensor, "H D D"],
    gradient: Float[Tensor, "H D"],
) -> Placement:
    """Solve for one damped step and take it."""
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
    value.append(placement.shift.flatten(1))
    weight += [SHIFT_WEIGHT[kind] for kind in template.kinds for _ in range(3)]
    return torch.tensor(weight).to(none), torch.cat(value, 1)


def _move(
    template: ArticulatedTemplate, placement: Placement, step: Float[Tensor, "H D"]
) -> Placement:
    joints, axis = len(template.kinds), template.directions()
    turn = bounded(step[:, :3], MOST_TURN)
    shift = placement.shift + bounded(step[:, POSE + joints :].unflatten(1, (-1, 3)), MOST_MOVE)
    shift = shift - (shift * axis).sum(-1, keepdim=True) * axis
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
