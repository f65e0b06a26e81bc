# SPDX-License-Identifier: MIT
"""Templates whose hinges lean from one object to the next (`lean_model`).

While leans are unknown the template holds all of them, a fan. Tilts are first measured against the
middle of the fan; a template built anew without them is thin, and tells them better. At which
state a lean leaves a part where it is (its rest) tilts tell badly: of a thin part they tell one
direction, and there two rests look alike. Templates with rests at either end of the states are
fitted, and how well they explain views tells.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.joint_fit import FitOptions, fit
from scapo.lean_model import LeanModel, expected, learn
from scapo.part_evidence import rebuild
from scapo.placement_steps import StepOptions
from scapo.pose_search import refine
from scapo.sightings import Views
from scapo.state_range import StateRange, range_of
from scapo.template import ArticulatedTemplate, Placement
from scapo.tilts import Tilts, measure, spread_across, tilted

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
