# SPDX-License-Identifier: MIT
"""Pose search: every view against the articulated template, over a grid of rotations and states.

Cameras that the inliers used (as directions in the template frame) bound the search: a prior on
viewing directions that is learned without labels. The best distinct hypotheses are refined by
successive halving; what tells them apart is the same loss that bundle adjustment minimises.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.method import NO_JOURNAL, Journal, evenly
from scapo.records import cat, take
from scapo.registered.bundle_adjustment import Candidate
from scapo.registered.config import DiscoveryConfig
from scapo.registered.joint_limits import JointLimits, limits_of, narrowest_limits
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pairwise import distinct, within
from scapo.registered.pose_refinement import (
    CHUNK,
    LIGHT,
    StepOptions,
    improved,
    refine,
    search_states,
)
from scapo.registered.template import ArticulatedTemplate, Placement, interleave
from scapo.registered.upright import LEANING, OVER, Upright
from scapo.registered.view_bank import ShownPoints, ViewBank
from scapo.registered.views import PartialViews

VIEWS = 36  # Views searched at once: each has `SearchSpace.keep` hypotheses
STATES_OF_ONE, STATES_OF_EACH = 7, 4
"""States of the grid where the category has one joint, and of each joint where it has more."""
ROOM_SLIDING, ROOM = 0.1, 0.3
"""Share of the inliers' range beyond which states are searched: sliding joints, and hinges."""
MODES = 16  # Placements of inliers whose states, shifts and sizes are looked for
CHARGED = 0.1  # Share of the inliers' range beyond which a hypothesis is charged for its state
RIVAL = 30.0  # Degrees from the best placement from which on another is its rival
NO_RIVAL = 2.0  # Loss in place of a rival's where there is none: about the largest there is
AGAIN = 120.0  # Sharpness of the loss by which states are tried again before the last steps
AGAIN_EVERY = 3  # Of the points, one in so many enters it
UNEXPLAINED = 0.6
"""Loss beyond which nobody has explained a view (such as one with background in its mask): by how
much says nothing of hypotheses. Answers of doors have 0.1 to 0.4, of thin blades 0.2 to 0.7."""
RUNG_APART = 12.0  # Degrees between hypotheses that go on


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """How much is tried for each view: of `SearchSpace.propose` and `successive_halving`."""

    proposed: int
    """Hypotheses, half of them by either bank."""
    rungs: tuple[tuple[StepOptions, int], ...]
    """Steps, and how many distinct hypotheses of a view go on."""
    again: bool
    """Whether those that are left then try all states again."""
    long: StepOptions
    """Their steps after that."""
    last: StepOptions
    """Their last, against all points of the template: what ranks them should be sharp."""


THOROUGH = Effort(
    proposed=32,
    rungs=(
        (StepOptions(steps=3, points=48, template_points=64), 12),
        (StepOptions(steps=5, points=96), 5),
    ),
    again=True,
    long=StepOptions(steps=10, points=128),
    last=StepOptions(steps=4, points=256),
)
BRIEF = Effort(
    proposed=12,
    rungs=((StepOptions(steps=3, points=48, template_points=64), 3),),
    again=False,
    long=StepOptions(steps=4, points=96, template_points=96),
    last=StepOptions(steps=2, points=192),
)
ALONE = Effort(
    proposed=1,
    rungs=(),
    again=False,
    long=StepOptions(steps=5, points=96, template_points=96),
    last=StepOptions(steps=3, points=192),
)
"""Of one hypothesis of a view, with nothing to rank."""
OWN = replace(ALONE, last=replace(THOROUGH.last, steps=3))
"""The same, to be ranked with those of `THOROUGH`."""
PROPOSED = 32  # Placements that banks propose where fewer are asked for of those that stand right
STATES = (150.0, 250.0)  # Sharpness of the losses by which the winner's states are tried
STATE_GRID, STATE_EVERY = 13, 2
"""States that are tried then, and one in so many points that they are tried with."""
STATE_STEPS = StepOptions(steps=5, points=256)  # Steps that follow
LOSS_SHARE = 0.5  # Of a placement's loss that counts against its margin when views are ranked
LEAST_INLIERS = 8  # Views that a template is fitted to at least


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSpace:
    """What is tried for each view, and what it is compared with."""

    rendered: ViewBank
    """Of the template."""
    placed: ViewBank | None
    """Of views that were placed; None where there are none."""
    states: Float[Tensor, "J S"]
    """Tried again before the last steps."""
    scorer: OrientationScorer | None = None
    """Of how objects stand."""
    upright: Upright | None = None
    """Of all views that are searched, where their up is known."""

    @torch.no_grad()
    def propose(self, views: PartialViews, count: int) -> Placement:
        """So many distinct placements of each view, those of a view in a row.

        Of more that the banks propose, where it is known how objects stand or which way is up.
        """
        known = self.scorer is not None and bool(self.scorer.learned)
        if (not known and self.upright is None) or count >= PROPOSED:
            return self._looking_alike(views, count)
        found = self._looking_alike(views, PROPOSED)
        turns = found.rotation.unflatten(0, (len(views.points), PROPOSED))
        score = torch.zeros_like(turns[..., 0, 0])
        if self.scorer is not None and known:
            score = score + self.scorer(views, turns)
        if self.upright is not None:
            score = score - OVER * self.upright.leaning(turns)
        best = score.topk(count, 1).indices
        first = PROPOSED * torch.arange(len(best), device=best.device)
        return take(found, (best + first[:, None]).flatten())

    def _looking_alike(self, views: PartialViews, count: int) -> Placement:
        """Half of them by either bank."""
        if self.placed is None:
            return self.rendered.propose(views, count)
        sizes = (count - count // 2, count // 2)
        banks = zip((self.placed, self.rendered), sizes, strict=True)
        return interleave(
            [bank.propose(views, size) for bank, size in banks if size], len(views.points)
        )

    def unlikeness(
        self, views: PartialViews, rotation: Float[Tensor, "B F 3 3"]
    ) -> Float[Tensor, "B F"]:
        """What hypotheses are charged for: looking like none that was placed, standing oddly."""
        charge = torch.zeros_like(rotation[..., 0, 0])
        if self.upright is not None:
            charge = charge + LEANING * self.upright.leaning(rotation)
        if self.placed is not None:
            charge = charge + self.placed.unlikeness(views, rotation)
        return charge if self.scorer is None else charge + self.scorer.charge(views, rotation)


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
    unlike: Float[Tensor, "B F"]
    """`SearchSpace.unlikeness`, which chooses beside the loss but does not judge templates."""

    def with_others(self, others: Hypotheses) -> Hypotheses:
        """These and others of the same views."""
        return Hypotheses(
            placement=interleave([self.placement, others.placement], len(self.loss)),
            loss=torch.cat([self.loss, others.loss], 1),
            unlike=torch.cat([self.unlike, others.unlike], 1),
        )

    def bounded(self) -> Hypotheses:
        """The same, chosen by no more of each loss than `UNEXPLAINED`."""
        beyond = (self.loss - UNEXPLAINED).clamp_min(0)
        return replace(self, unlike=self.unlike - beyond)

    def rotation(self) -> Float[Tensor, "B F 3 3"]:
        """view_R_template of all."""
        return self.placement.rotation.unflatten(0, self.loss.shape)

    def best_rotation(self) -> Float[Tensor, "B 3 3"]:
        """view_R_template of the best of each view, whatever its states."""
        best = (self.loss + self.unlike).argmin(1)
        return self.rotation()[torch.arange(len(best), device=best.device), best]

    def best(self, limits: JointLimits) -> SearchResult:
        """The best of each view; those with states outside the limits are charged for it."""
        loss = self.loss + limits.penalty(self.placement.state.unflatten(0, self.loss.shape))
        return best_of(self.placement, loss, self.unlike)


def best_of(
    placement: Placement, loss: Float[Tensor, "B F"], unlike: Float[Tensor, "B F"]
) -> SearchResult:
    """The best of the hypotheses of each view, and its margin."""
    table, every = loss + unlike, torch.arange(len(loss), device=loss.device)
    best = table.argmin(1)
    chosen = take(placement, every * table.shape[1] + best)
    trace = placement.rotation.unflatten(0, loss.shape) * chosen.rotation[:, None]
    other = torch.where(within(trace.sum((-1, -2)), RIVAL), NO_RIVAL, table).amin(1)
    return SearchResult(placement=chosen, loss=loss[every, best], margin=other - table[every, best])


def rank_by_confidence(found: SearchResult) -> Int[Tensor, " B"]:
    """Views from the most to the least confident: a clear margin and a small loss."""
    return (found.margin - LOSS_SHARE * found.loss).argsort(descending=True)


def most_confident(found: SearchResult, share: float) -> Int[Tensor, " K"]:
    """That share of the views, or `LEAST_INLIERS`."""
    return rank_by_confidence(found)[: max(LEAST_INLIERS, round(share * len(found.loss)))]


def search_views(
    candidate: Candidate,
    views: PartialViews,
    scorer: OrientationScorer | None = None,
    journal: Journal = NO_JOURNAL,
) -> SearchResult:
    """The best placement of every view with states that inliers have."""
    limits = limits_of(candidate.inliers.placement.state, candidate.template.kinds)
    found = search_near(candidate, views, scorer=scorer, journal=journal)
    return found.best(limits.wider(CHARGED))


def unexplained(candidate: Candidate, views: PartialViews, config: DiscoveryConfig) -> float:
    """Mean loss of views within their narrowest joint limits, plus what that range costs.

    The range counts because a joint along a wrong axis explains almost as much with more of it, of
    several joints by how much each moves; and so does, for joints of one kind, how far from
    parallel they are.
    """
    found, limits = within_limits(candidate, search_near(candidate, views), config)
    extent = limits.extent(surface_moved(candidate.template))
    cost = config.range_cost * extent + config.askew_cost * askew(candidate.template)
    return float(found.loss.mean()) + cost


@torch.no_grad()
def surface_moved(template: ArticulatedTemplate) -> Float[Tensor, " J"]:
    """What a joint's range counts: 1 for half of the surface, as a laptop's lid is; 1 of one joint.

    Of several, that of a handle can explain little, and may cost little: else a template without
    it is cheaper.
    """
    if len(template.kinds) == 1:
        return torch.ones(1)
    return 2 * template.logit.softmax(-1).mean(0)[1:]


@torch.no_grad()
def askew(template: ArticulatedTemplate) -> float:
    """How far from parallel joints of one kind are: sum of 1 - |cosine| over their pairs."""
    axes, kinds = template.directions(), template.kinds
    pairs = product(range(len(kinds)), repeat=2)
    alike = [(i, j) for i, j in pairs if i < j and kinds[i] == kinds[j]]
    return sum(1 - abs(float(axes[i] @ axes[j])) for i, j in alike)


def within_limits(
    candidate: Candidate, hypotheses: Hypotheses, config: DiscoveryConfig
) -> tuple[SearchResult, JointLimits]:
    """The best hypotheses within the narrowest joint limits, and those."""
    kinds, placement = candidate.template.kinds, hypotheses.placement
    limits = narrowest_limits(placement, hypotheses.loss, kinds, config.range_cost)
    return hypotheses.best(limits), limits


def search_near(
    candidate: Candidate,
    views: PartialViews,
    *,
    anywhere: bool = False,
    scorer: OrientationScorer | None = None,
    journal: Journal = NO_JOURNAL,
) -> Hypotheses:
    """Every view over rotations, states and shifts, cameras near those of inliers or anywhere."""
    template, inliers = candidate.template, candidate.inliers
    sliding = "prismatic" in template.kinds
    known = limits_of(inliers.placement.state, template.kinds)
    states = grid_of_states(known.wider(ROOM_SLIDING if sliding else ROOM))
    modes = modes_of(inliers.placement, states)
    cameras = None if anywhere else inliers.cameras()
    shown = ShownPoints.of(inliers.views)
    space = SearchSpace(
        rendered=ViewBank.rendered(light(template), modes, cameras),
        placed=ViewBank.placed(template, shown, inliers.placement, inliers.cameras()),
        states=states,
        scorer=scorer,
    )
    return search(template, views, space, journal=journal)


def modes_of(placement: Placement, states: Float[Tensor, "J S"]) -> Placement:
    """What views are drawn of: states, shifts and sizes of some placements, and a grid of states.

    Where the sizes of objects, or the places of their parts, differ, those that were found are what
    to look for; the grid goes beyond states that were.
    """
    some = take(placement, evenly(len(placement.state), MODES))
    count = len(some.state)
    turn = torch.eye(3).to(states).expand(count, 3, 3)
    found = replace(some, rotation=turn, translation=torch.zeros_like(some.translation))
    found = replace(found, deviation=torch.zeros_like(some.deviation))
    grid = combinations(states)
    turn = torch.eye(3).to(states).expand(len(grid), 3, 3)
    still = Placement.at(turn, grid.new_zeros(len(grid), 3), grid)
    size = placement.log_scale.median(0).values
    return cat([found, replace(still, log_scale=size.expand(len(grid), 3))])


def grid_of_states(limits: JointLimits) -> Float[Tensor, "J S"]:
    """States of each joint that a search begins with."""
    return limits.grid(STATES_OF_ONE if len(limits.unit) == 1 else STATES_OF_EACH)


def search(
    template: ArticulatedTemplate,
    views: PartialViews,
    space: SearchSpace,
    effort: Effort = THOROUGH,
    journal: Journal = NO_JOURNAL,
) -> Hypotheses:
    """The best placements of every view over all rotations and states."""
    rows = torch.arange(len(views.points), device=views.points.device).split(VIEWS)
    jobs = [partial(_search_some, template, take(views, index), space, effort) for index in rows]
    return cat([job() for job in journal.ahead(jobs)])


def _search_some(
    template: ArticulatedTemplate, views: PartialViews, space: SearchSpace, effort: Effort
) -> Hypotheses:
    start = space.propose(views, effort.proposed)
    return successive_halving(template, views, start, space, effort)


def combinations(states: Float[Tensor, "J S"]) -> Float[Tensor, "C J"]:
    """All combinations of the joints' states."""
    return torch.tensor(list(product(*states.tolist()))).to(states)


def light(template: ArticulatedTemplate) -> ArticulatedTemplate:
    """The template as the search uses it until its last steps."""
    return template.with_points(LIGHT) if len(template.points) > LIGHT else template


def successive_halving(
    template: ArticulatedTemplate,
    views: PartialViews,
    start: Placement,
    space: SearchSpace,
    effort: Effort = THOROUGH,
) -> Hypotheses:
    """The best of many hypotheses of each view (as many for each, one after the other).

    All are refined a little, the best distinct ones further, and fewer still to the end:
    right hypotheses are seldom the best before refinement, and few steps tell the hopeless ones.
    Those that are left before the last steps may try all states again.
    """
    count, sparse = len(views.points), light(template)
    first = torch.arange(count, device=views.points.device)
    placement = start
    for options, left in effort.rungs:
        number = len(placement.state) // count
        index = first.repeat_interleave(number)
        placement, loss = refine(sparse, take(views, index), placement, options)
        table = placement.rotation.unflatten(0, (count, number))
        cost = loss.view(count, number) + space.unlikeness(views, table)
        best = distinct(table, cost, min(left, number), RUNG_APART)
        placement = take(placement, (best + first[:, None] * number).flatten())
    repeated = take(views, first.repeat_interleave(len(placement.state) // count))
    if effort.again:
        placement = _states_again(sparse, repeated, placement, space.states)
    placement = improved(sparse, repeated, placement, effort.long)
    placement, loss = refine(template, repeated, placement, effort.last)
    unlike = space.unlikeness(views, placement.rotation.unflatten(0, (count, -1)))
    return Hypotheses(placement=placement, loss=loss.view(count, -1), unlike=unlike)


def of_one(template: ArticulatedTemplate) -> Effort:
    """`ALONE`; where axes deviate without its last steps, which follow what is seen of those."""
    if not template.deviates():
        return ALONE
    return replace(ALONE, last=replace(ALONE.last, steps=0))


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
    placement, sparse = found.placement, light(template)
    for sharpness in STATES:
        some, states = views.thinned(_every(views, STATE_EVERY)), limits.grid(STATE_GRID)
        placement = search_states(sparse, some, placement, states, sharpness)
        placement = improved(template, views, placement, STATE_STEPS)
    return placement


def _every(views: PartialViews, step: int) -> Int[Tensor, " K"]:
    return torch.arange(0, views.points.shape[1], step, device=views.points.device)
