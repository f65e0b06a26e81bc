# SPDX-License-Identifier: MIT
"""Discovery: from bare views to an articulated template, without labels and without a network.

Several draws of views give first templates (`initialisation`), or of objects of each of which a few
views are known (`objects`). Then come rounds of search (every
view over rotations and states) and bundle adjustment on the inliers, a larger share each round.
Views that are held out judge which templates enter the rungs of this tournament by halving, which
one goes on to the end, and whether it goes on with a mirror image of its base.

The views that agree first may all show the same side. Views of the other side then find nothing
that explains it, are turned until they look like the first ones, and so never build it. Bodies of
made things are mostly symmetric: the base together with its mirror image is a candidate to be
judged against the one without, after both went through a round. So are the two moving parts of
many: where joints are two of one kind, one part with its mirror image in place of the other is
another candidate.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.method import NO_JOURNAL, Journal, drawing, evenly
from scapo.records import take
from scapo.registered.axis_deviation import with_axis_deviation
from scapo.registered.bundle_adjustment import Candidate, densified, refit
from scapo.registered.config import DiscoveryConfig
from scapo.registered.course import JUDGES, Course, are_alike, numbered, plan_of
from scapo.registered.halves import are_halves, cut_by_mirror, in_halves, may_have_halves
from scapo.registered.initialisation import common_frame, fitted_proposals
from scapo.registered.inliers import OwnedViews, Searched, find_inliers
from scapo.registered.joint_proposals import PosedViews
from scapo.registered.mirror_images import mirrored, paired
from scapo.registered.object_frames import ASKED, taught_by_objects
from scapo.registered.objects import (
    OneObject,
    draws_of,
    object_candidate,
    one_object,
    owned_views,
    surest_first,
)
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import SearchResult, search_near, search_views, unexplained
from scapo.registered.template import ArticulatedTemplate
from scapo.registered.views import PartialViews

logger = logging.getLogger(__name__)

STRIDE = 3  # Views by which the draws are apart


@dataclass(frozen=True, slots=True, kw_only=True)
class Discovery:
    """A category's template, and where it is in the views."""

    template: ArticulatedTemplate
    found: SearchResult
    scorer: OrientationScorer | None = None
    """What objects told of how they stand; None where none are known, or views know as well."""


def discover(
    views: PartialViews,
    like: ArticulatedTemplate,
    config: DiscoveryConfig,
    generator: torch.Generator,
    objects: Sequence[PartialViews] = (),
    journal: Journal = NO_JOURNAL,
) -> Discovery:
    """The articulated template of views of one category, and its placement in all of them.

    Args:
        views: All that is learned from.
        like: A template of the category: its joints, and where cameras may stand.
        config: How much is tried.
        generator: Of all that is drawn.
        objects: Views of one object each, where it is known which show the same.
        journal: Told of every step; keeps them.
    """
    kinds = like.kinds
    plan = plan_of(config, kinds, len(views.points), len(objects))
    course = Course(like, generator, plan, journal)
    judges, others = (take(views, k) for k in held_out(len(views.points), config.judged))
    shown = None
    if objects:
        config = replace(config, way_out=False)  # the objects' own motions tell the axes
        known = _known_objects(objects, kinds, config, course)
        tried = _of_objects(known, kinds, config, course)
        shown = owned_views(known, kinds)
    else:
        tried = _of_draws(others, kinds, config, course)
    for one in tried:
        one.template.mirrored = like.mirrored
    exchanged = like.mirrored and len(kinds) == 1
    half, searched = _searched(others, None if exchanged else shown, config)
    best = _best(tried, judges, half, config, course)
    best = _through_rounds(best, judges, (half, searched), config, course)
    dense = partial(densified, best, config, generator, config.dense_rounds)
    best = course.step("dense template", dense)
    if config.leans and "revolute" in kinds:
        deviating = partial(with_axis_deviation, best, judges, config, generator, journal)
        best = course.step("deviating axes", deviating)
    inliers = best.inliers
    placement = cut_by_mirror(best.template, inliers.placement)
    best = replace(best, inliers=replace(inliers, placement=placement))
    scorer = _how_objects_stand(best, shown, course) if shown and config.standing else None
    searching = partial(search_views, best, views, scorer, journal)
    found = course.step("search of all views", searching)
    return Discovery(template=best.template, found=found, scorer=scorer)


def held_out(total: int, count: int) -> tuple[Int[Tensor, " J"], Int[Tensor, " K"]]:
    """Views that judge, evenly spread and at most a quarter, and the others."""
    judges = evenly(total, min(count, total // JUDGES))
    rest = torch.ones(total, dtype=torch.bool).index_fill(0, judges, False)
    return judges, rest.nonzero()[:, 0]


def _searched(
    views: PartialViews, objects: OwnedViews | None, config: DiscoveryConfig
) -> tuple[Searched, Searched]:
    """What the rounds search, half of it first: single views, or those of objects that vote.

    Not of objects whose base is read as the part from the other side: as their views were
    registered, one half was taken for the other in every third (row 658).
    """
    if objects is None:
        some = (
            evenly(len(views.points), count) for count in (config.searched // 2, config.searched)
        )
        half, every = (take(views, rows) for rows in some)
        return half, every
    count = int(objects.owner.max()) + 1
    half = objects.some(config.searched // 2, objects=count // 2)
    return half, objects.some(config.searched)


def _of_draws(
    views: PartialViews, kinds: tuple[JointKind, ...], config: DiscoveryConfig, course: Course
) -> list[Candidate]:
    """The first candidates of all draws of views, of which nothing is known."""
    total, tried = len(views.points), list[Candidate]()
    for number, draw in enumerate(numbered("draw", config.draws)):
        seeds = take(views, (evenly(total, config.seeds) + STRIDE * number) % total)
        frame = partial(common_frame, seeds, config.rotations, config.agreeing)
        posed = course.step(f"{draw}, registration", frame)
        fitted = partial(_contenders, posed, kinds, config, course.generator)
        tried += course.step(f"{draw}, templates", fitted)
        logger.info("%s: %d first templates", draw, len(tried))
    return tried


def _contenders(
    posed: PosedViews,
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> list[Candidate]:
    """The first templates of a draw that held-out views will judge."""
    return fitted_proposals(posed, kinds, config, generator)[: config.contenders]


def _known_objects(
    objects: Sequence[PartialViews],
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    course: Course,
) -> list[OneObject]:
    """The objects each by itself, the surest first."""
    jobs = drawing(one_object, objects, (kinds, config), course.generator)
    return surest_first(course.steps(numbered("object", len(objects)), jobs))


def _of_objects(
    known: list[OneObject], kinds: tuple[JointKind, ...], config: DiscoveryConfig, course: Course
) -> list[Candidate]:
    """The first candidates of all draws of objects."""
    draws = draws_of(known, config.draws)
    names = [f"{name}, template" for name in numbered("draw", len(draws))]
    jobs = drawing(object_candidate, draws, (kinds, config), course.generator)
    return course.steps(names, jobs)


def _how_objects_stand(
    best: Candidate, known: OwnedViews, course: Course
) -> OrientationScorer | None:
    """What tells of any view how it stands, learned from objects, in the final template's frame."""
    asked = known.some(ASKED)
    searching = partial(search_near, best, asked.views, journal=course.journal)
    hypotheses = course.step("search of objects", searching)
    taught = partial(taught_by_objects, known, asked, hypotheses, course.generator)
    return course.step("how objects stand", taught)


def _best(
    tried: list[Candidate],
    judges: PartialViews,
    searched: Searched,
    config: DiscoveryConfig,
    course: Course,
) -> Candidate:
    """The winner of the tournament: candidates are judged, go through the rungs, and again."""
    judging = partial(ranked, tried, judges, config, course.journal)
    order = course.step("judging first templates", judging)
    left = [tried[k] for k in order[: config.finalists]]
    for rung, share in zip(numbered("rung", len(config.heats)), config.heats, strict=True):
        names = [f"{rung}, {one}" for one in numbered("template", len(left))]
        jobs = drawing(advance, left, (searched, share, config), course.generator)
        left = course.steps(names, jobs)
    judging = partial(ranked, left, judges, config, course.journal)
    return left[course.step("judging templates", judging)[0]]


def _through_rounds(
    best: Candidate,
    judges: PartialViews,
    searched: tuple[Searched, Searched],
    config: DiscoveryConfig,
    course: Course,
) -> Candidate:
    """The winner after its rounds: whether it lacks a side is asked in the first, halves at last.

    Args:
        best: The winner.
        judges: Views that are held out.
        searched: Half of the views that others are sought among, and all of them.
        config: Which rounds there are.
        course: Told of each.
    """
    rounds = dict(zip(numbered("round", len(config.trusted)), config.trusted, strict=True))
    if config.mirror and rounds:
        best = completed(best, judges, searched[0], config, course)
        rounds.pop(next(iter(rounds)))
    for name, share in rounds.items():
        one = partial(_advance_alone, best, searched[1], share, config, course)
        best = course.step(name, one)
        logger.info("bundle adjustment of %d inliers", len(best.inliers.views.points))
    if config.halves and config.trusted and may_have_halves(best.template):
        best = _or_in_halves(best, judges, searched[1], config, course)
    return best


def ranked(
    tried: list[Candidate],
    judges: PartialViews,
    config: DiscoveryConfig,
    journal: Journal = NO_JOURNAL,
) -> list[int]:
    """The candidates by how well they explain the held-out views, the best first."""
    if len(tried) == 1:
        return [0]
    jobs = [partial(unexplained, one, judges, config) for one in tried]
    losses = [job() for job in journal.ahead(jobs)]
    order = sorted(range(len(tried)), key=losses.__getitem__)
    logger.info("templates judged: %s; best: %s", " ".join(f"{x:.3f}" for x in losses), order)
    return order


def advance(
    candidate: Candidate,
    searched: Searched,
    share: float,
    config: DiscoveryConfig,
    generator: torch.Generator,
    *,
    anywhere: bool = False,
) -> Candidate:
    """One round: search all views, and fit the template to the share that it explains best."""
    found = find_inliers(candidate, searched, share, config, anywhere=anywhere)
    return refit(found, config, generator)


def _advance_alone(
    candidate: Candidate, searched: Searched, share: float, config: DiscoveryConfig, course: Course
) -> Candidate:
    """The same of the only candidate, its views side by side."""
    found = find_inliers(candidate, searched, share, config, journal=course.journal)
    return refit(found, config, course.generator)


def completed(
    candidate: Candidate,
    judges: PartialViews,
    searched: Searched,
    config: DiscoveryConfig,
    course: Course,
) -> Candidate:
    """One round of the candidate as it is, and of three with a mirror image of its base added.

    That goes on which explains the held-out views best. Mirror images are judged after they were
    rebuilt from views, which leaves out what no view saw, and all with dense templates: of two
    sparse ones that with more surface is the coarser, which costs more than a side that is missing.
    Views of such a side were turned until they looked like others: for their round cameras are
    sought anywhere. Of mirror images of a part that goes on which explains the views best at once.
    """
    wholes = [replace(candidate, template=mirrored(candidate.template, axis)) for axis in range(3)]
    first, several = numbered("round", len(config.trusted))[0], [candidate, *wholes]
    if are_alike(candidate.template.kinds):
        pairs = [paired(candidate, joint, axis) for joint in range(2) for axis in range(3)]
        judging = partial(ranked, pairs, judges, config, course.journal)
        several.append(pairs[course.step("judging pairs of parts", judging)[0]])
    names = [f"{first}, {one}" for one in numbered("mirror image", len(several))]
    jobs = drawing(advance, several, (searched, config.trusted[0], config), course.generator)
    jobs = [partial(job, anywhere=0 < k <= len(wholes)) for k, job in enumerate(jobs)]
    tried = course.steps(names, jobs)
    judging = partial(_dense_losses, tried, judges, config, course)
    losses = course.step("judging mirror images", judging)
    best = min(range(len(tried)), key=losses.__getitem__)
    shown = " ".join(f"{x:.3f}" for x in losses)
    logger.info("template as it is and with mirror images judged: %s; kept: %d", shown, best)
    return tried[best]


def _or_in_halves(
    best: Candidate,
    judges: PartialViews,
    searched: Searched,
    config: DiscoveryConfig,
    course: Course,
) -> Candidate:
    """The candidate, or the best of two like halves after a round, where held-out views say so.

    As mirror images they are judged by dense templates.
    """

    def halved() -> Candidate:
        tried = in_halves(best, course.generator, course.journal)
        losses = _dense_losses(tried, judges, config, course)
        logger.info("cuts in two judged: %s", " ".join(f"{loss:.3f}" for loss in losses))
        chosen = tried[min(range(len(tried)), key=losses.__getitem__)]
        return _advance_alone(chosen, searched, config.trusted[-1], config, course)

    tried = [best, course.step("two halves", halved)]
    if not are_halves(tried[1].template):
        logger.info("no two halves that are alike")
        return best
    judged = partial(_dense_losses, tried, judges, config, course)
    was, now = course.step("judging halves", judged)
    logger.info("template as it is and in two halves judged: %.3f %.3f", was, now)
    return tried[now < was]


def _dense_losses(
    tried: list[Candidate],
    judges: PartialViews,
    config: DiscoveryConfig,
    course: Course,
) -> list[float]:
    """What held-out views cost the candidates with dense templates."""
    jobs = drawing(_dense_loss, tried, (judges, config), course.generator)
    return [job() for job in course.journal.ahead(jobs)]


def _dense_loss(
    one: Candidate, judges: PartialViews, config: DiscoveryConfig, generator: torch.Generator
) -> float:
    return unexplained(densified(one, config, generator), judges, config)
