# SPDX-License-Identifier: MIT
"""One optimisation of template, parts, joints and all placements against the views.

The loss of a view: every observed point must lie on the placed template with the same normal
(robust, so that details missing from the template cost a bounded amount), and every template
point that this camera would have seen must have been seen. Template points that something hides
or that face away cost nothing. States are searched over a grid now and then, so that a view does
not stay in a wrong one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import roma
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import gather
from scapo.registered.pairwise import NORMAL_WEIGHT
from scapo.registered.template import ArticulatedTemplate, Placement, slides
from scapo.registered.views import Views, free_and_hidden

SHIFTS = tuple(0.05 * k for k in range(-5, 6))
"""Places of a sliding part across its joint's axis that are tried; the mean radius is 0.25."""
NORMAL_LENGTH = 0.06
"""A unit of normal difference counts as this length when neighbours are sought."""
POINTS = 128
"""Of each view, drawn anew every step of `fit`."""
SCALE_WEIGHT = 0.05
"""Of the squared log scales."""
SHIFT_WEIGHT = 0.2
"""Of a sliding part's squared place across its axis, per squared normalised length."""
SLIDE_WEIGHT = 0.7
"""Of a sliding joint's states about their mean: without it a part slides right through the body to
explain its far side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """Of one call of `fit`."""

    steps: int = 40
    sharpness: tuple[float, float] = (120.0, 300.0)
    """Of the robust distance, per squared normalised length, at the beginning and the end."""
    search_states: tuple[int, ...] = ()
    """Steps at which every state is searched over `states`."""
    axis_weight: float = 0.0
    """Pull of each joint axis to the nearest axis of the template frame, a Manhattan frame."""


@torch.no_grad()
def oriented_nearest(
    points: Float[Tensor, "B K 3"],
    normals: Float[Tensor, "B K 3"],
    target: Float[Tensor, "B M 3"],
    target_normals: Float[Tensor, "B M 3"],
) -> Int[Tensor, "B K"]:
    """Nearest target in position and normal: the two faces of a thin plate are told apart."""
    source = torch.cat([points, NORMAL_LENGTH * normals], -1)
    goal = torch.cat([target, NORMAL_LENGTH * target_normals], -1)
    return (goal.square().sum(-1)[:, None] - 2 * source @ goal.mT).argmin(-1)


def view_loss(
    views: Views,
    placed: tuple[Float[Tensor, "B M 3"], Float[Tensor, "B M 3"]],
    sharpness: float,
    backward: float = 1.0,
) -> Float[Tensor, " B"]:
    """Robust distance of each view to a placed template, both ways, self-occlusion respected.

    Args:
        views: B views.
        placed: Points and normals of the template in each view.
        sharpness: k in 1 - exp(-k d^2).
        backward: Weight of the template's visible points.
    """
    points, normals = placed
    index = oriented_nearest(views.points, views.normals, points, normals)
    off = (views.points - gather(points, index)).square().sum(-1)
    cosine = (views.normals * gather(normals, index)).sum(-1)
    there = 1 - torch.exp(-sharpness * off - NORMAL_WEIGHT * (1 - cosine))
    with torch.no_grad():
        counts = should_be_seen(views, points, normals).to(points.dtype)
        back = oriented_nearest(points, normals, views.points, views.normals)
    off = (points - gather(views.points, back)).square().sum(-1)
    return there.mean(-1) + backward * ((1 - torch.exp(-sharpness * off)) * counts).mean(-1)


@torch.no_grad()
def should_be_seen(
    views: Views, points: Float[Tensor, "B M 3"], normals: Float[Tensor, "B M 3"]
) -> Bool[Tensor, "B M"]:
    """Whether the camera would have seen each placed template point."""
    free, hidden = free_and_hidden(views, points, 0.03)
    ray = F.normalize(views.camera[:, None] - points, dim=-1)
    return free | (((normals * ray).sum(-1) > 0.1) & ~hidden)


def thin(views: Views, index: Int[Tensor, " K"]) -> Views:
    """The views with these points only."""
    return replace(views, points=views.points[:, index], normals=views.normals[:, index])


@torch.no_grad()
def search_states(
    template: ArticulatedTemplate,
    views: Views,
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


def across_axis(axis: Float[Tensor, " 3"]) -> Float[Tensor, "2 3"]:
    """Two unit directions at right angles to an axis and each other, by the template's frame."""
    least = F.one_hot(axis.abs().argmin(), 3).to(axis)
    first = F.normalize(torch.linalg.cross(axis, least), dim=0)
    return torch.stack([first, torch.linalg.cross(axis, first)])


def _best_option(
    template: ArticulatedTemplate,
    views: Views,
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


class _Free:
    """The placement's variables while it is optimised: the rotation as a turn of the start."""

    def __init__(self, start: Placement, template: ArticulatedTemplate) -> None:
        self.start = start
        self.turn = torch.zeros_like(start.translation).requires_grad_()
        self.translation = start.translation.detach().clone().requires_grad_()
        self.log_scale = start.log_scale.detach().clone().requires_grad_()
        self.state = start.state.detach().clone().requires_grad_()
        self.shift = start.shift.detach().clone().requires_grad_()
        self.slides = slides(template)
        state_rate = 0.01 if bool(self.slides.all()) else 0.03
        rates = (
            (self.turn, 0.02),
            (self.translation, 0.004),
            (self.log_scale, 0.008),
            (self.state, state_rate),
            (self.shift, 0.006),
        )
        self.groups = [{"params": [p], "lr": lr} for p, lr in rates]

    def placement(self, axis: Float[Tensor, "J 3"]) -> Placement:
        along = (self.shift * axis).sum(-1, keepdim=True) * axis
        return Placement(
            rotation=roma.rotvec_to_rotmat(self.turn) @ self.start.rotation,
            translation=self.translation,
            log_scale=self.log_scale,
            state=self.state,
            shift=(self.shift - along) * self.slides,
            lean=self.start.lean,
        )


def fit(
    template: ArticulatedTemplate,
    views: Views,
    start: Placement,
    options: FitOptions,
    *,
    states: Float[Tensor, "J S"] | None = None,
    generator: torch.Generator,
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Improve the template, its joints and the placements of all views together.

    Returns:
        The placements and the loss of each view at the last step.
    """
    free = _Free(start, template)
    groups = [*free.groups, *_shared_groups(template)]
    optimiser = torch.optim.Adam(groups, betas=(0.8, 0.95))
    rates = [group["lr"] for group in groups]
    loss = start.translation.new_zeros(len(start.translation))
    for step in range(options.steps):
        done = step / max(options.steps - 1, 1)
        low, high = options.sharpness
        sharpness = low * (high / low) ** done
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, max(0.1, (1 - done) / 0.4))
        index = torch.randperm(views.points.shape[1], generator=generator, device=generator.device)
        some = thin(views, index[:POINTS])
        if states is not None and step in options.search_states:
            found = search_states(
                template, some, free.placement(template.directions()), states, sharpness
            )
            free.state.data.copy_(found.state)
            free.shift.data.copy_(found.shift)
        placement = free.placement(template.directions())
        loss = view_loss(some, template.place(placement), sharpness)
        total = loss.mean() + _gauge(template, placement, options)
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
    with torch.no_grad():
        placement = free.placement(template.directions())
    return placement.detach(), loss.detach()


def _shared_groups(template: ArticulatedTemplate) -> list[dict[str, object]]:
    rates = (
        (template.points, 0.002),
        (template.logit, 0.06),
        (template.axis, 0.05),
        (template.pivot, 0.012),
    )
    return [{"params": [p], "lr": lr} for p, lr in rates]


def _gauge(template: ArticulatedTemplate, placement: Placement, options: FitOptions) -> Tensor:
    """What the views leave open: all that is not a pose near zero, no part without points.

    Instances whose axes lean to either side of the category's are explained a little better by an
    axis that leans far to a third side; axes of made things mostly follow their main directions.
    """
    scale = placement.log_scale
    gauge = SCALE_WEIGHT * scale.square().sum(-1).mean()
    gauge = gauge + 0.5 * scale.mean(0).square().sum()
    gauge = gauge + 0.02 * placement.state.mean(0).square().sum()
    gauge = gauge + SHIFT_WEIGHT * placement.shift.square().sum((1, 2)).mean()
    spread = (placement.state - placement.state.mean(0)).square() @ slides(template)
    gauge = gauge + SLIDE_WEIGHT * spread.mean()
    askew = 1 - template.directions().square().amax(-1)
    gauge = gauge + options.axis_weight * askew.sum()
    mass = template.logit.softmax(-1).mean(0)
    return gauge + 10 * (0.06 - mass).clamp_min(0).sum()
