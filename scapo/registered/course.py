# SPDX-License-Identifier: MIT
"""The course of a discovery: its steps, how long they usually take, and what is kept of them.

`plan_of` knows all steps beforehand, by name and in order. A `Course` tells the journal of the
training which of them begins and how long the rest will take, and has it keep what each made, and
do those side by side that need nothing of one another.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import comb
from typing import Any, TypeVar

import torch
from torch import Tensor

from scapo.categories import JointKind
from scapo.method import Journal
from scapo.registered.bundle_adjustment import Candidate, Inliers
from scapo.registered.config import DiscoveryConfig
from scapo.registered.initialisation import fitted_of_each, pairs_of_one
from scapo.registered.joint_proposals import JointProposal, PosedViews
from scapo.registered.object_frames import ASKED
from scapo.registered.objects import OneObject, rows_of_draws
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import Hypotheses, SearchResult
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_states import Motion
from scapo.registered.views import PartialViews

T = TypeVar("T")

JUDGES = 4  # At most one view in so many is held out
PAIR, GRID = 0.010, 1000
"""Seconds of one core, as all below: a pair of views that is registered over so many rotations."""
FIRST_FIT, OBJECT, OBJECTS, FIT, DENSE = 0.2, 3.6, 8.0, 3.6, 3.0
"""A view that a first template is fitted to; an object beside its pairs; the first template of
several objects; bundle adjustment after a search; a dense template."""
HALVES, DEVIATION, STANDING = 80.0, 40.0, 3.0
"""Two like halves; axes that deviate; a scorer of how objects stand."""
VIEW = 0.072  # A view that is searched
BELIEF = 20.0  # Seconds of steps for which usual times count, beside those that were measured
RECORDS: tuple[type[Any], ...] = (
    Candidate, Hypotheses, Inliers, JointProposal, Motion, OneObject, PartialViews, Placement,
    PosedViews, SearchResult,
)  # fmt: skip
"""What steps return, beside templates."""


def plan_of(
    config: DiscoveryConfig,
    kinds: tuple[JointKind, ...],
    views: int,
    objects: int = 0,
) -> dict[str, float]:
    """The steps of a discovery in order, and the seconds that each usually takes on one core.

    Args:
        config: How much is tried.
        kinds: Of the joints.
        views: All that are learned from.
        objects: Objects of each of which views are known.
    """
    judged = VIEW * min(config.judged, views // JUDGES)
    half = VIEW * min(config.searched // 2, views) + FIT
    plan, tried = _of_objects(config, objects) if objects else _of_draws(config, kinds)
    left = min(config.finalists, tried)
    plan["judging first templates"] = judged * tried * (tried > 1)
    for rung in numbered("rung", len(config.heats)):
        plan |= {f"{rung}, {one}": half for one in numbered("template", left)}
    plan["judging templates"] = judged * left * (left > 1)
    rounds = numbered("round", len(config.trusted))
    if config.mirror and rounds:
        images = 4 + are_alike(kinds)
        plan |= {"judging pairs of parts": 6 * judged} if are_alike(kinds) else {}
        plan |= {f"{rounds[0]}, {one}": half for one in numbered("mirror image", images)}
        plan["judging mirror images"] = images * (DENSE + judged)
        rounds = rounds[1:]
    one_round = VIEW * min(config.searched, views) + FIT
    plan |= dict.fromkeys(rounds, one_round)
    if config.halves and config.trusted and kinds == ("revolute",):
        plan |= {"two halves": HALVES + one_round, "judging halves": 2 * (DENSE + judged)}
    plan["dense template"] = DENSE * config.dense_rounds
    if config.leans and "revolute" in kinds:
        plan["deviating axes"] = DEVIATION
    if objects and config.standing:
        plan["search of objects"] = VIEW * ASKED
        plan["how objects stand"] = STANDING
    plan["search of all views"] = VIEW * views
    return plan


def are_alike(kinds: tuple[JointKind, ...]) -> bool:
    """Whether joints are two of one kind, whose parts may be each other's mirror images."""
    return len(kinds) == 2 and kinds[0] == kinds[1]


def numbered(what: str, count: int) -> list[str]:
    """Names of steps that are alike.

    >>> numbered("draw", 2)
    ['draw 1 of 2', 'draw 2 of 2']
    """
    return [f"{what} {number + 1} of {count}" for number in range(count)]


def _of_objects(config: DiscoveryConfig, objects: int) -> tuple[dict[str, float], int]:
    """The first steps, and how many templates they give."""
    each = OBJECT + len(pairs_of_one(config.object_views)) * PAIR * config.rotations / GRID
    plan = dict.fromkeys(numbered("object", objects), each)
    draws = numbered("draw", len(rows_of_draws(objects, config.draws)))
    return plan | {f"{draw}, template": OBJECTS for draw in draws}, len(draws)


def _of_draws(
    config: DiscoveryConfig, kinds: tuple[JointKind, ...]
) -> tuple[dict[str, float], int]:
    count, plan = fitted_of_each(config, len(kinds)) ** len(kinds), dict[str, float]()
    for draw in numbered("draw", config.draws):
        plan[f"{draw}, registration"] = comb(config.seeds, 2) * PAIR * config.rotations / GRID
        plan[f"{draw}, templates"] = FIRST_FIT * config.agreeing * config.seeds * count
    return plan, config.draws * min(config.contenders, count)


class Course:
    """The steps of one discovery as they are taken."""

    def __init__(
        self,
        like: ArticulatedTemplate,
        generator: torch.Generator,
        plan: Mapping[str, float],
        journal: Journal,
    ) -> None:
        """At its beginning.

        Args:
            like: A template of the category.
            generator: Of all that is drawn.
            plan: As `plan_of` makes it.
            journal: Told of the steps; keeps them.
        """
        self.generator, self.plan, self.journal = generator, plan, journal
        self.usual, self.spent = 0.0, 0.0  # Seconds of the steps that were taken
        makers: dict[str, Callable[..., Any]] = {kind.__name__: kind for kind in RECORDS}
        makers[ArticulatedTemplate.__name__] = partial(_template, like)
        self.makers = {**makers, OrientationScorer.__name__: _scorer}

    def step(self, name: str, make: Callable[[], T]) -> T:
        """What the step makes, or made before it was interrupted; steps in between are over."""
        order = list(self.plan)
        before = order[: order.index(name)] if name in self.plan else []
        total, done = sum(self.plan.values()), sum(self.plan[one] for one in before)
        pace = (self.spent + BELIEF) / (self.usual + BELIEF)
        self.journal.tell(name, done / total if total else 0.0, (total - done) * pace)
        return self.journal.once(
            name, partial(self._timed, name, make), self.generator, self.makers
        )

    def steps(self, names: Sequence[str], makes: Sequence[Callable[[], T]]) -> list[T]:
        """What steps make that need nothing of one another: side by side where that is possible."""
        ahead = self.journal.ahead(makes)
        return [self.step(name, make) for name, make in zip(names, ahead, strict=True)]

    def _timed(self, name: str, make: Callable[[], T]) -> T:
        began = time.monotonic()
        made = make()
        self.usual += self.plan.get(name, 0.0)
        self.spent += time.monotonic() - began
        return made


def _template(like: ArticulatedTemplate, **state: Tensor) -> ArticulatedTemplate:
    made = like.with_points(len(state["points"]))
    made.load_state_dict(state)
    return made


def _scorer(**state: Tensor) -> OrientationScorer:
    made = OrientationScorer()
    made.load_state_dict(state)
    return made
