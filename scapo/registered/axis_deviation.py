# SPDX-License-Identifier: MIT
"""Axis deviation: templates whose hinges have other axes from one object to the next.

How far each view sees a hinged part rotated away from where the category's axis puts it tells how
the axis of that object deviates (`deviation_model`). Each part is turned about its pivot, base and
state held, until it lies on its points.

While deviations are unknown the template holds all of them, a fan. Rotations are first observed
against the middle of the fan, the mean over template points within reach; a template built anew
without them is thin, and tells them better. At which state a deviation leaves a part where it is
(its rest) rotations tell badly: of a thin part they tell one direction, and there two rests look
alike. Templates with rests at either end of the states are fitted, and how well they explain views
tells.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.geometry.points import gather
from scapo.geometry.rigid import rotation_between
from scapo.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from scapo.method import NO_JOURNAL, Journal, own_generators
from scapo.records import cat, take
from scapo.registered.bundle_adjustment import (
    Candidate,
    FitOptions,
    Inliers,
    bundle_adjust,
    late_options,
)
from scapo.registered.config import DiscoveryConfig
from scapo.registered.deviation_model import (
    DeviationModel,
    PartRotations,
    expected_deviations,
    learn_deviations,
)
from scapo.registered.gauge import seat_hinges, settle_hinges, tells_frame
from scapo.registered.gauss_newton import bounded, by_turn, damped_step, point_equations
from scapo.registered.joint_limits import JointLimits, limits_of
from scapo.registered.motion_segmentation import rebuild
from scapo.registered.pose_refinement import StepOptions, refine
from scapo.registered.pose_search import refine_states, search_views
from scapo.registered.template import (
    ArticulatedTemplate,
    PartPoses,
    Placement,
    across_axis,
    oriented,
)
from scapo.registered.view_loss import match_weight, oriented_nearest
from scapo.registered.views import PartialViews

logger = logging.getLogger(__name__)

LEAST_GAIN, LEAST_GAIN_PARALLEL = 0.1, 0.05
"""Share of the loss that deviations must save, and those of hinges that stay parallel, which are
half as many numbers. Fitting as long without any saved 4 to 8 %, those of categories whose axes do
not deviate save 4 at most."""
JUDGED = 0.75
"""Quantile of the views by their least loss that judge; what none explains is misplaced."""
REACHES = (0.06, 0.03, 0.0)
"""Of `observe_part_rotations` against a thin template, and of one that is a fan while it is made
thin: normalised lengths."""
FANNED = (0.1, 0.06, 0.04, 0.0, 0.0)
ROUNDS = 3  # Of learning deviations and fitting the template to them, and of observing and refining
LEAST_DEVIATION = 0.035
"""Standard deviation (rad) that is worth a fit: templates are not more exact."""
RESTS, OUTWARDS = 4, 0.3
"""Rests that are tried beyond either end of the states, as far as this share of their range."""
SQUARE = 0.94  # Cosine of the angle up to which an axis is put along a main direction
LEAST_POINTS = 12  # Of a part, of those of a view, for its rotation to count
CHUNK = 64  # Views that are observed at once
LARGEST = 0.35  # Rotation (rad) that a part is posed with
REFINEMENT = StepOptions(steps=4, points=256)  # Steps that follow each observation
TURNS = 3  # Gauss-Newton steps for each reach
MEAN_SHARPNESS, SHARPNESS, ALONG = 60.0, 150.0, 0.25
"""Of `match_weight` with means, which are farther off, and with nearest points; and weight of
distances along the surface there beside those across it (with means both count alike)."""
DAMPING, MOST_TURN = 0.01, 0.15  # Added to the diagonal of a step's system, and rad of one step


def with_axis_deviation(
    start: Candidate,
    judges: PartialViews,
    config: DiscoveryConfig,
    generator: torch.Generator,
    journal: Journal = NO_JOURNAL,
) -> Candidate:
    """The start, or one whose axes deviate where that explains held-out views far better.

    The pull of axes to the template's frame goes on: objects deviate to either side of it, and what
    their middle is the views leave open.
    """
    template, inliers = start.template, start.inliers
    if "revolute" not in template.kinds:
        return start
    options, placed = late_options(template, config), None
    for parallel in (True, False) if _parallel(template) else (False,):
        tried = [start, *deviating_templates(start, options, generator, journal, parallel)]
        if len(tried) == 1:
            continue
        if placed is None:
            limits = limits_of(inliers.placement.state, template.kinds)
            placed = refine_states(template, judges, search_views(start, judges), limits)
        jobs = [partial(refine_deviations, one.template, judges, placed) for one in tried]
        loss = torch.stack([job()[1] for job in journal.ahead(jobs)])
        least = loss.amin(0)
        losses = loss[:, least <= least.quantile(JUDGED)].mean(1).tolist()
        said = " ".join(f"{x:.3f}" for x in losses)
        logger.info("templates with axis deviation judged: %s", said)
        best = min(range(len(tried)), key=losses.__getitem__)
        asked = LEAST_GAIN_PARALLEL if parallel else LEAST_GAIN
        if losses[best] < (1 - asked) * losses[0]:
            return tried[best]
    return start


def _parallel(template: ArticulatedTemplate) -> bool:
    """Whether there are several hinges, all along one direction.

    Loads by which they stay so are looked for first: any load at all is four numbers for two
    hinges, and thin parts tell these too badly.
    """
    axes = template.directions().detach()
    apart = (axes @ axes[0]).abs()
    return len(axes) > 1 and "prismatic" not in template.kinds and bool((apart >= SQUARE).all())


def _span(template: ArticulatedTemplate) -> Float[Tensor, "D 2"]:
    """Loads by which all hinges deviate alike, in the directions across each as it is now.

    They are not those across it a moment ago: of an axis along the frame a small turn exchanges
    the two (`across_axis`).
    """
    first, *others = (across_axis(axis) for axis in template.directions())
    return torch.cat([across @ first.T for across in (first, *others)])


def deviating_templates(
    start: Candidate,
    options: FitOptions,
    generator: torch.Generator,
    journal: Journal = NO_JOURNAL,
    parallel: bool = False,
) -> list[Candidate]:
    """Templates whose axes deviate, one for each choice of ends at which they rest.

    Args:
        start: A template whose axes do not, and inliers.
        options: Of the fits.
        generator: Of the draws in between.
        journal: Of the training.
        parallel: Whether hinges stay parallel.

    Returns:
        Templates with the same views; none where the axes deviate too little.
    """
    views, thin = start.inliers.views, start.template.with_points(len(start.template.points))
    placement = seat_hinges(thin, start.inliers.placement)
    observed = _made_thin(thin, views, placement, generator)
    rests = _rests(limits_of(placement.state, thin.kinds), _senses(thin) if parallel else None)
    own, jobs = own_generators(generator, len(rests)), list[Callable[[], Candidate]]()
    for ends, one in zip(rests, own, strict=True):
        span = _span(thin) if parallel else None
        model = learn_deviations(observed, placement.state, ends, span)
        if float(model.load.unflatten(0, (-1, 2)).norm(dim=-1).max()) >= LEAST_DEVIATION:
            template = thin.with_points(len(thin.points))
            keep(template, model)
            at = with_deviations(template, observed, placement)
            found = Candidate(template=template, inliers=Inliers(views=views, placement=at))
            jobs.append(partial(_fitted, found, ends, parallel, options, one))
    return [job() for job in journal.ahead(jobs)]


def _made_thin(
    thin: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    generator: torch.Generator,
) -> PartRotations:
    """Builds a template's parts, in place, from rotated views; the rotations against it."""
    poses = None
    for reach in FANNED:
        observed = observe_part_rotations(thin, views, placement, (reach,), poses)
        poses = rotated_poses(thin, placement, observed)
        rebuild(thin, views, placement, poses=poses, settled=True, generator=generator)
    return observe_part_rotations(thin, views, placement, REACHES, poses)


def _senses(template: ArticulatedTemplate) -> list[bool]:
    """Of each of several parallel hinges, whether its axis has the sense of the first."""
    axes = template.directions().detach()
    return (axes @ axes[0] > 0).tolist()


def _rests(limits: JointLimits, senses: list[bool] | None = None) -> list[Float[Tensor, "J R"]]:
    """Rests to choose from: beyond either end of each hinge's states, in all combinations.

    Args:
        limits: Of the states.
        senses: Where hinges are parallel, `_senses`: their parts are taken for each other's mirror
            images, which turn in opposite senses, and rest where these do.
    """
    low, high, wide = limits.low, limits.high, limits.wider(OUTWARDS)
    beyond = [
        [torch.linspace(float(a), float(b), RESTS) for a, b in pairs]
        for pairs in (zip(low, wide.low, strict=True), zip(high, wide.high, strict=True))
    ]
    sides = list(product((0, 1), repeat=len(low)))
    if senses is not None:
        alike = [False, *senses[1:]]  # the first has its own end
        sides = [ends for ends in sides if all((end != ends[0]) == same
                 for end, same in zip(ends, alike, strict=True))]  # fmt: skip
    return [torch.stack([beyond[end][j] for j, end in enumerate(ends)]) for ends in sides]


def _fitted(
    found: Candidate,
    rests: Float[Tensor, "J R"],
    parallel: bool,
    options: FitOptions,
    generator: torch.Generator,
) -> Candidate:
    """Rounds of fitting a template, in place, and learning deviations; then axes are squared.

    Hinges go where the parts touch: while axes lean, fits leave them beside thin parts.
    """
    template, views, placement = found.template, found.inliers.views, found.inliers.placement
    for number in range(ROUNDS):
        if number == 1:
            rebuild(template, views, placement, settled=True, generator=generator)
        placement, _ = bundle_adjust(template, views, placement, options, generator=generator)
        observed = observe_part_rotations(template, views, placement, REACHES)
        span = _span(template) if parallel else None
        keep(template, learn_deviations(observed, placement.state, rests, span))
        placement = with_deviations(template, observed, placement)
    square_axes(template)
    placement, _ = refine_deviations(template, views, placement, rounds=1, turns=1)
    placement = settle_hinges(template, placement, touching=True)
    return Candidate(template=template, inliers=Inliers(views=views, placement=placement))


@torch.no_grad()
def square_axes(template: ArticulatedTemplate) -> None:
    """Put axes that deviate along the main directions of the base near them, in place.

    Objects deviate to either side of their middle, which views hardly tell: a long part that swings
    a quarter turn moves nearly alike about an axis that leans towards the middle of its swing. Each
    part stays where it was at its rest, and deviations what they were against the axis.
    """
    if not (template.deviates() and tells_frame(template)):
        return
    share, turns = template.logit.softmax(-1), list[Tensor]()
    for j, old in enumerate(template.directions()):
        main = old.abs().argmax()
        near = template.kinds[j] == "revolute" and bool(old[main].abs() >= SQUARE)
        axis = F.one_hot(main, 3).to(old) * old[main].sign() if near else old
        turns.append(across_axis(axis) @ rotation_between(old, axis) @ across_axis(old).T)
        rest = template.rest[j]
        back = rotvec_to_rotmat(-axis * rest) @ rotvec_to_rotmat(old * rest) - torch.eye(3).to(old)
        own, arm = share[:, j + 1, None], template.points - template.pivot[j]
        template.points.add_(own * (arm @ back.T))
        template.normals.copy_(F.normalize(template.normals + own * (template.normals @ back.T)))
        template.axis[j] = axis
    turn = torch.block_diag(*turns)
    template.load.copy_(turn @ template.load)
    template.noise.copy_(turn @ template.noise @ turn.T)


@torch.no_grad()
def refine_deviations(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    rounds: int = ROUNDS,
    turns: int = TURNS,
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Placements with the deviations that their views show, and their losses.

    Rotations are observed, then a few steps improve the rest of the placement: rounds of both.
    With a template whose axes do not deviate the steps alone.

    Args:
        template: Held.
        views: B views.
        placement: Of them.
        rounds: How often. Of a view that is placed already the first tells best, with one turn;
            more follow its noise.
        turns: Of `observe_part_rotations`.
    """
    loss = placement.state.new_zeros(len(placement.state))
    for _ in range(rounds):
        if template.deviates():
            observed = observe_part_rotations(template, views, placement, REACHES, turns=turns)
            placement = with_deviations(template, observed, placement)
        placement, loss = refine(template, views, placement, REFINEMENT)
    return placement, loss


@torch.no_grad()
def keep(template: ArticulatedTemplate, model: DeviationModel) -> None:
    """The deviations of a category in its template, in place."""
    for name in ("rest", "load", "noise"):
        getattr(template, name).copy_(getattr(model, name))


@torch.no_grad()
def with_deviations(
    template: ArticulatedTemplate, observed: PartRotations, placement: Placement
) -> Placement:
    """The placements with the deviations that the rotations of their parts tell."""
    model = DeviationModel(rest=template.rest, load=template.load, noise=template.noise)
    deviation = spread_across(expected_deviations(model, observed, placement.state), template)
    return replace(placement, deviation=deviation)


def spread_across(
    turn: Float[Tensor, "B J 2"], template: ArticulatedTemplate
) -> Float[Tensor, "B J 3"]:
    """Rotation vectors along the two directions across each axis, in three coordinates."""
    across = torch.stack([across_axis(axis) for axis in template.directions()])
    return (turn[:, :, None] @ across)[:, :, 0]


@torch.no_grad()
def observe_part_rotations(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    reaches: tuple[float, ...],
    poses: PartPoses | None = None,
    turns: int = TURNS,
) -> PartRotations:
    """Turn every hinge's part about its pivot until it lies on its points.

    Args:
        template: Held.
        views: B views.
        placement: Of the base, and the states that rotations are told from.
        reaches: One after the other, of the Gaussian over template points whose mean a view's
            point is matched with; 0 for the nearest one.
        poses: Of the parts, where the turns start, if they are not as placed.
        turns: Gauss-Newton steps for each reach.
    """
    poses = template.part_poses(placement) if poses is None else poses
    steps = [reach for reach in reaches for _ in range(turns)]
    rows = torch.arange(len(views.points), device=views.points.device).split(CHUNK)
    seen = [(take(views, index), take(placement, index), take(poses, index)) for index in rows]
    return cat([_observe(template, *one, steps) for one in seen])


def _observe(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    poses: PartPoses,
    reaches: Sequence[float],
) -> PartRotations:
    placed = template.place(placement, poses)
    part = template.logit.argmax(-1)
    own = part[oriented_nearest(views.points, views.normals, *placed)]
    base, axes = placement.rotation, template.directions()
    points = (views.points - placement.translation[:, None]) @ base
    normals, scale = views.normals @ base, placement.log_scale.exp()
    turns, seen = [], []
    for j, kind in enumerate(template.kinds):
        mine = own == j + 1
        seen.append((mine.sum(1) >= LEAST_POINTS) & (kind == "revolute"))
        turned = base.mT @ poses.rotation[:, j + 1]
        if bool(seen[-1].any()):
            pivot = (template.pivot[j] * scale)[:, None]
            arms = template.points[part == j + 1] * scale[:, None] - pivot
            source = points - pivot - placement.shift[:, j, None], normals
            target = arms, template.normals[part == j + 1]
            for reach in reaches:
                turned = _turn_onto(source, target, turned, mine, reach)
        straight = rotvec_to_rotmat(axes[j] * placement.state[:, j : j + 1])
        extra = rotmat_to_rotvec(straight.mT @ turned)
        turns.append(extra @ across_axis(axes[j]).T)
    return PartRotations(turn=torch.stack(turns, 1), seen=torch.stack(seen, 1))


def rotated_poses(
    template: ArticulatedTemplate, placement: Placement, observed: PartRotations
) -> PartPoses:
    """Poses of parts that are rotated as was seen; as the axes put them where nothing was."""
    straight = template.part_poses(
        replace(placement, deviation=torch.zeros_like(placement.deviation))
    )
    middle = observed.turn.masked_fill(~observed.seen[..., None], torch.nan).nanmedian(0).values
    turn = (observed.turn - middle).nan_to_num()
    turn = bounded(turn, LARGEST)
    extra = rotvec_to_rotmat(spread_across(turn * observed.seen[..., None], template))
    pivot = template.pivot * placement.log_scale.exp()[:, None]
    rotation = torch.cat([straight.rotation[:, :1], straight.rotation[:, 1:] @ extra], 1)
    moved = (straight.rotation[:, 1:] - rotation[:, 1:]) @ pivot[..., None]
    translation = straight.translation.clone()
    translation[:, 1:] += moved[..., 0]
    return PartPoses(rotation=rotation, translation=translation)


def _turn_onto(
    source: tuple[Float[Tensor, "B K 3"], Float[Tensor, "B K 3"]],
    target: tuple[Float[Tensor, "B M 3"], Float[Tensor, "M 3"]],
    turned: Float[Tensor, "B 3 3"],
    mine: Bool[Tensor, "B K"],
    reach: float,
) -> Float[Tensor, "B 3 3"]:
    """One Gauss-Newton step of a part's rotation about its pivot.

    Args:
        source: Arms from the pivot to the view's points, and their normals.
        target: Those of the part's template points before they are turned.
        turned: Rotation of the part.
        mine: Which of the view's points are the part's.
        reach: As in `observe_part_rotations`.
    """
    arms, normals = target[0] @ turned.mT, target[1] @ turned.mT
    if reach:
        apart = torch.cdist(oriented(*source), oriented(arms, normals)).square()
        share = torch.softmax(-apart / (2 * reach**2), -1)
        met, along, sharpness = share @ arms, 1.0, MEAN_SHARPNESS
    else:
        nearest = oriented_nearest(*source, arms, normals)
        met, along, sharpness = gather(arms, nearest), ALONG, SHARPNESS
    off = met - source[0]
    weight = mine * match_weight(off.square().sum(-1), sharpness)
    system, gradient = point_equations(
        by_turn(met), off, source[1], (1 - along) * weight, along * weight
    )
    step = damped_step(system, gradient, torch.full_like(gradient, DAMPING))
    return rotvec_to_rotmat(bounded(step, MOST_TURN)) @ turned
