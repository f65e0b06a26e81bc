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
judged against the one without, after both went through a round.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from scapo.categories import JointKind
from scapo.method import evenly
from scapo.records import take
from scapo.registered.axis_deviation import with_axis_deviation
from scapo.registered.bundle_adjustment import Candidate, densified, refit
from scapo.registered.config import DiscoveryConfig
from scapo.registered.initialisation import first_candidates
from scapo.registered.objects import known_objects, object_candidates, owned_views
from scapo.registered.pose_search import (
    Searched,
    SearchResult,
    find_inliers,
    search_views,
    unexplained,
)
from scapo.registered.template import SPAN, ArticulatedTemplate, spread_out, surface_features
from scapo.registered.views import PartialViews

logger = logging.getLogger(__name__)

JUDGES = 4  # At most one view in so many is held out
STRIDE = 3  # Views by which the draws are apart


@dataclass(frozen=True, slots=True, kw_only=True)
class Discovery:
    """A category's template, and where it is in the views."""

    template: ArticulatedTemplate
    found: SearchResult


def discover(
    views: PartialViews,
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    generator: torch.Generator,
    objects: Sequence[PartialViews] = (),
) -> Discovery:
    """The articulated template of views of one category, and its placement in all of them.

    Args:
        views: All that is learned from.
        kinds: Of the joints.
        config: How much is tried.
        generator: Of all that is drawn.
        objects: Views of one object each, where it is known which show the same.
    """
    judges, others = held_out(views, config.judged)
    total = len(others.points)
    half: Searched = take(others, evenly(total, config.searched // 2))
    searched: Searched = take(others, evenly(total, config.searched))
    if objects:
        config = replace(config, way_out=False)  # the objects' own motions tell the axes
        known = known_objects(objects, kinds, config, generator)
        tried = object_candidates(known, kinds, config, generator)
        half = owned_views(known[: len(known) // 2], config.searched // 2)
        searched = owned_views(known, config.searched)
    else:
        tried = _of_draws(others, kinds, config, generator)
    candidates = leaders(tried, judges, config.finalists, config)
    for share in config.heats:
        candidates = [advance(one, half, share, config, generator) for one in candidates]
    best, shares = leaders(candidates, judges, 1, config)[0], config.trusted
    if config.mirror and shares:
        best, shares = completed(best, judges, half, config, generator), shares[1:]
    for share in shares:
        best = advance(best, searched, share, config, generator)
        logger.info("bundle adjustment of %d inliers", len(best.inliers.views.points))
    best = densified(best, config, generator)
    if config.leans:
        best = with_axis_deviation(best, judges, config, generator)
    return Discovery(template=best.template, found=search_views(best, views, config))


def held_out(views: PartialViews, count: int) -> tuple[PartialViews, PartialViews]:
    """Evenly spread views that judge, at most a quarter, and the others."""
    total = len(views.points)
    judges = evenly(total, min(count, total // JUDGES))
    rest = torch.ones(total, dtype=torch.bool).index_fill(0, judges, False)
    return take(views, judges), take(views, rest.nonzero()[:, 0])


def _of_draws(
    views: PartialViews,
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> list[Candidate]:
    """The first candidates of all draws of views."""
    total, tried = len(views.points), list[Candidate]()
    for draw in range(config.draws):
        seeds = (evenly(total, config.seeds) + STRIDE * draw) % total
        found = first_candidates(take(views, seeds), kinds, config, generator)
        tried += found[: config.contenders]
        logger.info("draw %d of %d: %d first templates", draw + 1, config.draws, len(tried))
    return tried


def leaders(
    tried: list[Candidate], judges: PartialViews, count: int, config: DiscoveryConfig
) -> list[Candidate]:
    """Those of the candidates that explain the held-out views best, the best first."""
    if len(tried) == 1:
        return tried
    losses = [unexplained(one, judges, config) for one in tried]
    order = sorted(range(len(tried)), key=losses.__getitem__)[:count]
    logger.info("templates judged: %s; kept: %s", " ".join(f"{x:.3f}" for x in losses), order)
    return [tried[k] for k in order]


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


def completed(
    candidate: Candidate,
    judges: PartialViews,
    searched: Searched,
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> Candidate:
    """One round of the candidate as it is, and of three with a mirror image of its base added.

    That goes on which explains the held-out views best. Mirror images are judged after they were
    rebuilt from views, which leaves out what no view saw, and all with dense templates: of two
    sparse ones that with more surface is the coarser, which costs more than a side that is missing.
    Views of such a side were turned until they looked like others: for their round cameras are
    sought anywhere.
    """
    share = config.trusted[0]
    wholes = [replace(candidate, template=mirrored(candidate.template, axis)) for axis in range(3)]
    tried = [
        advance(candidate, searched, share, config, generator),
        *(advance(whole, searched, share, config, generator, anywhere=True) for whole in wholes),
    ]
    losses = [unexplained(densified(one, config, generator), judges, config) for one in tried]
    best = min(range(len(tried)), key=losses.__getitem__)
    shown = " ".join(f"{x:.3f}" for x in losses)
    logger.info("template as it is and with mirror images judged: %s; kept: %d", shown, best)
    return tried[best]


@torch.no_grad()
def mirrored(template: ArticulatedTemplate, axis: int) -> ArticulatedTemplate:
    """The template with the mirror image of its base added, with as many points as before.

    Args:
        template: Its parts and joints stay.
        axis: Of the template's frame, normal of the plane through the middle of the base (`SPAN`).
    """
    base = template.logit.argmax(-1) == 0
    points, normals = template.points[base].clone(), template.normals[base].clone()
    if len(points):
        ends = torch.tensor(SPAN).to(points)
        points[:, axis] = points[:, axis].quantile(ends).sum() - points[:, axis]
        normals[:, axis] = -normals[:, axis]
    points = torch.cat([template.points, points])
    normals = torch.cat([template.normals, normals])
    logit = torch.cat([template.logit, template.logit[base]])
    index = spread_out(surface_features(points, normals, logit.softmax(-1)), len(template.points))
    made = template.with_points(len(index))
    made.assign(points[index], normals[index], logit[index])
    return made
