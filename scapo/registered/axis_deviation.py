# SPDX-License-Identifier: MIT
"""Templates whose hinges lean from one object to the next (`lean_model`).

While leans are unknown the template holds all of them, a fan. Tilts are first measured against the
middle of the fan; a template built anew without them is thin, and tells them better. At which
state a lean leaves a part where it is (its rest) tilts tell badly: of a thin part they tell one
direction, and there two rests look alike. Templates with rests at either end of the states are
fitted, and how well they explain views tells.

How the hinges of a category lean, learned from the tilts of many views.

A category has one axis for each hinge; the hinges of its objects may lean to either side of it. A
lean tau (a rotation vector) turns the axis a to exp(tau) a, and the part's motion with it. At one
state r, its rest, it leaves the part where it is; at state s the part is seen tilted, to first
order by (1 - R(a, s - r)) tau, in the part's own frame by

    t = (R(a, -s) - R(a, -r)) tau + noise.

Leans are one number per object: tau = z load, z ~ N(0, 1), the same z for all hinges. What single
hinges do beyond that is noise, learned in the part's own frame: of a thin part, a turn about its
length is hardly seen. Load and noise maximise the likelihood of the tilts (a factor analysis); the
lean of a view is then the mean of z given its tilts.

Vectors of D = 2 J numbers are J tilts one after the other, each along the two directions of
`joint_fit.across_axis`.

How far each view sees a hinged part turned away from where the hinge puts it.

Each part is turned about its pivot, base and state held, until it lies on its points. The template
may be a fan of parts that are tilted to either side; against the mean over template points within
reach a part is measured from the middle of the fan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.geometry.points import gather
from scapo.registered.bundle_adjustment import (
    NORMAL_LENGTH,
    FitOptions,
    across_axis,
    fit,
    oriented_nearest,
)
from scapo.registered.joint_limits import StateRange, range_of
from scapo.registered.motion_segmentation import rebuild
from scapo.registered.pose_refinement import StepOptions
from scapo.registered.pose_search import refine
from scapo.registered.template import ArticulatedTemplate, PartPoses, Placement
from scapo.registered.views import Views

LEAST_POINTS = 12
"""Of a part, of those of a view, for its tilt to count."""
CHUNK = 64
"""Views whose tilts are measured at once."""
LARGEST = 0.35
"""Tilt (rad) that a part is posed with."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tilts:
    """How B views see J parts turned from where straight axes put them."""

    turn: Float[Tensor, "B J 2"]
    """Rotation vectors (rad) in the part's own frame, along the two directions of `across_axis`;
    what is along the axis belongs to the state."""
    seen: Bool[Tensor, "B J"]


def spread_across(
    turn: Float[Tensor, "B J 2"], template: ArticulatedTemplate
) -> Float[Tensor, "B J 3"]:
    """Rotation vectors along the two directions across each axis, in three coordinates."""
    across = torch.stack([across_axis(axis) for axis in template.directions()])
    return (turn[:, :, None] @ across)[:, :, 0]


@torch.no_grad()
def measure(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    reaches: tuple[float, ...],
    poses: PartPoses | None = None,
) -> Tilts:
    """Turn every hinge's part about its pivot until it lies on its points.

    Args:
        template: Held.
        views: B views.
        placement: Of the base, and the states that tilts are told from.
        reaches: One after the other, of the Gaussian over template points whose mean a view's
            point is matched with; 0 for the nearest one.
        poses: Of the parts, where the turns start, if they are not as placed.
    """
    poses = template.part_poses(placement) if poses is None else poses
    found = [
        _measure(template, views.take(index), placement.take(index), reaches, poses.take(index))
        for index in torch.arange(len(views.points), device=views.points.device).split(CHUNK)
    ]
    return Tilts(
        turn=torch.cat([tilts.turn for tilts in found]),
        seen=torch.cat([tilts.seen for tilts in found]),
    )


def _measure(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    reaches: tuple[float, ...],
    poses: PartPoses,
) -> Tilts:
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
            source = points - pivot, normals
            target = arms, template.normals[part == j + 1]
            for reach in reaches:
                for _ in range(3):
                    turned = _turn_onto(source, target, turned, mine, reach)
        straight = roma.rotvec_to_rotmat(axes[j] * placement.state[:, j : j + 1])
        tilt = roma.rotmat_to_rotvec(straight.mT @ turned)
        turns.append(tilt @ across_axis(axes[j]).T)
    return Tilts(turn=torch.stack(turns, 1), seen=torch.stack(seen, 1))


def tilted(template: ArticulatedTemplate, placement: Placement, tilts: Tilts) -> PartPoses:
    """Poses of parts that are tilted as was seen; straight where nothing was."""
    straight = template.part_poses(replace(placement, lean=torch.zeros_like(placement.lean)))
    middle = tilts.turn.masked_fill(~tilts.seen[..., None], torch.nan).nanmedian(0).values
    turn = (tilts.turn - middle).nan_to_num()
    turn = turn * (LARGEST / turn.norm(dim=-1, keepdim=True).clamp_min(LARGEST))
    extra = roma.rotvec_to_rotmat(spread_across(turn * tilts.seen[..., None], template))
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
        reach: As in `measure`.
    """
    arms, normals = target[0] @ turned.mT, target[1] @ turned.mT
    one = torch.cat([source[0], NORMAL_LENGTH * source[1]], -1)
    other = torch.cat([arms, NORMAL_LENGTH * normals], -1)
    if reach:
        share = torch.softmax(-torch.cdist(one, other).square() / (2 * reach**2), -1)
        met, along, sharpness = share @ arms, 1.0, 60.0
    else:
        nearest = oriented_nearest(*source, arms, normals)
        met, along, sharpness = gather(arms, nearest), 0.25, 150.0
    off = source[0] - met
    weight = mine * torch.exp(-sharpness * off.square().sum(-1))
    eye = torch.eye(3).to(met).expand(*met.shape, 3)
    moved = torch.linalg.cross(eye, met[:, :, None].expand_as(eye))  # (B, K, 3 turns, 3)
    across = (moved @ source[1][..., None])[..., 0]
    gap = (off * source[1]).sum(-1)
    system = torch.einsum("bki,bkj,bk->bij", across, across, (1 - along) * weight)
    system = system + torch.einsum("bkic,bkjc,bk->bij", moved, moved, along * weight)
    right = torch.einsum("bki,bk,bk->bi", across, gap, (1 - along) * weight)
    right = right + torch.einsum("bkic,bkc,bk->bi", moved, off, along * weight)
    step = torch.linalg.solve(system + 0.01 * torch.eye(3).to(system), right)
    step = step * (0.15 / step.norm(dim=-1, keepdim=True).clamp_min(0.15))
    return roma.rotvec_to_rotmat(step) @ turned


FREEDOM = 6.0
"""Of the Student distribution that tilts are taken from: some views are placed wrongly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeanModel:
    """Of one category."""

    rest: Float[Tensor, " J"]
    load: Float[Tensor, " D"]
    noise: Float[Tensor, "D D"]
    """Covariance; zero between hinges."""
    likelihood: float = -torch.inf
    """Mean logarithm over the views it was learned from."""


def _response(state: Float[Tensor, "B J"], rest: Float[Tensor, " J"]) -> Float[Tensor, "B D D"]:
    """What a lean does to the tilts: R(-s) - R(-r) of every hinge, on the diagonal."""
    both = torch.stack([state, rest.expand_as(state)])
    cos, sin = both.cos(), both.sin()
    turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)
    blocks = turn[0] - turn[1]
    count, joints = state.shape
    table = blocks.new_zeros(count, joints, 2, joints, 2)
    for j in range(joints):
        table[:, j, :, j] = blocks[:, j]
    return table.flatten(3, 4).flatten(1, 2)


def _unseen(seen: Bool[Tensor, "B J"]) -> Float[Tensor, "B D D"]:
    """Variance so large that a tilt which was not seen does not count."""
    return torch.diag_embed(1e3 * (~seen).float().repeat_interleave(2, 1))


def _climb(tilts: Tilts, state: Float[Tensor, "B J"], start: LeanModel, steps: int) -> LeanModel:
    """Expectation maximisation of load and noise, the rest held, and their likelihood."""
    joints = state.shape[1]
    turn, size = tilts.turn.flatten(1), 2 * joints
    seen = tilts.seen.to(turn).repeat_interleave(2, 1)
    eye, response, hidden = torch.eye(size), _response(state, start.rest), _unseen(tilts.seen)
    alone = torch.block_diag(*[torch.ones(2, 2)] * joints)
    load, noise, likelihood = start.load, start.noise, torch.tensor(0.0)
    for step in range(steps + 1):
        effect = (response @ load[:, None])[..., 0]
        covariance = effect[:, :, None] * effect[:, None] + noise + hidden
        odd = torch.einsum("bi,bij,bj->b", turn, torch.linalg.inv(covariance), turn)
        if step == steps:
            tail = (FREEDOM + size) * torch.log1p(odd / FREEDOM)
            likelihood = -0.5 * (torch.logdet(covariance) + tail).mean()
            break
        trust = (FREEDOM + size) / (FREEDOM + odd)
        precision = torch.linalg.inv(noise + hidden)
        variance = 1 / (1 + torch.einsum("bi,bij,bj->b", effect, precision, effect))
        mean = variance * torch.einsum("bi,bij,bj->b", effect, precision, turn)
        system = torch.einsum(
            "b,bki,bkl,blj->ij", trust * mean**2 + variance, response, precision, response
        )
        right = torch.einsum("b,bki,bkl,bl->i", trust * mean, response, precision, turn)
        load = torch.linalg.solve(system + 1e-3 * eye, right)
        effect = (response @ load[:, None])[..., 0]
        left = torch.cat(
            [
                (turn - effect * mean[:, None]) * seen * trust[:, None].sqrt(),
                effect * seen * variance[:, None].sqrt(),
            ]
        )
        noise = left.T @ left * alone / seen.sum(0).clamp_min(1)[:, None] + 1e-6 * eye
        noise = (noise + noise.T) / 2
    return LeanModel(rest=start.rest, load=load, noise=noise, likelihood=float(likelihood))


@torch.no_grad()
def learn(tilts: Tilts, state: Float[Tensor, "B J"], rests: Float[Tensor, "J R"]) -> LeanModel:
    """The likeliest leans.

    Args:
        tilts: Of B views.
        state: Their states.
        rests: Of each hinge, to choose from.
    """
    joints = state.shape[1]
    noise = 0.004 * torch.eye(2 * joints)
    best = LeanModel(rest=rests[:, 0], load=noise[0], noise=noise)
    for j in list(range(joints)) * (2 if joints > 1 else 1):
        for place in rests[j]:
            rest = torch.where(torch.arange(joints) == j, place, best.rest)
            start = LeanModel(rest=rest, load=_first_load(tilts, state, rest), noise=noise)
            best = max(best, _climb(tilts, state, start, 15), key=lambda model: model.likelihood)
    return _climb(tilts, state, best, 50)


def _first_load(
    tilts: Tilts, state: Float[Tensor, "B J"], rest: Float[Tensor, " J"]
) -> Float[Tensor, " D"]:
    """Where the tilts respond most, of a usual size: the likelihood has one peak and its mirror."""
    turn = (tilts.turn * tilts.seen[..., None]).flatten(1)
    turn = turn / turn.norm(dim=-1, keepdim=True).clamp_min(0.15)
    back = (turn[:, None] @ _response(state, rest))[:, 0]
    return 0.1 * torch.linalg.eigh(back.T @ back).eigenvectors[:, -1]


@torch.no_grad()
def expected(model: LeanModel, tilts: Tilts, state: Float[Tensor, "B J"]) -> Float[Tensor, "B J 2"]:
    """The mean of each view's leans given its tilts, along `across_axis`."""
    turn, effect = tilts.turn.flatten(1), _response(state, model.rest) @ model.load
    precision = torch.linalg.inv(model.noise + _unseen(tilts.seen))
    amount = torch.einsum("bi,bij,bj->b", effect, precision, turn)
    amount = amount / (1 + torch.einsum("bi,bij,bj->b", effect, precision, effect))
    return (amount[:, None] * model.load).unflatten(1, (*state.shape[1:], 2))


REACHES = (0.06, 0.03, 0.0)
"""Of `tilts.measure` against a thin template, and of one that is a fan while it is made thin."""
FANNED = (0.1, 0.06, 0.04, 0.0, 0.0)
ROUNDS = 3
"""Of learning leans and fitting the template to them."""
LEAST_LEAN = 0.035
"""Standard deviation (rad) of a lean that is worth a fit: templates are not more exact."""
OUTWARDS = 0.3
"""Rests are sought so far beyond the states, as a share of their range."""


@torch.no_grad()
def keep(template: ArticulatedTemplate, model: LeanModel) -> None:
    """The leans of a category in its template, in place."""
    for name in ("rest", "load", "noise"):
        getattr(template, name).copy_(getattr(model, name))


@torch.no_grad()
def leant(template: ArticulatedTemplate, tilts: Tilts, placement: Placement) -> Placement:
    """The placements with the leans that their tilts tell."""
    model = LeanModel(rest=template.rest, load=template.load, noise=template.noise)
    lean = spread_across(expected(model, tilts, placement.state), template)
    return replace(placement, lean=lean)


@torch.no_grad()
def settle_leans(
    template: ArticulatedTemplate, views: Views, placement: Placement, rounds: int = 3
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Placements with the leans that their views show, and their losses.

    Leans are measured, then a few steps improve the rest of the placement: rounds of both. With a
    template that does not lean the steps alone.
    """
    loss = placement.state.new_zeros(len(placement.state))
    for _ in range(rounds):
        if template.leans():
            placement = leant(template, measure(template, views, placement, REACHES), placement)
        placement, loss = refine(template, views, placement, StepOptions(steps=4, points=256))
    return placement, loss


@torch.no_grad()
def seat_pivots(template: ArticulatedTemplate) -> None:
    """Slide each pivot along its axis to where its part comes near it, in place.

    Straight hinges do not care where on the axis the pivot is; hinges lean about it.
    """
    part = template.logit.argmax(-1)
    for j, axis in enumerate(template.directions()):
        arm = template.points[part == j + 1] - template.pivot[j]
        if len(arm):
            along = arm @ axis
            away = (arm - along[:, None] * axis).norm(dim=-1)
            template.pivot[j] += axis * along[away <= away.quantile(0.15)].median()


def _made_thin(
    template: ArticulatedTemplate, views: Views, placement: Placement, generator: torch.Generator
) -> tuple[ArticulatedTemplate, Tilts]:
    """A template whose parts are built from tilted views, and the tilts against it."""
    thin, poses = template.with_points(len(template.points)), None
    seat_pivots(thin)
    for reach in FANNED:
        tilts = measure(thin, views, placement, (reach,), poses)
        poses = tilted(thin, placement, tilts)
        rebuild(thin, views, placement, poses=poses, generator=generator)
    return thin, measure(thin, views, placement, REACHES, poses)


def _ends(states: StateRange) -> list[Float[Tensor, "J 4"]]:
    """Rests to choose from: beyond either end of each hinge's states, in all combinations."""
    low, high, wide = states.low, states.high, states.wider(OUTWARDS)
    beyond = [
        [torch.linspace(float(a), float(b), 4) for a, b in pairs]
        for pairs in (zip(low, wide.low, strict=True), zip(high, wide.high, strict=True))
    ]
    sides = product((0, 1), repeat=len(low))
    return [torch.stack([beyond[end][j] for j, end in enumerate(ends)]) for ends in sides]


def leaning_templates(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    options: FitOptions,
    generator: torch.Generator,
) -> list[tuple[ArticulatedTemplate, Placement]]:
    """Templates whose hinges lean, one for each choice of ends at which they rest.

    Args:
        template: Of straight hinges.
        views: Trusted ones.
        placement: Theirs.
        options: Of the fits.
        generator: Of the draws in between.

    Returns:
        Templates with the placements of the views; none where the hinges lean too little.
    """
    thin, tilts = _made_thin(template, views, placement, generator)
    made = []
    for rests in _ends(range_of(placement.state, template.kinds)):
        model = learn(tilts, placement.state, rests)
        if float(model.load.unflatten(0, (-1, 2)).norm(dim=-1).max()) >= LEAST_LEAN:
            one = thin.with_points(len(thin.points))
            keep(one, model)
            at = leant(one, tilts, placement)
            made.append((one, _fitted(one, views, at, rests, options, generator)))
    return made


def _fitted(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    rests: Float[Tensor, "J R"],
    options: FitOptions,
    generator: torch.Generator,
) -> Placement:
    """Rounds of fitting a leaning template and learning leans, in place; the placements."""
    for number in range(ROUNDS):
        if number == 1:
            rebuild(template, views, placement, generator=generator)
        placement, _ = fit(template, views, placement, options, generator=generator)
        tilts = measure(template, views, placement, REACHES)
        keep(template, learn(tilts, placement.state, rests))
        placement = leant(template, tilts, placement)
    return placement
