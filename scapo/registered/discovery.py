# SPDX-License-Identifier: MIT
"""From bare views to an articulated template, without labels and without a network.

Several sets of views give starts (`starts`). Then come rounds of search (every view over rotations
and states) and joint fit on the views that are trusted, a larger share each round. Views that are
held out judge which starts enter the rounds, and which one goes on to the end.

Sides of the body that no view has built yet, by mirror symmetry.

The views that agree first may all show the same side. Views of the other side then find nothing
that explains it, are turned until they look like the first ones, and so never build it. Bodies of
made things are mostly symmetric: the base together with its mirror image is a start to be judged
against the one without, after both went through a round (`discovery.completed`).
"""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.method import evenly
from scapo.registered.axis_deviation import leaning_templates, settle_leans
from scapo.registered.bundle_adjustment import FitOptions, fit
from scapo.registered.gauge import choose_axes
from scapo.registered.initialisation import DiscoveryConfig, Start, Trusted, common_frame, starts
from scapo.registered.joint_limits import narrowest, range_of
from scapo.registered.joint_proposals import along_main_directions, tells_frame
from scapo.registered.motion_segmentation import farthest_features, rebuild, surface_features
from scapo.registered.pairwise import rotation_grid
from scapo.registered.pose_search import Finalists, Found, SearchSpace, search, settle_states
from scapo.registered.template import ArticulatedTemplate
from scapo.registered.views import Views


@torch.no_grad()
def mirrored(template: ArticulatedTemplate, axis: int) -> ArticulatedTemplate:
    """The template with the mirror image of its base added, with as many points as before.

    Args:
        template: Its parts and joints stay.
        axis: Of the template's frame, normal of the plane through the middle of the base (2 to
            98 % of its points).
    """
    base = template.logit.argmax(-1) == 0
    points, normals = template.points[base].clone(), template.normals[base].clone()
    if len(points):
        ends = torch.tensor([0.02, 0.98]).to(points)
        points[:, axis] = points[:, axis].quantile(ends).sum() - points[:, axis]
        normals[:, axis] = -normals[:, axis]
    points = torch.cat([template.points, points])
    normals = torch.cat([template.normals, normals])
    logit = torch.cat([template.logit, template.logit[base]])
    feature = surface_features(points, normals, logit.softmax(-1))
    index = farthest_features(feature, len(template.points))
    made = template.with_points(len(index))
    made.assign(points[index], normals[index], logit[index])
    return made


logger = logging.getLogger(__name__)

LEAST_GAIN = 0.15
"""Share of the loss that leans must save. Fitting as long without any saved 4 to 8 %."""


def trust_order(found: Found) -> Int[Tensor, " B"]:
    """Views from the most to the least trusted: a clear margin and a small loss."""
    return (found.margin - 0.5 * found.loss).argsort(descending=True)


def improve(
    template: ArticulatedTemplate,
    trusted: Trusted,
    config: DiscoveryConfig,
    generator: torch.Generator,
    rounds: int = 4,
) -> Trusted:
    """Rebuild parts and fit template, joints and placements to the trusted views."""
    placement, views = trusted.placement, trusted.views
    sliding, states = "prismatic" in template.kinds, None
    for number in range(rounds):
        rebuild(template, views, placement, generator=generator)
        if config.held_frame:
            placement = along_main_directions(template, placement)
        if number == 0:
            if config.way_out:  # a start whose parts were poor may have taken a wrong one
                placement = choose_axes(template, placement, torch.eye(3))
            around = range_of(placement.state, template.kinds)
            states = around.wider(0.0 if sliding else 0.25).grid(11)
        search_at = (0,) if sliding or number < rounds // 2 else ()
        options = _late(template, config, search_at)
        placement, _ = fit(template, views, placement, options, states=states, generator=generator)
    return Trusted(views=views, placement=placement)


def detailed(start: Start, config: DiscoveryConfig, generator: torch.Generator) -> Start:
    """The start with a template of `final_points`, built and fitted to the same views."""
    template, trusted = start
    dense, placement = template.with_points(config.final_points), trusted.placement
    rebuild(dense, trusted.views, placement, generator=generator)
    if config.way_out:
        placement = choose_axes(dense, placement, torch.eye(3))
    options = _late(dense, config)
    placement, _ = fit(dense, trusted.views, placement, options, generator=generator)
    return dense, Trusted(views=trusted.views, placement=placement)


def _late(
    template: ArticulatedTemplate, config: DiscoveryConfig, search_states: tuple[int, ...] = ()
) -> FitOptions:
    """A fit to trusted views; axes are pulled to the template's frame where its base tells it."""
    return FitOptions(
        steps=25,
        sharpness=(150.0, 400.0),
        search_states=search_states,
        axis_weight=config.axis_weight if tells_frame(template) else 0.0,
    )


def search_all(
    template: ArticulatedTemplate,
    views: Views,
    trusted: Trusted,
    config: DiscoveryConfig,
    *,
    anywhere: bool = False,
) -> Finalists:
    """Every view over rotations and states, cameras near those of trusted views or anywhere."""
    joints, sliding = len(template.kinds), "prismatic" in template.kinds
    known = range_of(trusted.placement.state, template.kinds)
    space = SearchSpace(
        states=known.wider(0.1 if sliding else 0.3).grid(7 if joints == 1 else 4),
        rotations=rotation_grid(config.rotations),
        cameras=None if anywhere else trusted.cameras(),
    )
    return search(template, views, space)


def unexplained(
    template: ArticulatedTemplate, trusted: Trusted, views: Views, config: DiscoveryConfig
) -> float:
    """Mean loss of views within their narrowest range of states, plus what that range costs.

    The range counts because a joint along a wrong axis explains almost as much with more of it.
    """
    finalists = search_all(template, views, trusted, config)
    states = narrowest(finalists.placement, finalists.loss, template.kinds, config.range_cost)
    return float(finalists.best(states).loss.mean()) + config.range_cost * states.extent()


def leaders(tried: list[Start], held: Views, count: int, config: DiscoveryConfig) -> list[Start]:
    """Those of the starts that explain the held-out views best, the best first."""
    if len(tried) == 1:
        return tried
    losses = [unexplained(*start, held, config) for start in tried]
    order = sorted(range(len(tried)), key=losses.__getitem__)[:count]
    logger.info("starts judged: %s; kept: %s", " ".join(f"{x:.3f}" for x in losses), order)
    return [tried[k] for k in order]


def held_out(views: Views, count: int) -> tuple[Views, Views]:
    """Evenly spread views that judge, at most a quarter, and the others."""
    total = len(views.points)
    judges = evenly(total, min(count, total // 4))
    rest = torch.ones(total, dtype=torch.bool).index_fill(0, judges, False)
    return views.take(judges), views.take(rest.nonzero()[:, 0])


def advance(
    start: Start,
    searched: Views,
    share: float,
    config: DiscoveryConfig,
    generator: torch.Generator,
    *,
    anywhere: bool = False,
) -> Start:
    """One round: search all views, and fit the template to the share that is trusted most."""
    template, trusted = start
    finalists = search_all(template, searched, trusted, config, anywhere=anywhere)
    states = narrowest(finalists.placement, finalists.loss, template.kinds, config.range_cost)
    found = finalists.best(states)
    kept = trust_order(found)[: max(8, round(share * len(searched.points)))]
    trusted = Trusted(views=searched.take(kept), placement=found.placement.take(kept))
    return template, improve(template, trusted, config, generator)


def completed(
    start: Start,
    judges: Views,
    searched: Views,
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> Start:
    """One round of the start as it is, and with a mirror image of its base along each direction.

    That goes on which explains the held-out views best. Mirror images are judged after they were
    rebuilt from views, which leaves out what no view saw, and all with dense templates: of two
    sparse ones that with more surface is the coarser, which costs more than a side that is missing.
    Views of such a side were turned until they looked like others: for their round cameras are
    sought anywhere.
    """
    template, trusted = start
    share = config.trusted[0]
    wholes = [(mirrored(template, axis), trusted) for axis in range(3)]
    tried = [
        advance(start, searched, share, config, generator),
        *(advance(whole, searched, share, config, generator, anywhere=True) for whole in wholes),
    ]
    losses = [unexplained(*detailed(one, config, generator), judges, config) for one in tried]
    best = min(range(len(tried)), key=losses.__getitem__)
    logger.info("mirror images judged: %s; kept: %d", " ".join(f"{x:.3f}" for x in losses), best)
    return tried[best]


def with_leans(
    start: Start, judges: Views, config: DiscoveryConfig, generator: torch.Generator
) -> Start:
    """The start, or one whose hinges lean where that explains held-out views far better.

    The pull of axes to the template's frame ends here: it was to keep hinges that lean to either
    side from being explained by an axis that leans to a third.
    """
    template, trusted = start
    if "revolute" not in template.kinds:
        return start
    options = replace(_late(template, config), axis_weight=0.0)
    made = leaning_templates(template, trusted.views, trusted.placement, options, generator)
    tried = [start, *((one, replace(trusted, placement=at)) for one, at in made)]
    if len(tried) == 1:
        return start
    states = range_of(trusted.placement.state, template.kinds)
    found = search_all(template, judges, trusted, config).best(states.wider(0.1))
    placed = settle_states(template, judges, found, states)
    loss = torch.stack([settle_leans(one, judges, placed)[1] for one, _ in tried])
    least = loss.amin(0)  # views that none explains are misplaced
    losses = loss[:, least <= least.quantile(0.75)].mean(1).tolist()
    logger.info("leans judged: %s", " ".join(f"{x:.3f}" for x in losses))
    best = min(range(len(tried)), key=losses.__getitem__)
    return tried[best] if losses[best] < (1 - LEAST_GAIN) * losses[0] else start


def discover(
    views: Views, kinds: tuple[JointKind, ...], config: DiscoveryConfig, generator: torch.Generator
) -> Start:
    """The articulated template of views of one category, with the views it was fitted to."""
    judges, others = held_out(views, config.judged)
    total, tried = len(others.points), list[Start]()
    for draw in range(config.draws):
        seeds = (evenly(total, config.seeds) + 3 * draw) % total
        posed = common_frame(others.take(seeds), config)
        tried += starts(posed, kinds, config, generator)[: config.contenders]
        logger.info("set of seeds %d of %d: %d starts", draw + 1, config.draws, len(tried))
    tried = leaders(tried, judges, config.finalists, config)
    half = others.take(evenly(total, config.searched // 2))
    for share in config.heats:
        tried = [advance(start, half, share, config, generator) for start in tried]
    best = leaders(tried, judges, 1, config)[0]
    searched = others.take(evenly(total, config.searched))
    shares = config.trusted
    if config.mirror and shares:
        best, shares = completed(best, judges, half, config, generator), shares[1:]
    for share in shares:
        best = advance(best, searched, share, config, generator)
        logger.info(
            "round on the most trusted %d of %d views",
            len(best[1].views.points),
            len(searched.points),
        )
    best = detailed(best, config, generator)
    return with_leans(best, judges, config, generator) if config.leans else best
