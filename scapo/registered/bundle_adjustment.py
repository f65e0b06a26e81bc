# SPDX-License-Identifier: MIT
"""Bundle adjustment: template, parts, joints and all placements fitted to the views together.

`bundle_adjust` is one optimisation of `view_loss` by Adam. States are searched over a grid now and
then, so that a view does not stay in a wrong one. Parts do not leave a wrong place by small steps
either: rounds of rebuilding them (`motion_segmentation`), fixing what the views leave open
(`gauge`) and adjusting make a template, first from a proposal (`first_fit`), later from the inliers
of a search (`refit`), at last with more points (`densified`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import map_tensors
from scapo.registered.config import DiscoveryConfig
from scapo.registered.gauge import (
    along_main_directions,
    choose_axes,
    seat_hinges,
    settle_hinges,
    tells_frame,
)
from scapo.registered.joint_limits import limits_of
from scapo.registered.motion_segmentation import rebuild
from scapo.registered.pose_refinement import SCALE_WEIGHT, SHIFT_WEIGHT, SLIDE_WEIGHT, search_states
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_loss import sharpened, view_loss
from scapo.registered.views import PartialViews

POINTS = 128  # Of each view, drawn anew every step
BETAS = (0.8, 0.95)  # Of Adam, shorter memories than usual: there are few steps
LAST_RATE, FALLING = 0.1, 0.4
"""Share of every rate at the end, and share of the steps over which it falls."""
TURN_RATE, STATE_RATE, SLIDING_RATE = 0.02, 0.03, 0.01
"""Rad a step; a state's where all joints slide is in normalised lengths."""
TRANSLATION_RATE, SHIFT_RATE, SCALE_RATE = 0.004, 0.006, 0.008
"""Normalised lengths, and log scales, a step."""
POINT_RATE, PIVOT_RATE = 0.002, 0.012  # Normalised lengths a step; pivots may be far off at first
LOGIT_RATE, AXIS_RATE = 0.06, 0.05
"""Logits of parts, and of an axis of length 1 about its own direction, a step."""
MEAN_SCALE_WEIGHT, MEAN_STATE_WEIGHT, MEAN_SHIFT_WEIGHT = 0.5, 0.02, 2.0
"""Of the squared mean log scales, states and shifts of hinges of all views, which the template can
take over."""
MASS_WEIGHT, LEAST_MASS = 10.0, 0.06
"""Cost of a part with fewer than this share of the template's points."""
FIRST_STATES = {"revolute": 1.7, "prismatic": 0.25}
"""Largest state, to either side, before anything is known: rad, and normalised length."""
FIRST_GRID, GRID = 13, 11  # States tried of each joint before anything is known, and later
ROUNDS = 4  # Of rebuilding and adjusting
FIRST_STEPS, FIRST_SEARCHED, LAST_STEPS = 30, (0, 15), 20
"""Of a first fit: steps of each round, where states are searched in them, steps after the last."""
LATE_STEPS = 25  # Of each round on inliers
AXES_SETTLE = 2  # Dense rounds after which parts are told as of settled placements
BLUNT, SHARP, SHARPEST = (60.0, 200.0), (120.0, 300.0), (150.0, 400.0)
"""Sharpness (of `match_weight`) at the first and last step: of the first round, of the others of a
first fit, and of those on inliers."""
ROOM = 0.25  # Share of their range beyond which states of hinges are searched again


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """Of one call of `bundle_adjust`."""

    steps: int = 40
    sharpness: tuple[float, float] = SHARP
    """Of `match_weight`, per squared normalised length, at the beginning and the end."""
    search_states: tuple[int, ...] = ()
    """Steps at which every state is searched over `states`."""
    axis_weight: float = 0.0
    """Pull of each joint axis to the nearest axis of the template frame, a Manhattan frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inliers:
    """Views that a template explains, and their placements on it."""

    views: PartialViews
    placement: Placement

    def cameras(self) -> Float[Tensor, "B 3"]:
        """Directions to the cameras in the template frame."""
        direction = self.views.direction()[:, :, None]
        return (self.placement.rotation.mT @ direction)[..., 0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A template on its way, and the views it was last fitted to."""

    template: ArticulatedTemplate
    inliers: Inliers


def first_fit(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    config: DiscoveryConfig,
    generator: torch.Generator,
    *,
    known: bool = False,
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Rounds from a proposal; a sliding joint gets its axis after the first.

    Args:
        template: Changed in place.
        views: B views.
        placement: Of the bases; states count where they are `known`.
        config: Options of axes.
        generator: Draws points.
        known: Whether states are; else they are sought from the first step on.
    """
    kinds, axis_weight = template.kinds, 0.0
    states = wide_states(kinds)
    for number in range(ROUNDS):
        options = FitOptions(
            steps=FIRST_STEPS,
            sharpness=BLUNT if number == 0 else SHARP,
            search_states=() if known and number == 0 else FIRST_SEARCHED,
            axis_weight=axis_weight,
        )
        placement, _ = bundle_adjust(
            template, views, placement, options, states=states, generator=generator
        )
        if number == 0 and "prismatic" in kinds:
            if config.way_out:
                placement = choose_axes(template, placement, torch.eye(3))
            axis_weight = config.axis_weight
        placement = settle_hinges(template, placement)
        rebuild(template, views, placement, generator=generator)
    options = FitOptions(steps=LAST_STEPS, axis_weight=axis_weight)
    return bundle_adjust(template, views, placement, options, generator=generator)


def wide_states(
    kinds: tuple[JointKind, ...], count: int = FIRST_GRID
) -> Float[Tensor, "J {count}"]:
    """All that a joint could do, before anything is known."""
    ends = [FIRST_STATES[kind] for kind in kinds]
    return torch.stack([torch.linspace(-end, end, count) for end in ends])


def refit(
    candidate: Candidate, config: DiscoveryConfig, generator: torch.Generator, rounds: int = ROUNDS
) -> Candidate:
    """Rounds on the inliers; the template changes in place."""
    template, views = candidate.template, candidate.inliers.views
    placement = candidate.inliers.placement
    sliding, states = "prismatic" in template.kinds, None
    for number in range(rounds):
        rebuild(template, views, placement, generator=generator)
        if config.held_frame:
            placement = along_main_directions(template, placement)
        if number == 0:
            if config.way_out:  # a first template whose parts were poor may have taken a wrong one
                placement = choose_axes(template, placement, torch.eye(3))
            around = limits_of(placement.state, template.kinds)
            states = around.wider(0.0 if sliding else ROOM).grid(GRID)
        search_at = (0,) if sliding or number < rounds // 2 else ()
        options = late_options(template, config, search_at)
        placement, _ = bundle_adjust(
            template, views, placement, options, states=states, generator=generator
        )
        placement = settle_hinges(template, placement)
    return Candidate(template=template, inliers=Inliers(views=views, placement=placement))


def densified(
    candidate: Candidate, config: DiscoveryConfig, generator: torch.Generator, rounds: int = 1
) -> Candidate:
    """Another template, of `final_points`, built from and fitted to the same views in rounds.

    A point holds its part where a wrong axis puts it, so an axis turns little while points stay.
    """
    views, placement = candidate.inliers.views, candidate.inliers.placement
    dense = candidate.template.with_points(config.final_points)
    for number in range(rounds):
        settled = number >= AXES_SETTLE
        rebuild(dense, views, placement, settled=settled, generator=generator)
        if config.held_frame and not tells_frame(dense):  # it follows the axis, which still moves
            placement = along_main_directions(dense, placement)
        if config.way_out and number == 0:
            placement = choose_axes(dense, placement, torch.eye(3))
        options = late_options(dense, config)
        if bool(dense.alike):  # the main directions of one half are not those of the two
            options = replace(options, axis_weight=0.0)
        placement, _ = bundle_adjust(dense, views, placement, options, generator=generator)
    placement = settle_hinges(dense, placement, touching=True)
    return Candidate(template=dense, inliers=Inliers(views=views, placement=placement))


def late_options(
    template: ArticulatedTemplate, config: DiscoveryConfig, search_states: tuple[int, ...] = ()
) -> FitOptions:
    """Of a fit to inliers; axes are pulled to the template's frame where its base tells it."""
    return FitOptions(
        steps=LATE_STEPS,
        sharpness=SHARPEST,
        search_states=search_states,
        axis_weight=config.axis_weight if tells_frame(template) else 0.0,
    )


def bundle_adjust(
    template: ArticulatedTemplate,
    views: PartialViews,
    start: Placement,
    options: FitOptions,
    *,
    states: Float[Tensor, "J S"] | None = None,
    generator: torch.Generator,
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Improve the template, its joints and the placements of all views together.

    Returns:
        The placements and the loss of each view at the last step.
    """
    if not template.deviates():
        start = seat_hinges(template, start)
    free = _Free(start, template)
    optimiser = torch.optim.Adam([*free.groups, *_shared(template)], betas=BETAS)
    rates = [group["lr"] for group in optimiser.param_groups]
    loss = start.translation.new_zeros(len(start.translation))
    for step, sharpness in enumerate(sharpened(options.sharpness, options.steps)):
        done = step / max(options.steps - 1, 1)
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, max(LAST_RATE, (1 - done) / FALLING))
        index = torch.randperm(views.points.shape[1], generator=generator, device=generator.device)
        some = views.thinned(index[:POINTS])
        if states is not None and step in options.search_states:
            found = search_states(
                template, some, free.placement(template.directions()), states, sharpness
            )
            free.state.data.copy_(found.state)
            free.shift.data.copy_(found.shift)
        placement = free.placement(template.directions())
        loss = view_loss(some, template.place(placement), sharpness)
        total = loss.mean() + _gauge(template, placement, options)
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
    with torch.no_grad():
        placement = free.placement(template.directions())
    return map_tensors(placement, Tensor.detach), loss.detach()


class _Free:
    """The placement's variables while it is optimised: the rotation as a turn of the start."""

    def __init__(self, start: Placement, template: ArticulatedTemplate) -> None:
        self.start = start
        self.turn = torch.zeros_like(start.translation).requires_grad_()
        self.translation = start.translation.detach().clone().requires_grad_()
        self.log_scale = start.log_scale.detach().clone().requires_grad_()
        self.state = start.state.detach().clone().requires_grad_()
        self.shift = start.shift.detach().clone().requires_grad_()
        sliding = bool(template.sliding.all())
        self.groups = _groups(
            (self.turn, TURN_RATE),
            (self.translation, TRANSLATION_RATE),
            (self.log_scale, SCALE_RATE),
            (self.state, SLIDING_RATE if sliding else STATE_RATE),
            (self.shift, SHIFT_RATE),
        )

    def placement(self, axis: Float[Tensor, "J 3"]) -> Placement:
        along = (self.shift * axis).sum(-1, keepdim=True) * axis
        return Placement(
            rotation=rotvec_to_rotmat(self.turn) @ self.start.rotation,
            translation=self.translation,
            log_scale=self.log_scale,
            state=self.state,
            shift=self.shift - along,
            deviation=self.start.deviation,
        )


def _shared(template: ArticulatedTemplate) -> list[dict[str, object]]:
    return _groups(
        (template.points, POINT_RATE),
        (template.logit, LOGIT_RATE),
        (template.axis, AXIS_RATE),
        (template.pivot, PIVOT_RATE),
    )


def _groups(*rates: tuple[Tensor, float]) -> list[dict[str, object]]:
    return [{"params": [parameter], "lr": rate} for parameter, rate in rates]


def _gauge(template: ArticulatedTemplate, placement: Placement, options: FitOptions) -> Tensor:
    """What the views leave open: all that is not a pose near zero, no part without points.

    Instances whose axes deviate to either side of the category's are explained a little better by
    an axis that deviates far to a third side; axes of made things mostly follow their main
    directions.
    """
    scale = placement.log_scale
    gauge = SCALE_WEIGHT * scale.square().sum(-1).mean()
    gauge = gauge + MEAN_SCALE_WEIGHT * scale.mean(0).square().sum()
    gauge = gauge + MEAN_STATE_WEIGHT * placement.state.mean(0).square().sum()
    apart = torch.tensor([SHIFT_WEIGHT[kind] for kind in template.kinds]).to(scale)
    gauge = gauge + (placement.shift.square().sum(-1) @ apart).mean()
    hinged = 1 - template.sliding
    gauge = gauge + MEAN_SHIFT_WEIGHT * (hinged * placement.shift.mean(0)).square().sum()
    spread = (placement.state - placement.state.mean(0)).square() @ template.sliding
    gauge = gauge + SLIDE_WEIGHT * spread.mean()
    askew = 1 - template.directions().square().amax(-1)
    gauge = gauge + options.axis_weight * askew.sum()
    mass = template.logit.softmax(-1).mean(0)
    return gauge + MASS_WEIGHT * (LEAST_MASS - mass).clamp_min(0).sum()
