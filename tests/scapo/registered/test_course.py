# SPDX-License-Identifier: MIT
"""The steps of a discovery are known beforehand, told with the time left, and kept."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import pytest
import torch

from scapo.categories import CATEGORIES
from scapo.method import Journal
from scapo.registered import course as room
from scapo.registered import discovery
from scapo.registered.bundle_adjustment import Candidate, Inliers
from scapo.registered.config import DiscoveryConfig, RegisteredConfig
from scapo.registered.course import Course, numbered, plan_of
from scapo.registered.joint_proposals import PosedViews
from scapo.registered.method import TemplateRegistration
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import Hypotheses, SearchResult
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import PartialViews
from scapo.training.journal import StoredJournal
from scapo.types import Labels, Observation
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator
from tests.scapo.registered.test_objects import known

T = TypeVar("T")
KINDS = ("revolute",)
FEW = DiscoveryConfig(draws=2, searched=12, heats=(0.3, 0.4), trusted=(0.5, 0.7, 0.9), finalists=2)


class Told(Journal):
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, float, float]] = []

    def tell(self, words: str, done: float, left: float) -> None:
        self.lines.append((words, done, left))


class InterruptedStepError(Exception):
    """Stands for a kill."""


@cache
def shown() -> tuple[PartialViews, Placement]:
    return sighted(16, seed=1)


@pytest.fixture
def light(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Discovery whose steps draw a number each instead of what they do; the names of those made."""
    views, truth = shown()
    made: list[str] = []

    def candidate(name: str, g: torch.Generator) -> Candidate:
        made.append(name)
        one = template(count=60)
        return advancing(Candidate(template=one, inliers=Inliers(views=views, placement=truth)), g)

    def advancing(one: Candidate, *rest: Any, anywhere: bool = False) -> Candidate:
        made.append(f"advance {anywhere}")
        with torch.no_grad():  # in place, as bundle adjustment does
            one.template.pivot.add_(torch.rand(1, 3, generator=rest[-1]))
        return one

    def copied(one: Candidate) -> Candidate:
        return replace(one, template=one.template.with_points(60))

    def searching(*_: object) -> SearchResult:
        made.append("search")
        return SearchResult(placement=truth, loss=torch.zeros(16), margin=torch.zeros(16))

    posed = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)

    def taught(*rest: Any) -> OrientationScorer:
        made.append("taught")
        torch.rand(1, generator=rest[-1])
        return OrientationScorer()

    def halved(one: Candidate, g: torch.Generator, _: Journal) -> list[Candidate]:
        made.append("halved")
        return [advancing(copied(one), g) for _ in range(2)]

    for name, step in {
        "common_frame": lambda *_, **__: posed,
        "fitted_proposals": lambda *x: [candidate("first", x[-1]) for _ in range(3)],
        "one_object": lambda *x: known(torch.eye(3), len(made), (0.2, 0.1, 0.1)),
        "object_candidate": lambda *x: candidate("objects", x[-1]),
        "unexplained": lambda one, *_: float(one.template.pivot.detach().sum()),
        "densified": lambda one, _, g, *more: advancing(copied(one), g),
        "in_halves": halved,
        "are_halves": lambda _: True,
        "with_axis_deviation": lambda one, _, __, g, ___: advancing(copied(one), g),
        "advance": advancing,
        "_advance_alone": lambda one, *x: advancing(one, x[-1].generator),
        "search_views": searching,
        "search_near": lambda *x, **y: Hypotheses(
            placement=truth, loss=torch.zeros(16, 1), unlike=torch.zeros(16, 1)
        ),
        "taught_by_objects": taught,
    }.items():
        monkeypatch.setattr(discovery, name, step)
    return made


def discovered(journal: Journal, objects: int, config: DiscoveryConfig = FEW) -> torch.Tensor:
    views, _ = shown()
    found = discovery.discover(
        views, ArticulatedTemplate(KINDS), config, generator(3), [views] * objects, journal
    )
    assert (found.scorer is None) == (objects == 0 or not config.standing)
    return found.template.pivot.detach()


@pytest.mark.parametrize("objects", [0, 6])
@pytest.mark.parametrize(("mirror", "standing"), [(True, True), (False, True), (True, False)])
def test_the_plan_names_the_steps_that_are_taken(
    light: list[str], objects: int, mirror: bool, standing: bool
) -> None:
    journal, config = Told(), replace(FEW, mirror=mirror, standing=standing)
    discovered(journal, objects, config)
    plan = plan_of(config, KINDS, 16, objects)
    assert [words for words, _, _ in journal.lines] == list(plan)
    seconds = list(plan.values())
    alone = ["judging first templates", "judging templates"] if objects else []
    assert [name for name in plan if plan[name] <= 0] == alone
    for k, (_, done, _) in enumerate(journal.lines):
        assert done == pytest.approx(sum(seconds[:k]) / sum(seconds))
    assert light


def test_steps_that_are_not_needed_are_not_planned() -> None:
    bare = list(plan_of(replace(FEW, leans=False, halves=False), KINDS, 100))
    of_hinges = ("two halves", "judging halves", "deviating axes")
    assert bare == [name for name in plan_of(FEW, KINDS, 100) if name not in of_hinges]
    assert list(plan_of(FEW, ("prismatic",), 100)) == bare
    two = list(plan_of(replace(FEW, leans=False), KINDS * 2, 100))
    assert not {"two halves", "judging halves"} & {*two}
    few = replace(FEW, draws=1, finalists=9, mirror=False, halves=False, trusted=(), heats=(0.5,))
    assert list(plan_of(few, KINDS, 100)) == [
        "draw 1 of 1, registration", "draw 1 of 1, templates", "judging first templates",
        "rung 1 of 1, template 1 of 2", "rung 1 of 1, template 2 of 2", "judging templates",
        "dense template", "deviating axes", "search of all views",
    ]  # fmt: skip


def test_time_left_goes_by_the_usual_times_and_then_by_the_pace(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps that take three times as long as usual."""
    now, journal = [0.0], Told()
    monkeypatch.setattr(room.time, "monotonic", lambda: now[0])
    plan = dict.fromkeys(numbered("step", 10), 100.0)
    course = Course(ArticulatedTemplate(KINDS), generator(0), plan, journal)

    def working() -> None:
        now[0] += 300.0

    for name in plan:
        course.step(name, working)
    left = [line[2] for line in journal.lines]
    assert left[0] == 1000.0  # nothing is known but the usual times
    assert left[1] == pytest.approx(900 * 3, rel=0.15)
    assert left[9] == pytest.approx(100 * 3, rel=0.02)


@pytest.mark.parametrize("objects", [0, 6])
def test_an_interrupted_discovery_goes_on_bit_for_bit(
    light: list[str], objects: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Every step is the last one once; what was made before is not made again."""
    whole = discovered(Journal(), objects)
    count = len(light)
    light.clear()

    class Cut(Journal):
        """Interrupted in each step, once."""

        def __init__(self) -> None:
            self.stored = StoredJournal(tmp_path, {"seed": 1}, "votes", lambda *_: None)

        def once(
            self,
            name: str,
            make: Callable[[], T],
            generator: torch.Generator,
            makers: Mapping[str, Callable[..., Any]],
        ) -> T:
            before = sorted(tmp_path.iterdir())
            made = self.stored.once(name, make, generator, makers)
            if sorted(tmp_path.iterdir()) != before:
                raise InterruptedStepError
            return made

    caplog.set_level(logging.WARNING)
    for _ in plan_of(FEW, KINDS, 16, objects):
        with pytest.raises(InterruptedStepError):
            discovered(Cut(), objects)
    assert torch.equal(discovered(Cut(), objects), whole)
    assert len(light) == count
    assert [line for line in caplog.records if line.levelno >= logging.WARNING] == []


def test_something_is_told_before_a_cloud_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    method = TemplateRegistration(RegisteredConfig(), CATEGORIES["oven"], generator(0))
    method.journal = journal = Told()

    def looking(*_: object) -> NoReturn:
        raise InterruptedStepError

    monkeypatch.setattr(method, "_observed", looking)
    cloud = Observation(points=torch.randn(700, 20, 3, generator=generator(0)))
    with pytest.raises(InterruptedStepError):
        method.start("votes", cloud, Labels(), generator(0))
    seconds = sum(plan_of(DiscoveryConfig(), KINDS, 600).values())
    assert journal.lines == [("first look at the clouds", 0.0, seconds)]
    assert 300 < seconds < 1000
