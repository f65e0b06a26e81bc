# SPDX-License-Identifier: MIT
"""Motion segmentation: an observed point belongs to the part whose motion other views confirm.

A point is carried by each part's motion into other views. Where they have the same surface there,
that supports the part; where they saw empty space, it speaks against it. Points for which two
motions fit alike (a wall that slides in itself) take the answer of the surface around them. From
the answers of all views the template is built anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from scapo.records import take
from scapo.registered.template import (
    ArticulatedTemplate,
    PartPoses,
    Placement,
    spread_out,
    surface_features,
)
from scapo.registered.view_loss import SEEN_WITHIN, match_weight, oriented_nearest
from scapo.registered.views import PartialViews

OBSERVERS, SETTLED_OBSERVERS = 24, 72
"""Views, at most, that are asked about the points of others, and once placements are settled."""
PRIOR = 0.3
"""Views added to those that agree and to those that do not: where none tells, support is a half."""
SAME_PLACE = 400.0
"""Sharpness (of `match_weight`, per squared normalised length) of having the same surface."""
FACING = 0.3
"""Cosine above which normals are alike at all, and above which a surface faces the camera."""
ALIKE = 0.5  # Cosine beyond `FACING` that it takes for normals to be wholly alike
MISSED = 0.5
"""How much surface that should be there and is not speaks against a motion; empty space: 1."""
NEIGHBOUR, FLATNESS = 0.06, 3.0
"""Of neighbours on a surface: normalised length, and weight of 1 - cosine of their normals."""
STIFFNESS = 10.0  # How far answers spread, against what each point says itself
LEAST_COUNT, ALL_COUNT = 40, 6000
"""Points of a view that the template is built from, at least, and of all views together."""
BASE_BONUS, LEAST_BONUS, LEAST_PART = 0.3, 0.1, 0.05
"""Log support by which the base wins over a part, so that what nothing tells apart stays with it;
that where it would leave a part with less than this share of the points, and for hinges once
placements are settled: what lies near a hinge moves little, but turns."""
SUPPORTED, CONFIRMED = 0.4, 0.3
"""Share of the views that must agree for a point to enter the template; once placements are
settled, those that have a point of the same part there: where lids stand open is no body, though
many views have a lid there and one whose lid was taken for the body agrees with them."""
SEEN = 0.05  # Share of the observers that must have seen it, or more than one view
LEAST_GOOD = 50  # Points without which the template stays as it was
AVERAGED = 0.03
"""Reach (normalised length) of the mean that makes a template point of those about it."""
GAP = 3.0  # Times the usual distance of template points within which they are one piece
TAKEN = 1.0  # Logit by which the base wins points of other pieces of a part
SURENESS = 6.0  # Logit of a part per unit of log support


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Of K points in each of B views, for each of P motions."""

    points: Float[Tensor, "B K P 3"]
    """Template frame, unposed by each part's motion."""
    normals: Float[Tensor, "B K P 3"]
    log_support: Float[Tensor, "B K P"]
    """Logarithm of the share of the views that agree, of those that can tell."""
    seen: Float[Tensor, "B K P"]
    """Number of views that agree."""
    own: Float[Tensor, "B K P"]
    """Share of the views that agree with points of the same part, of those that can tell."""


@torch.no_grad()
def gather_evidence(
    views: PartialViews,
    poses: PartPoses,
    log_scale: Float[Tensor, "B 3"],
    *,
    count: int,
    observers: Int[Tensor, " O"],
    part: Float[Tensor, "B N P"] | None = None,
) -> Evidence:
    """Support of every view's first `count` points, or all, from the `observers` among them.

    Args:
        views: B views of N points.
        poses: Of the parts in them.
        log_scale: Of the objects.
        count: Points of each that are asked about.
        observers: Which views are asked.
        part: Which part each point is of; None: any.
    """
    count = min(count, views.points.shape[1])
    scale = log_scale.exp()
    columns = []
    for p in range(poses.rotation.shape[1]):
        turn, move = poses.rotation[:, p], poses.translation[:, p]
        points = (views.points[:, :count] - move[:, None]) @ turn / scale[:, None]
        normals = views.normals[:, :count] @ turn
        agree, against, alike = points.new_zeros(3, points.shape[0] * count).unbind(0)
        own = torch.arange(len(points), device=points.device).repeat_interleave(count)
        for o in observers.tolist():
            there = points.flatten(0, 1) * scale[o] @ turn[o].T + move[o]
            yes, no, met = _witness(
                take(views, observers.new_tensor([o])), there, normals.flatten(0, 1) @ turn[o].T
            )
            agree = agree + yes * (own != o)
            against = against + no * (own != o)
            alike = alike + yes * (own != o) * (1.0 if part is None else part[o, met, p])
        log_support = ((agree + PRIOR) / (agree + against + 2 * PRIOR)).log()
        shape = points.shape[:2]
        share = (alike + PRIOR) / (agree + against + 2 * PRIOR)
        told = (value.unflatten(0, shape) for value in (log_support, agree, share))
        columns.append((points, normals, *told))
    points, normals, log_support, seen, own = (
        torch.stack(column, 2) for column in zip(*columns, strict=True)
    )
    return Evidence(points=points, normals=normals, log_support=log_support, seen=seen, own=own)


def _witness(
    view: PartialViews, points: Float[Tensor, "K 3"], normals: Float[Tensor, "K 3"]
) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"], Int[Tensor, " K"]]:
    """How far one view confirms and contradicts oriented points, in [0, 1]; by which of its own."""
    target, target_normals = view.points[0], view.normals[0]
    off, index = (target.square().sum(-1) - 2 * points @ target.T).min(-1)
    off = (off + points.square().sum(-1)).clamp_min(0)
    same = (((normals * target_normals[index]).sum(-1) - FACING) / ALIKE).clamp(0, 1)
    yes = match_weight(off, SAME_PLACE) * same
    free, hidden = (mask[0] for mask in view.free_and_hidden(points[None], SEEN_WITHIN))
    faces = (normals * F.normalize(view.camera - points, dim=-1)).sum(-1) > FACING
    missed = (~hidden & ~free & faces).to(yes)
    return yes, (1 - yes) * (free.to(yes) + MISSED * missed), index


@torch.no_grad()
def smooth(
    views: PartialViews, values: Float[Tensor, "B K C"], stiffness: float = STIFFNESS
) -> Float[Tensor, "B K C"]:
    """Values smoothed over each view's surface: (I + stiffness L)^-1 values, L its Laplacian.

    Neighbours count by distance and by how parallel their normals are, so that an answer spreads
    along a face and stops at an edge.
    """
    count = values.shape[1]
    points, normals = views.points[:, :count], views.normals[:, :count]
    off = torch.cdist(points, points).square()
    near = torch.exp(-off / (2 * NEIGHBOUR**2) - FLATNESS * (1 - normals @ normals.mT))
    near = near / near.sum(-1).mean(-1)[:, None, None]
    laplacian = torch.diag_embed(near.sum(-1)) - near
    eye = torch.eye(count).to(values)
    return torch.linalg.solve(eye + stiffness * laplacian, values)


@torch.no_grad()
def rebuild(
    template: ArticulatedTemplate,
    views: PartialViews,
    placement: Placement,
    *,
    poses: PartPoses | None = None,
    settled: bool = False,
    generator: torch.Generator,
) -> None:
    """Build the template's points and part weights anew from all views at their placements.

    Args:
        template: Changed in place.
        views: B views.
        placement: Theirs.
        poses: Of the parts, if they are not as placed.
        settled: Whether placements are near their end: more views are asked, hinged parts have
            what tells little, and only points of the same part confirm one another.
        generator: Draws the observers.
    """
    count = max(LEAST_COUNT, min(views.points.shape[1], ALL_COUNT // len(views.points)))
    order = torch.randperm(len(views.points), generator=generator, device=generator.device)
    observers = order[: SETTLED_OBSERVERS if settled else OBSERVERS]
    poses = template.part_poses(placement) if poses is None else poses
    told = _parts(template, views, template.place(placement, poses)) if settled else None
    evidence = gather_evidence(
        views, poses, placement.log_scale, count=count, observers=observers, part=told
    )
    score = evidence.log_support - evidence.log_support.mean(-1, keepdim=True)
    score = smooth(views, score)
    if not template.alike:
        hinged = settled and "prismatic" not in template.kinds  # a wall slides in itself
        score = favouring_base(score, LEAST_BONUS if hinged else BASE_BONUS)
    part = score.argmax(-1)
    chosen = part[..., None, None].expand(*part.shape, 1, 3)
    points = evidence.points.gather(2, chosen)[:, :, 0].flatten(0, 1)
    normals = evidence.normals.gather(2, chosen)[:, :, 0].flatten(0, 1)
    support = evidence.log_support.gather(2, part[..., None])[..., 0].flatten().exp()
    seen = evidence.seen.gather(2, part[..., None])[..., 0].flatten()
    own = evidence.own.gather(2, part[..., None])[..., 0].flatten()
    good = (own > (CONFIRMED if settled else SUPPORTED)) & (seen > max(1.0, SEEN * len(observers)))
    _resample(template, points, normals, score.flatten(0, 1), support, good)


def _parts(
    template: ArticulatedTemplate,
    views: PartialViews,
    placed: tuple[Float[Tensor, "B M 3"], Float[Tensor, "B M 3"]],
) -> Float[Tensor, "B N P"]:
    """Of the views' points, by the nearest of the template as it is placed."""
    return template.logit.softmax(-1)[oriented_nearest(views.points, views.normals, *placed)]


def favouring_base(
    score: Float[Tensor, "B K P"], bonus: float = BASE_BONUS
) -> Float[Tensor, "B K P"]:
    """Log support with a bonus for the base: less where it would leave a part almost nothing."""
    base = F.one_hot(torch.tensor(0), score.shape[-1]).to(score)
    favoured = score + bonus * base
    count = favoured.argmax(-1).flatten().bincount(minlength=score.shape[-1])
    scarce = bool(count.min() < LEAST_PART * count.sum())
    return score + LEAST_BONUS * base if scarce else favoured


def _resample(
    template: ArticulatedTemplate,
    points: Float[Tensor, "C 3"],
    normals: Float[Tensor, "C 3"],
    score: Float[Tensor, "C P"],
    support: Float[Tensor, " C"],
    good: Bool[Tensor, " C"],
) -> None:
    """Spread-out points among the good ones, each averaged with those about it."""
    if int(good.sum()) < LEAST_GOOD:
        return
    points, normals, score, support = points[good], normals[good], score[good], support[good]
    part = F.one_hot(score.argmax(-1), score.shape[1]).to(points)
    feature = surface_features(points, normals, part)
    index = spread_out(feature, min(len(template.points), len(points)))
    off = torch.cdist(feature[index], feature).square()
    weight = torch.exp(-off / (2 * AVERAGED**2)) * support
    weight = weight / weight.sum(-1, keepdim=True)
    logit = SURENESS * weight @ score
    points = weight @ points
    template.assign(points, F.normalize(weight @ normals, dim=-1), in_one_piece(points, logit))


def in_one_piece(points: Float[Tensor, "M 3"], logit: Float[Tensor, "M P"]) -> Float[Tensor, "M P"]:
    """Part weights with all but the largest piece of each moving part given to the base.

    A part is one rigid piece. What differs in place from object to object (a rear wall, what stands
    on the body) may be explained a little better by a part's motion than by the base's, and would
    then say of the joint what is not so.
    """
    part, logit = logit.argmax(-1), logit.clone()
    off = torch.cdist(points, points)
    apart = off.fill_diagonal_(torch.inf).amin(1).median()
    linked = (off < GAP * apart).cpu().numpy()
    for p in range(1, logit.shape[1]):
        own = (part == p).nonzero()[:, 0]
        if len(own) < 2:
            continue
        rows = own.cpu().numpy()
        _, piece = connected_components(linked[rows][:, rows])
        piece = torch.as_tensor(piece, device=own.device)
        stray = own[piece != piece.bincount().argmax()]
        logit[stray, 0] = logit[stray].amax(-1) + TAKEN
    return logit
