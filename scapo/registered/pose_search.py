# SPDX-License-Identifier: MIT
"""Every view against the articulated template: a grid of rotations and states, then refinement.

Cameras that the trusted placements used (as directions in the template frame) bound the search:
a prior on viewing directions that is learned without labels. The best distinct hypotheses are
refined all together; what tells them apart is the same loss that the joint fit minimises.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.registered.bundle_adjustment import search_states, thin, view_loss
from scapo.registered.joint_limits import StateRange
from scapo.registered.pairwise import NORMAL_WEIGHT, NearestGrid, distinct, within
from scapo.registered.pose_refinement import StepOptions, settle
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import Views, free_and_hidden

CHUNK = 256
"""Hypotheses refined at once, with templates of up to `LIGHT` points."""
LIGHT = 400
"""Points of the template that the search uses until its last steps."""
VIEWS = 64
"""Views searched at once: each has `SearchSpace.keep` hypotheses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSpace:
    """What is tried for each view."""

    states: Float[Tensor, "J S"]
    rotations: Float[Tensor, "H 3 3"]
    """template_R_view"""
    cameras: Float[Tensor, "V 3"] | None
    """Directions in the template frame near which cameras are sought, None for anywhere."""
    keep: int = 64
    """Hypotheses of each view that are refined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The best placement of each view, and how far to trust it."""

    placement: Placement
    loss: Float[Tensor, " B"]
    margin: Float[Tensor, " B"]
    """Loss of the best placement turned by more than 30 degrees, minus `loss`."""


def state_grid(states: Float[Tensor, "J S"]) -> Float[Tensor, "C J"]:
    """All combinations of the joints' states."""
    return torch.tensor(list(product(*states.tolist()))).to(states)


@torch.no_grad()
def coarse_cost(
    view: Views,
    states: tuple[Float[Tensor, "S M 3"], Float[Tensor, "S M 3"], NearestGrid],
    rotation: Float[Tensor, "H 3 3"],
    count: int = 48,
) -> tuple[Float[Tensor, "S H"], Float[Tensor, "S H 3"]]:
    """Cost of one view (B = 1) under rotations template_R_view and every posed template.

    The translation puts the view's centroid on that of the template points facing the camera.

    Returns:
        Costs, and translations template_T_view.
    """
    points, normals, grid = states
    facing = torch.einsum("smc,hc->shm", normals, rotation @ view.direction()[0]).clamp_min(0)
    move = torch.einsum("shm,smc->shc", facing, points)
    move = move / facing.sum(-1, keepdim=True).clamp_min(1e-6)
    turned = (view.points[:, :count] @ rotation.mT)[None]
    turned_normals = (view.normals[:, :count] @ rotation.mT)[None].expand(len(points), -1, -1, -1)
    sets = torch.arange(len(points), device=points.device)
    match = turned.new_zeros(())
    for sharpness in (20.0, 60.0, 140.0):
        placed = turned + move[:, :, None]
        near, near_normal = (
            x.unflatten(1, placed.shape[1:3]) for x in grid.lookup(sets, placed.flatten(1, 2))
        )
        cosine = (turned_normals * near_normal).sum(-1)
        gap = near - placed
        match = torch.exp(-sharpness * gap.square().sum(-1) - NORMAL_WEIGHT * (1 - cosine))
        if sharpness < 140:  # slide to where the matched points lie
            total = match.sum(-1, keepdim=True).clamp_min(1e-6)
            move = move + (match[..., None] * gap).sum(-2) / total
    cost = 1 - match.mean(-1)
    some = points[:, None, :: max(1, points.shape[1] // 64)]
    back = (some - move[:, :, None]) @ rotation
    free, _ = free_and_hidden(view, back.flatten(0, 2)[None], 0.04)
    return cost + 0.5 * free.view(back.shape[:3]).float().mean(-1), move


@torch.no_grad()
def propose(template: ArticulatedTemplate, views: Views, space: SearchSpace) -> Placement:
    """The `space.keep` best distinct placements of each view on the grid, view by view."""
    states, template = state_grid(space.states), _light(template)
    turn = torch.eye(3).to(states).expand(len(states), 3, 3)
    posed = template.place(Placement.at(turn, states.new_zeros(len(states), 3), states))
    grid = NearestGrid.build(*posed)
    found = []
    for b in range(len(views.points)):
        view = views.take(torch.tensor([b]))
        tried = space.rotations
        if space.cameras is not None:
            near = (tried @ view.direction()[0] @ space.cameras.mT).amax(-1)
            wanted = max(space.keep * 8, int((near > 0.3).sum()))
            tried = tried[near.topk(min(len(tried), wanted)).indices]
        cost, move = coarse_cost(view, (*posed, grid), tried)
        least, state = cost.min(0)
        best = distinct(tried[None], least[None], space.keep, 25.0)[0]
        rotation = tried[best].mT
        shift = -(rotation @ move[state[best], best, :, None])[..., 0]
        found.append(Placement.at(rotation, shift, states[state[best]]))
    return Placement.cat(found)


@torch.no_grad()
def refine(
    template: ArticulatedTemplate,
    views: Views,
    start: Placement,
    options: StepOptions | None = None,
) -> tuple[Placement, Float[Tensor, " H"]]:
    """Improve hypotheses (as many as views) and give the loss of each.

    The loss is over every second point, or all if the steps use them all.
    """
    options = options or StepOptions()
    placements, losses = [], []
    chunk = max(1, CHUNK * LIGHT // max(LIGHT, len(template.points)))
    for index in torch.arange(len(views.points), device=views.points.device).split(chunk):
        part = views.take(index)
        placement = settle(template, part, start.take(index), options)
        total = part.points.shape[1]
        every = 1 if options.points >= total else 2
        some = thin(part, torch.arange(0, total, every, device=index.device))
        loss = view_loss(some, template.place(placement), 250.0, 2.0)
        placements.append(placement)
        losses.append(loss + 0.05 * placement.log_scale.square().sum(-1))
    return Placement.cat(placements), torch.cat(losses)


@dataclass(frozen=True, slots=True, kw_only=True)
class Finalists:
    """The best distinct placements of each of B views, F of each, those of a view in a row."""

    placement: Placement
    loss: Float[Tensor, "B F"]

    def best(self, states: StateRange | None = None) -> Found:
        """The best of each view; those with states outside the range are charged for it."""
        loss = self.loss
        if states is not None:
            loss = loss + states.penalty(self.placement.state.unflatten(0, loss.shape))
        return best_of(self.placement, loss.flatten(), len(loss))


def settle_states(
    template: ArticulatedTemplate, views: Views, found: Found, states: StateRange
) -> Placement:
    """The placements with every state tried over its range, each followed by a few steps."""
    placement = found.placement
    for sharpness in (150.0, 250.0):
        some = thin(views, torch.arange(0, views.points.shape[1], 2, device=views.points.device))
        placement = search_states(template, some, placement, states.grid(13), sharpness)
        placement, _ = refine(template, views, placement, StepOptions(steps=5, points=256))
    return placement


def best_of(placement: Placement, loss: Float[Tensor, " H"], count: int) -> Found:
    """The best of the hypotheses of each of `count` views, and its margin."""
    table = loss.view(count, -1)
    best = table.argmin(1)
    index = torch.arange(count, device=loss.device) * table.shape[1] + best
    chosen = placement.take(index)
    trace = placement.rotation.view(count, -1, 3, 3) * chosen.rotation[:, None]
    other = torch.where(within(trace.sum((-1, -2)), 30.0), 2.0, table).amin(1)
    return Found(placement=chosen, loss=loss[index], margin=other - loss[index])


def search(template: ArticulatedTemplate, views: Views, space: SearchSpace) -> Finalists:
    """The best placements of every view over all rotations and states."""
    found = [
        tournament(template, some, propose(template, some, space), space.states)
        for index in torch.arange(len(views.points), device=views.points.device).split(VIEWS)
        for some in [views.take(index)]
    ]
    return Finalists(
        placement=Placement.cat([part.placement for part in found]),
        loss=torch.cat([part.loss for part in found]),
    )


def _states_again(
    template: ArticulatedTemplate, views: Views, placement: Placement, states: Float[Tensor, "J S"]
) -> Placement:
    some = thin(views, torch.arange(0, views.points.shape[1], 3, device=views.points.device))
    return Placement.cat(
        [
            search_states(template, some.take(index), placement.take(index), states, 120.0)
            for index in torch.arange(len(some.points), device=some.points.device).split(CHUNK)
        ]
    )


ROUNDS = (
    (StepOptions(steps=3, points=48, template_points=64), 16),
    (StepOptions(steps=5, points=96), 6),
)
"""Of `tournament`: steps, and how many distinct hypotheses of a view go on."""
LONG = StepOptions(steps=10, points=128)
"""Steps of those that are left."""
LAST = StepOptions(steps=4, points=256)
"""Their last, with all points of cloud and template: what ranks them should be sharp."""


def _light(template: ArticulatedTemplate) -> ArticulatedTemplate:
    """The template as the search uses it until its last steps."""
    return template.with_points(LIGHT) if len(template.points) > LIGHT else template


def tournament(
    template: ArticulatedTemplate, views: Views, start: Placement, states: Float[Tensor, "J S"]
) -> Finalists:
    """The best of many hypotheses of each view (as many for each, one after the other).

    All are refined a little, the best distinct ones further, and fewer still to the end: right
    hypotheses are seldom the best before refinement, and few steps tell the hopeless ones. Those
    that are left before the last steps try all `states` again.
    """
    count, light = len(views.points), _light(template)
    first = torch.arange(count, device=views.points.device)
    placement = start
    for options, left in ROUNDS:
        number = len(placement.state) // count
        index = first.repeat_interleave(number)
        placement, loss = refine(light, views.take(index), placement, options)
        table = placement.rotation.unflatten(0, (count, number))
        best = distinct(table, loss.view(count, number), min(left, number), 12.0)
        placement = placement.take((best + first[:, None] * number).flatten())
    repeated = views.take(first.repeat_interleave(len(placement.state) // count))
    placement = _states_again(light, repeated, placement, states)
    placement, _ = refine(light, repeated, placement, LONG)
    placement, loss = refine(template, repeated, placement, LAST)
    return Finalists(placement=placement, loss=loss.view(count, -1))
