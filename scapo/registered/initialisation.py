# SPDX-License-Identifier: MIT
"""First templates from bare views: pairs are registered and vote, what moves gives the joints.

Pairwise registrations of a few views vote for one frame; what moves in it gives proposals of
joints, and a template is fitted from each.
"""

from __future__ import annotations

from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.records import take
from scapo.registered.bundle_adjustment import Candidate, Inliers, first_fit
from scapo.registered.config import DiscoveryConfig
from scapo.registered.gauge import principal_frame
from scapo.registered.joint_proposals import JointProposal, PosedViews, propose_joints
from scapo.registered.pairwise import HIDDEN_COST, OWN_HIDDEN_COST, register_pairs, rotation_grid
from scapo.registered.synchronisation import Synchronised, synchronise
from scapo.registered.template import ArticulatedTemplate, Placement, spread_out, surface_features
from scapo.registered.views import PartialViews

LEAST_VIEWS = 2  # That a template is first fitted to
FRAME_EVERY = 4  # Of the normals, one in so many tells the main directions
AXES_OF_SEVERAL = 2
"""Proposals of each joint that are fitted, at most, where a category has several joints."""
TEMPLATE_EVERY = 2  # Of all moved and still points, one in so many may become one of the template's
RING, PARTNERS = 20, 5
"""Views of an object in a ring, and how many before a view, and as many after it, that it is
registered with: half of all pairs, by which nearly as many poses are right."""
LINKS = 4  # Of the ring, with which each further view of the object is registered
SURENESS = 3.0  # Logit of the part that a point begins in


def common_frame(
    views: PartialViews, rotations: int, share: float, *, own: bool = False
) -> PosedViews:
    """That share of the views, those that agree best, in one frame along main directions.

    Args:
        views: They are registered with one another.
        rotations: How many are tried for each pair.
        share: Of the views.
        own: All show one object.
    """
    poses = registered_together(views, rotations, own=own)
    kept = surest_of(poses, share)
    views, poses = take(views, kept), take(poses, kept)
    rotation, translation = poses.rotation, poses.translation
    normals = views.normals[:, ::FRAME_EVERY] @ rotation.mT
    frame = principal_frame(normals.flatten(0, 1))
    rotation, translation = frame @ rotation, translation @ frame.T
    points = views.points @ rotation.mT + translation[:, None]
    translation = translation - points.flatten(0, 1).median(0).values
    back = rotation.mT
    return PosedViews(
        views=views, rotation=back, translation=-(back @ translation[..., None])[..., 0]
    )


def registered_together(views: PartialViews, rotations: int, *, own: bool = False) -> Synchronised:
    """The poses of views on which their registrations with one another agree.

    Views of one object, most of which match, are registered with some others (`pairs_of_one`),
    bare ones with all.
    """
    count = len(views.points)
    pairs = pairs_of_one(count) if own else torch.combinations(torch.arange(count)).flip(-1)
    cost = OWN_HIDDEN_COST if own else HIDDEN_COST
    modes = register_pairs(views, pairs, rotations=rotation_grid(rotations), hidden_cost=cost)
    return synchronise(count, pairs, modes)


def pairs_of_one(count: int) -> Int[Tensor, "Q 2"]:
    """Views of one object that are registered with one another: later and earlier.

    >>> len(pairs_of_one(20)), len(pairs_of_one(5)), len(pairs_of_one(50))
    (100, 10, 220)
    """
    ring = min(count, RING)
    every = torch.combinations(torch.arange(ring)).flip(-1)
    apart = every[:, 0] - every[:, 1]
    near = every[torch.minimum(apart, ring - apart) <= PARTNERS]
    further = torch.arange(ring, count).repeat_interleave(LINKS)
    spread = (RING // LINKS) * torch.arange(LINKS).repeat(count - ring)
    return torch.cat([near, torch.stack([further, (further + spread) % RING], 1)])


def surest_of(poses: Synchronised, share: float) -> Int[Tensor, " K"]:
    """Which views are that share whose poses are surest."""
    count = len(poses.confidence)
    return poses.confidence.topk(max(LEAST_VIEWS, round(share * count))).indices


def fitted_proposals(
    posed: PosedViews,
    kinds: tuple[JointKind, ...],
    config: DiscoveryConfig,
    generator: torch.Generator,
) -> list[Candidate]:
    """A template for every combination of proposed joints, those with the least loss first."""
    moved, proposals = zip(*propose_joints(posed, kinds, generator), strict=True)
    none = torch.zeros(len(posed.rotation), len(kinds))
    each = fitted_of_each(config, len(kinds))
    tried: list[tuple[float, Candidate]] = []
    for combination in product(*[found[:each] for found in proposals]):
        surface = posed.world(moved[0].shape[1])
        template = first_template(surface, moved, combination, kinds, config.template_points)
        placement = Placement.at(posed.rotation, posed.translation, none)
        placement, loss = first_fit(template, posed.views, placement, config, generator)
        inliers = Inliers(views=posed.views, placement=placement)
        tried.append((float(loss.mean()), Candidate(template=template, inliers=inliers)))
    return [candidate for _, candidate in sorted(tried, key=lambda pair: pair[0])]


def fitted_of_each(config: DiscoveryConfig, joints: int) -> int:
    """Proposals of each joint that templates are fitted from."""
    return config.starts if joints == 1 else min(config.starts, AXES_OF_SEVERAL)


def first_template(
    surface: tuple[Float[Tensor, "B K 3"], Float[Tensor, "B K 3"]],
    moved: tuple[Bool[Tensor, "B K"], ...],
    joints: tuple[JointProposal, ...],
    kinds: tuple[JointKind, ...],
    count: int,
) -> ArticulatedTemplate:
    """Still points as base and moved points as parts, the proposed joints between them.

    Args:
        surface: Points of the views in the template's frame, and their normals.
        moved: Which of them each joint moved.
        joints: In that frame.
        kinds: Of the joints.
        count: Points of the template.
    """
    points, normals = (x.flatten(0, 1) for x in surface)
    label = torch.zeros_like(moved[0], dtype=torch.long)
    for j, rows in enumerate(moved):
        label[rows] = j + 1
    part: Float[Tensor, "C P"] = F.one_hot(label.flatten(), len(kinds) + 1).to(points)
    feature = surface_features(points, normals, part)[::TEMPLATE_EVERY]
    index = spread_out(feature, count) * TEMPLATE_EVERY
    template = ArticulatedTemplate(kinds, count)
    template.assign(points[index], normals[index], SURENESS * part[index])
    with torch.no_grad():
        template.axis.copy_(torch.stack([joint.axis for joint in joints]))
        template.pivot.copy_(torch.stack([joint.pivot for joint in joints]))
    return template
