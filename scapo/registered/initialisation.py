# SPDX-License-Identifier: MIT
"""First templates from bare views: pairs are registered and vote, what moves gives the joints.

Pairwise registrations of a few views vote for one frame; what moves in it gives candidate joints,
and a template is fitted from each.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.registered.bundle_adjustment import FitOptions, fit
from scapo.registered.gauge import choose_axes
from scapo.registered.joint_limits import RANGE_COST
from scapo.registered.joint_proposals import (
    JointGuess,
    Posed,
    principal_frame,
    search_joint,
    still_evidence,
)
from scapo.registered.motion_segmentation import farthest_features, rebuild, surface_features
from scapo.registered.pairwise import register_pairs, rotation_grid
from scapo.registered.synchronisation import agree
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import Views


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoveryConfig:
    """How much is tried; times are seconds on one CPU core per view or pair."""

    seeds: int = 72
    """Views registered with one another, 10 ms a pair."""
    agreeing: float = 0.4
    """Share of them, the most confident, that the first fit uses."""
    rotations: int = 1000
    """Of the grid that registration and search try."""
    searched: int = 144
    """Views of the rounds of search and fit, 0.2 s each and round."""
    trusted: tuple[float, ...] = (0.55, 0.7, 0.85)
    """Share of the searched views that each round keeps; the first is on half of the views where
    mirror images are tried."""
    starts: int = 3
    """Candidate axes of each joint that are optimised; two of each where joints are several."""
    draws: int = 3
    """Sets of seeds: how many of their poses agree is a matter of luck."""
    contenders: int = 2
    """Starts of each set, those of least loss, that are judged."""
    finalists: int = 3
    """Starts that enter the rounds, those that explain the held-out views best."""
    heats: tuple[float, ...] = (0.4, 0.55)
    """Shares kept in their rounds, on half of the views; then the best goes on alone."""
    judged: int = 48
    """Views held out for that."""
    range_cost: float = RANGE_COST
    """Mean loss that a radian of range may save; 0: any range of states."""
    axis_weight: float = 1.0
    """Pull of the axes to the main directions of the base once a start is chosen (before, wrong
    axes must be free to turn) and where the base has two of them; 0: none."""
    held_frame: bool = True
    """Turn the template's frame to the main directions of its base in every round."""
    way_out: bool = True
    """Take for a sliding joint's axis the way out of the body."""
    mirror: bool = True
    """Try whether the base lacks a side that is the mirror image of another."""
    leans: bool = True
    """Try whether hinges lean from one object to the next."""
    template_points: int = 400
    """While the template is sought."""
    final_points: int = 1600
    """Of the template that is found; borders between its parts are as sharp as it is dense."""

    def __post_init__(self) -> None:
        """Raise ValueError for a grid too coarse to rank its rotations."""
        if self.rotations < 200:
            raise ValueError(f"rotations: expected at least 200, found {self.rotations}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trusted:
    """Views and their placements on a template."""

    views: Views
    placement: Placement

    def cameras(self) -> Float[Tensor, "B 3"]:
        """Directions to the cameras in the template frame."""
        direction = self.views.direction()[:, :, None]
        return (self.placement.rotation.mT @ direction)[..., 0]


Start = tuple[ArticulatedTemplate, Trusted]
"""A template on its way, and the views it was last fitted to."""


def common_frame(views: Views, config: DiscoveryConfig) -> Posed:
    """The views that agree best, in one frame along the object's main directions."""
    count = len(views.points)
    pairs = torch.combinations(torch.arange(count)).flip(-1)
    rotations = rotation_grid(config.rotations)
    modes = register_pairs(views, pairs, rotations=rotations)
    consensus = agree(count, pairs, modes)
    kept = consensus.confidence.topk(max(2, round(config.agreeing * count))).indices
    views = views.take(kept)
    rotation, translation = consensus.rotation[kept], consensus.translation[kept]
    normals = views.normals[:, ::4] @ rotation.mT
    frame = principal_frame(normals.flatten(0, 1), rotation_grid(1500))
    rotation, translation = frame @ rotation, translation @ frame.T
    points = views.points @ rotation.mT + translation[:, None]
    translation = translation - points.flatten(0, 1).median(0).values
    back = rotation.mT
    return Posed(views=views, rotation=back, translation=-(back @ translation[..., None])[..., 0])


def moved_sets(posed: Posed, joints: int, generator: torch.Generator) -> list[Bool[Tensor, "B K"]]:
    """For each joint, the points of every view that other views do not confirm where they are.

    Several joints share them by distance to as many centres (k-means in the common frame).
    """
    evidence = still_evidence(posed)
    moved = evidence < evidence.flatten().quantile(0.3)
    if joints == 1:
        return [moved]
    points, _ = posed.world(moved.shape[1])
    cloud = points[moved]
    centres = cloud[torch.randperm(len(cloud), generator=generator)[:joints]]
    for _ in range(20):
        nearest = torch.cdist(cloud, centres).argmin(-1)
        means = [cloud[nearest == k].mean(0) for k in range(joints)]
        centres = torch.where(torch.stack(means).isnan(), centres, torch.stack(means))
    label = torch.cdist(points.flatten(0, 1), centres).argmin(-1).view(moved.shape)
    return [moved & (label == k) for k in range(joints)]


def wide_states(kinds: tuple[JointKind, ...], count: int = 13) -> Float[Tensor, "J {count}"]:
    """All that a joint could do, before anything is known."""
    ends = [1.7 if kind == "revolute" else 0.25 for kind in kinds]
    return torch.stack([torch.linspace(-end, end, count) for end in ends])


def first_template(
    posed: Posed,
    moved: list[Bool[Tensor, "B K"]],
    guesses: tuple[JointGuess, ...],
    kinds: tuple[JointKind, ...],
    count: int,
) -> ArticulatedTemplate:
    """Still points as base and moved points as parts, the guessed joints between them."""
    points, normals = (x.flatten(0, 1) for x in posed.world(moved[0].shape[1]))
    label = torch.zeros_like(moved[0], dtype=torch.long)
    for j, rows in enumerate(moved):
        label[rows] = j + 1
    part = F.one_hot(label.flatten(), len(kinds) + 1).to(points)
    index = farthest_features(surface_features(points, normals, part)[::2], count) * 2
    template = ArticulatedTemplate(kinds, count)
    template.assign(points[index], normals[index], 3 * part[index])
    with torch.no_grad():
        template.axis.copy_(torch.stack([guess.axis for guess in guesses]))
        template.pivot.copy_(torch.stack([guess.pivot for guess in guesses]))
    return template


def starts(
    posed: Posed, kinds: tuple[JointKind, ...], config: DiscoveryConfig, generator: torch.Generator
) -> list[Start]:
    """A template for every combination of candidate axes, those with the least loss first."""
    moved = moved_sets(posed, len(kinds), generator)
    guesses = [
        search_joint(posed, rows, kind, torch.eye(3), generator=generator)
        for rows, kind in zip(moved, kinds, strict=True)
    ]
    none = torch.zeros(len(posed.rotation), len(kinds))
    tried: list[tuple[float, ArticulatedTemplate, Placement]] = []
    each = config.starts if len(kinds) == 1 else min(config.starts, 2)
    for combination in product(*[found[:each] for found in guesses]):
        template = first_template(posed, moved, combination, kinds, config.template_points)
        placement = Placement.at(posed.rotation, posed.translation, none)
        placement, loss = _first_rounds(template, posed.views, placement, config, generator)
        tried.append((float(loss.mean()), template, placement))
    tried.sort(key=lambda start: start[0])
    return [(t, Trusted(views=posed.views, placement=placement)) for _, t, placement in tried]


def _first_rounds(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Fit and rebuild a start; a sliding joint gets its axis after the first fit and keeps it."""
    kinds, axis_weight = template.kinds, 0.0
    states = wide_states(kinds)
    for number in range(4):
        options = FitOptions(
            steps=30,
            sharpness=(60.0, 200.0) if number == 0 else (120.0, 300.0),
            search_states=(0, 15),
            axis_weight=axis_weight,
        )
        placement, _ = fit(template, views, placement, options, states=states, generator=generator)
        if number == 0 and config.way_out and "prismatic" in kinds:
            placement = choose_axes(template, placement, torch.eye(3))
            axis_weight = config.axis_weight
        rebuild(template, views, placement, generator=generator)
    options = FitOptions(steps=20, axis_weight=axis_weight)
    return fit(template, views, placement, options, generator=generator)
