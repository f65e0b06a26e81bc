# SPDX-License-Identifier: MIT
"""Pose search: every view against the articulated template, over a grid of rotations and states.

Cameras that the inliers used (as directions in the template frame) bound the search: a prior on
viewing directions that is learned without labels. The best distinct hypotheses are refined by
successive halving; what tells them apart is the same loss that bundle adjustment minimises.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.records import cat, take
from scapo.registered.bundle_adjustment import Candidate, Inliers
from scapo.registered.config import DiscoveryConfig
from scapo.registered.joint_limits import JointLimits, limits_of, narrowest_limits
from scapo.registered.pairwise import SCORED, NearestGrid, distinct, rotation_grid, within
from scapo.registered.pose_refinement import CHUNK, LIGHT, StepOptions, refine, search_states
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import TINY, PartialViews

VIEWS = 64  # Views searched at once: each has `SearchSpace.keep` hypotheses
STATES_OF_ONE, STATES_OF_EACH = 7, 4
"""States of the grid where the category has one joint, and of each joint where it has more."""
ROOM_SLIDING, ROOM = 0.1, 0.3
"""Share of the inliers' range beyond which states are searched: sliding joints, and hinges."""
POINTS, TEMPLATE_POINTS = 48, 64  # Of a view, and of the template, that score the grid
FREE, BEHIND = 0.5, 0.04
"""Cost of a template point in space that the camera saw empty, and how far (normalised length) in
front of what it saw that begins."""
CHARGED = 0.1  # Share of the inliers' range beyond which a hypothesis is charged for its state
NEAR = 0.3  # Cosine of directions above which a camera is near one that inliers used
LEAST_TRIED = 8  # Rotations tried for each hypothesis that is kept, if few cameras are near
SPACED = 25.0  # Degrees between hypotheses of the grid that are kept, about its spacing
RIVAL = 30.0  # Degrees from the best placement from which on another is its rival
NO_RIVAL = 2.0  # Loss in place of a rival's where there is none: about the largest there is
AGAIN = 120.0  # Sharpness of the loss by which states are tried again before the last steps
AGAIN_EVERY = 3  # Of the points, one in so many enters it
RUNGS = (
    (StepOptions(steps=3, points=48, template_points=64), 16),
    (StepOptions(steps=5, points=96), 6),
)
"""Of `successive_halving`: steps, and how many distinct hypotheses of a view go on."""
RUNG_APART = 12.0  # Degrees between those
LONG = StepOptions(steps=10, points=128)  # Steps of those that are left
LAST = StepOptions(steps=4, points=256)
"""Their last, with all points of cloud and template: what ranks them should be sharp."""
STATES = (150.0, 250.0)  # Sharpness of the losses by which the winner's states are tried
STATE_GRID, STATE_EVERY = 13, 2
"""States that are tried then, and one in so many points that they are tried with."""
STATE_STEPS = StepOptions(steps=5, points=256)  # Steps that follow
LOSS_SHARE = 0.5  # Of a placement's loss that counts against its margin when views are ranked
LEAST_INLIERS = 8  # Views that a template is fitted to at least


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
class SearchResult:
    """The best placement of each view, and how far to trust it."""

    placement: Placement
    loss: Float[Tensor, " B"]
    margin: Float[Tensor, " B"]
    """Loss of the best placement turned by more than 30 degrees (`RIVAL`), minus `loss`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypotheses:
    """The best distinct placements of each of B views, F of each, those of a view in a row."""

    placement: Placement
    loss: Float[Tensor, "B F"]

    def best(self, limits: JointLimits) -> SearchResult:
        """The best of each view; those with states outside the limits are charged for it."""
        loss = self.loss + limits.penalty(self.placement.state.unflatten(0, self.loss.shape))
        return best_of(self.placement, loss.flatten(), len(loss))


def best_of(placement: Placement, loss: Float[Tensor, " H"], count: int) -> SearchResult:
    """The best of the hypotheses of each of `count` views, and its margin."""
    table = loss.view(count, -1)
    best = table.argmin(1)
    index = torch.arange(count, device=loss.device) * table.shape[1] + best
    chosen = take(placement, index)
    trace = placement.rotation.view(count, -1, 3, 3) * chosen.rotation[:, None]
    other = torch.where(within(trace.sum((-1, -2)), RIVAL), NO_RIVAL, table).amin(1)
    return SearchResult(placement=chosen, loss=loss[index], margin=other - loss[index])


def rank_by_confidence(found: SearchResult) -> Int[Tensor, " B"]:
    """Views from the most to the least confident: a clear margin and a small loss."""
    return (found.margin - LOSS_SHARE * found.loss).argsort(descending=True)


def most_confident(found: SearchResult, share: float) -> Int[Tensor, " K"]:
    """That share of the views, or `LEAST_INLIERS`."""
    return rank_by_confidence(found)[: max(LEAST_INLIERS, round(share * len(found.loss)))]


def find_inliers(
    candidate: Candidate,
    views: PartialViews,
    share: float,
    config: DiscoveryConfig,
    *,
    anywhere: bool = False,
) -> Candidate:
    """The template with that share of the views as inliers, those that it explains best.

    Args:
        candidate: A template with its present inliers, whose states and cameras bound the search.
        views: B views.
        share: Of them.
        config: Rotations, and the cost of a range of states.
        anywhere: Whether cameras are sought anywhere.
    """
    found, _ = _within_limits(candidate, search_near(candidate, views, config, anywhere), config)
    kept = most_confident(found, share)
    inliers = Inliers(views=take(views, kept), placement=take(found.placement, kept))
    return Candidate(template=candidate.template, inliers=inliers)


def search_views(
    candidate: Candidate, views: PartialViews, config: DiscoveryConfig
) -> SearchResult:
    """The best placement of every view with states that inliers have."""
    limits = limits_of(candidate.inliers.placement.state, candidate.template.kinds)
    return search_near(candidate, views, config).best(limits.wider(CHARGED))


def unexplained(candidate: Candidate, views: PartialViews, config: DiscoveryConfig) -> float:
    """Mean loss of views within their narrowest joint limits, plus what that range costs.

    The range counts because a joint along a wrong axis explains almost as much with more of it.
    """
    found, limits = _within_limits(candidate, search_near(candidate, views, config), config)
    return float(found.loss.mean()) + config.range_cost * limits.extent()


def _within_limits(
    candidate: Candidate, hypotheses: Hypotheses, config: DiscoveryConfig
) -> tuple[SearchResult, JointLimits]:
    """The best hypotheses within the narrowest joint limits, and those."""
    kinds, placement = candidate.template.kinds, hypotheses.placement
    limits = narrowest_limits(placement, hypotheses.loss, kinds, config.range_cost)
    return hypotheses.best(limits), limits


def search_near(
    candidate: Candidate, views: PartialViews, config: DiscoveryConfig, anywhere: bool = False
) -> Hypotheses:
    """Every view over rotations and states, cameras near those of inliers or anywhere."""
    template, inliers = candidate.template, candidate.inliers
    sliding = "prismatic" in template.kinds
    known = limits_of(inliers.placement.state, template.kinds)
    space = SearchSpace(
        states=grid_of_states(known.wider(ROOM_SLIDING if sliding else ROOM)),
        rotations=rotation_grid(config.rotations),
        cameras=None if anywhere else inliers.cameras(),
    )
    return search(template, views, space)


def grid_of_states(limits: JointLimits) -> Float[Tensor, "J S"]:
    """States of each joint that a search begins with."""
    return limits.grid(STATES_OF_ONE if len(limits.unit) == 1 else STATES_OF_EACH)


def search(template: ArticulatedTemplate, views: PartialViews, space: SearchSpace) -> Hypotheses:
    """The best placements of every view over all rotations and states."""
    return cat(
        [
            successive_halving(template, some, propose(template, some, space), space.states)
            for index in torch.arange(len(views.points), device=views.points.device).split(VIEWS)
            for some in [take(views, index)]
        ]
    )


@torch.no_grad()
def propose(template: ArticulatedTemplate, views: PartialViews, space: SearchSpace) -> Placement:
    """The `space.keep` best distinct placements of each view on the grid, view by view."""
    states, template = combinations(space.states), _light(template)
    turn = torch.eye(3).to(states).expand(len(states), 3, 3)
    posed = template.place(Placement.at(turn, states.new_zeros(len(states), 3), states))
    grid = NearestGrid.build(*posed)
    found = []
    for b in range(len(views.points)):
        view = take(views, torch.tensor([b]))
        tried = space.rotations
        if space.cameras is not None:
            near = (tried @ view.direction()[0] @ space.cameras.mT).amax(-1)
            wanted = max(space.keep * LEAST_TRIED, int((near > NEAR).sum()))
            tried = tried[near.topk(min(len(tried), wanted)).indices]
        cost, move = coarse_cost(view, (*posed, grid), tried)
        least, state = cost.min(0)
        best = distinct(tried[None], least[None], space.keep, SPACED)[0]
        rotation = tried[best].mT
        shift = -(rotation @ move[state[best], best, :, None])[..., 0]
        found.append(Placement.at(rotation, shift, states[state[best]]))
    return cat(found)


def combinations(states: Float[Tensor, "J S"]) -> Float[Tensor, "C J"]:
    """All combinations of the joints' states."""
    return torch.tensor(list(product(*states.tolist()))).to(states)


@torch.no_grad()
def coarse_cost(
    view: PartialViews,
    states: tuple[Float[Tensor, "S M 3"], Float[Tensor, "S M 3"], NearestGrid],
    rotation: Float[Tensor, "H 3 3"],
) -> tuple[Float[Tensor, "S H"], Float[Tensor, "S H 3"]]:
    """Cost of one view (B = 1) under rotations template_R_view and every posed template.

    The translation puts the view's centroid on that of the template points facing the camera, and
    then slides to where the matched points lie.

    Returns:
        Costs, and translations template_T_view.
    """
    points, normals, grid = states
    facing = torch.einsum("smc,hc->shm", normals, rotation @ view.direction()[0]).clamp_min(0)
    move = torch.einsum("shm,smc->shc", facing, points)
    move = move / facing.sum(-1, keepdim=True).clamp_min(TINY)
    turned = (view.points[:, :POINTS] @ rotation.mT)[None]
    turned_normals = (view.normals[:, :POINTS] @ rotation.mT)[None].expand(len(points), -1, -1, -1)
    sets = torch.arange(len(points), device=points.device)
    move = grid.slide(sets, turned, turned_normals, move)
    _, match = grid.match(sets, turned + move[:, :, None], turned_normals, SCORED)
    cost = 1 - match.mean(-1)
    some = points[:, None, :: max(1, points.shape[1] // TEMPLATE_POINTS)]
    back = (some - move[:, :, None]) @ rotation
    free, _ = view.free_and_hidden(back.flatten(0, 2)[None], BEHIND)
    return cost + FREE * free.view(back.shape[:3]).float().mean(-1), move


def _light(template: ArticulatedTemplate) -> ArticulatedTemplate:
    """The template as the search uses it until its last steps."""
    return template.with_points(LIGHT) if len(template.points) > LIGHT else template


def successive_halving(
    template: ArticulatedTemplate,
    views: PartialViews,
    start: Placement,
    states: Float[Tensor, "J S"],
) -> Hypotheses:
    """The best of many hypotheses of each view (as many for each, one after the other).

    All are refined a little, the best distinct ones further, and fewer still to the end (`RUNGS`):
    right hypotheses are seldom the best before refinement, and few steps tell the hopeless ones.
    Those that are left before the last steps try all `states` again.
    """
    count, light = len(views.points), _light(template)
    first = torch.arange(count, device=views.points.device)
    placement = start
    for options, left in RUNGS:
        number = len(placement.state) // count
        index = first.repeat_interleave(number)
        placement, loss = refine(light, take(views, index), placement, options)
        table = placement.rotation.unflatten(0, (count, number))
        best = distinct(table, loss.view(count, number), min(left, number), RUNG_APART)
        placement = take(placement, (best + first[:, None] * number).flatten())
    repeated = take(views, first.repeat_interleave(len(placement.state) // count))
    placement = _states_again(light, repeated, placement, states)
    placement, _ = refine(light, repeated, placement, LONG)
    placement, loss = refine(template, repeated, placement, LAST)
    return Hypotheses(placement=placement, loss=loss.view(count, -1))


def _states_again(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    states: Float[Tensor, "J S"],
) -> Placement:
    some = views.thinned(_every(views, AGAIN_EVERY))
    return cat(
        [
            search_states(template, take(some, index), take(placement, index), states, AGAIN)
            for index in torch.arange(len(some.points), device=some.points.device).split(CHUNK)
        ]
    )


def refine_states(
    template: ArticulatedTemplate, views: PartialViews, found: SearchResult, limits: JointLimits
) -> Placement:
    """The placements with every state tried within the limits, each followed by a few steps."""
    placement = found.placement
    for sharpness in STATES:
        some, states = views.thinned(_every(views, STATE_EVERY)), limits.grid(STATE_GRID)
        placement = search_states(template, some, placement, states, sharpness)
        placement, _ = refine(template, views, placement, STATE_STEPS)
    return placement


def _every(views: PartialViews, step: int) -> Int[Tensor, " K"]:
    return torch.arange(0, views.points.shape[1], step, device=views.points.device)
