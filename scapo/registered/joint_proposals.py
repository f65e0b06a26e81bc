# SPDX-License-Identifier: MIT
"""Joint proposals: candidate axes tried like candidate rotations.

With all bases in one frame, what one view shows and others contradict has moved. For a pair of
views the moved points of one are carried by every candidate motion (axis, pivot, amount) and
compared with the other. The axis that explains most over many pairs is proposed; the amount is
free for each pair, so no state need be known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import ends, gather, k_means
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import take
from scapo.registered.motion_segmentation import OBSERVERS, gather_evidence, smooth
from scapo.registered.pairwise import HIDDEN_COST, NearestGrid
from scapo.registered.template import PartPoses, across_axis
from scapo.registered.views import PartialViews

COUNT = 128  # Points of a view that are asked whether they moved
STIFFNESS = 3.0
"""How far the answers spread: less than those between parts, whose borders are known better."""
MOVED = 0.3  # Share of all points, the least confirmed, that count as moved
ROUNDS = 20  # Of k-means that shares moved points among joints
PAIRS = 100  # Pairs of views that every axis is tried on
LEAST_MOVED = 12  # Points of a view that must have moved for it to be in a pair
CARRIED = 40  # Points of a view that are carried by every candidate motion, those that moved first
TIE = 0.01  # Largest random number by which points are drawn among those that moved alike
AWAY = 9.0  # Normalised place of points that did not move: nothing is carried there
AMOUNT: dict[JointKind, tuple[float, float]] = {
    "prismatic": (0.06, 0.5),
    "revolute": (math.radians(8), math.radians(100)),
}
"""Least and largest amount that is tried, to either side: normalised length, and rad."""
AMOUNTS = 12  # Amounts to either side: coarser ones pass by where long thin parts lie
PIVOTS, BEYOND = 9, 0.08
"""Places of a hinge along either direction across it, up to this far beyond the moved points."""
SHARPNESS = 300.0  # Of `match_weight`, per squared normalised length
BEHIND = 0.04  # Normalised length behind what a camera saw at which a point is hidden
UNSEEN = 0.8  # Share of what a hidden point would at most be worth that it is given


@dataclass(frozen=True, slots=True, kw_only=True)
class JointProposal:
    """A candidate joint, better with a higher score."""

    axis: Float[Tensor, " 3"]
    pivot: Float[Tensor, " 3"]
    score: float
    """Mean share of the moved points that it explains beyond standing still."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PosedViews:
    """Views with their poses in one frame."""

    views: PartialViews
    rotation: Float[Tensor, "B 3 3"]
    """view_R_world"""
    translation: Float[Tensor, "B 3"]

    def world(self, count: int) -> tuple[Float[Tensor, "B K 3"], Float[Tensor, "B K 3"]]:
        """The first `count` points of every view and their normals in the common frame."""
        points = (self.views.points[:, :count] - self.translation[:, None]) @ self.rotation
        return points, self.views.normals[:, :count] @ self.rotation


@torch.no_grad()
def still_evidence(posed: PosedViews) -> Float[Tensor, "B K"]:
    """How far other views confirm that each point stays where it is; smoothed log support."""
    poses = PartPoses(rotation=posed.rotation[:, None], translation=posed.translation[:, None])
    step = max(1, len(posed.rotation) // OBSERVERS)
    index = torch.arange(0, len(posed.rotation), step, device=posed.rotation.device)
    none = torch.zeros_like(posed.translation)
    evidence = gather_evidence(posed.views, poses, none, count=COUNT, observers=index[:OBSERVERS])
    return smooth(posed.views, evidence.log_support[..., 0, None], STIFFNESS)[..., 0]


def moved_sets(
    posed: PosedViews, joints: int, generator: torch.Generator
) -> list[Bool[Tensor, "B K"]]:
    """For each joint, the points of every view that other views do not confirm where they are.

    Several joints share them by distance to as many centres (k-means in the common frame).
    """
    evidence = still_evidence(posed)
    moved = evidence < evidence.flatten().quantile(MOVED)
    if joints == 1:
        return [moved]
    points, _ = posed.world(moved.shape[1])
    cloud = points[moved]
    centres = cloud[torch.randperm(len(cloud), generator=generator)[:joints]]
    centres = k_means(cloud, centres, ROUNDS)
    label = torch.cdist(points.flatten(0, 1), centres).argmin(-1).view(moved.shape)
    return [moved & (label == k) for k in range(joints)]


def propose_joints(
    posed: PosedViews, kinds: tuple[JointKind, ...], generator: torch.Generator
) -> list[tuple[Bool[Tensor, "B K"], list[JointProposal]]]:
    """For every joint which points moved by it, and its proposals, best first."""
    return [
        (moved, candidates(posed, moved, kind, torch.eye(3), generator=generator))
        for moved, kind in zip(moved_sets(posed, len(kinds), generator), kinds, strict=True)
    ]


@torch.no_grad()
def candidates(
    posed: PosedViews,
    moved: Bool[Tensor, "B K"],
    kind: JointKind,
    directions: Float[Tensor, "A 3"],
    *,
    generator: torch.Generator,
) -> list[JointProposal]:
    """The best joint along each direction, best first.

    Args:
        posed: Views in one frame.
        moved: Which of the first K points of each view have moved.
        kind: Of the joint.
        directions: Candidate axes.
        generator: Draws the `PAIRS` of views.
    """
    rows = (moved.sum(1) >= LEAST_MOVED).nonzero()[:, 0]
    if len(rows) < 2:
        return [JointProposal(axis=d, pivot=torch.zeros(3), score=0.0) for d in directions]
    tie = TIE * torch.rand(moved[rows].shape, generator=generator)
    points, normals, weight = most_moved(take(posed, rows), moved[rows], tie)
    grid = NearestGrid.build(torch.where(weight[..., None] > 0, points, AWAY), normals)
    drawn = torch.randint(len(rows), (PAIRS, 2), generator=generator)
    drawn = drawn[drawn[:, 0] != drawn[:, 1]]
    proposals = []
    for direction in directions:
        pivots = _pivots(points[weight > 0], direction, kind)
        score = points.new_zeros(len(pivots))
        turn, move = motions(direction, pivots, _amounts(kind), kind)
        for i, j in drawn.tolist():
            moved_points = torch.einsum("vdab,kb->vdka", turn, points[i]) + move[:, :, None]
            moved_normals = torch.einsum("vdab,kb->vdka", turn, normals[i])
            gain = _gain(posed, grid, (j, int(rows[j])), moved_points, moved_normals)
            score += (gain * weight[i]).sum(-1).amax(1) / weight[i].sum()
        best = score.argmax()
        proposals.append(
            JointProposal(axis=direction, pivot=pivots[best], score=float(score[best]) / len(drawn))
        )
    return sorted(proposals, key=lambda proposal: -proposal.score)


def _pivots(
    points: Float[Tensor, "C 3"], direction: Float[Tensor, " 3"], kind: JointKind
) -> Float[Tensor, "V 3"]:
    """Points of a grid across the direction, a little beyond the moved points."""
    centre = points.median(0).values
    if kind == "prismatic":
        return centre[None]
    u, v = across_axis(direction)
    lines = []
    for side in (u, v):
        low, high = ends(points @ side).tolist()
        lines.append(torch.linspace(low - BEYOND, high + BEYOND, PIVOTS).to(points))
    across = lines[0][:, None, None] * u + lines[1][None, :, None] * v
    return across.flatten(0, 1) + (centre @ direction) * direction


def _amounts(kind: JointKind) -> Float[Tensor, " D"]:
    half = torch.linspace(*AMOUNT[kind], AMOUNTS)
    return torch.cat([torch.zeros(1), half, -half])


def motions(
    direction: Float[Tensor, " 3"],
    pivots: Float[Tensor, "V 3"],
    amount: Float[Tensor, " D"],
    kind: JointKind,
) -> tuple[Float[Tensor, "V D 3 3"], Float[Tensor, "V D 3"]]:
    """Rotation and translation by every amount about every pivot; a sliding joint has one."""
    step = amount.to(direction)[:, None] * direction
    if kind == "prismatic":
        return torch.eye(3).to(direction).expand(1, len(step), 3, 3), step[None]
    turn = rotvec_to_rotmat(step).expand(len(pivots), -1, 3, 3)
    return turn, pivots[:, None] - (turn @ pivots[:, None, :, None])[..., 0]


def most_moved(
    posed: PosedViews, moved: Bool[Tensor, "B K"], tie: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B C 3"], Float[Tensor, "B C 3"], Float[Tensor, "B C"]]:
    """`CARRIED` points of every view in the common frame, those that moved first; their normals.

    Args:
        posed: B views.
        moved: Which points of them.
        tie: Small numbers by which points are drawn among those that moved alike.

    Returns:
        Points, normals, and 1 where a point moved.
    """
    points, normals = posed.world(moved.shape[1])
    index = (moved.to(points) + tie).topk(min(CARRIED, moved.shape[1]), dim=1).indices
    weight = moved.gather(1, index).to(points)
    return gather(points, index), gather(normals, index), weight


def matched(
    posed: PosedViews,
    grid: NearestGrid,
    target: tuple[Int[Tensor, " Q"], Int[Tensor, " Q"]],
    points: Float[Tensor, "H K 3"],
    normals: Float[Tensor, "H K 3"],
) -> Float[Tensor, "Q H K"]:
    """How far Q views show the same surface at oriented points; a little where they hide them.

    Args:
        posed: Views.
        grid: Of some of their points.
        target: Rows of the grid, and which views those are.
        points: In the common frame.
        normals: Theirs.
    """
    rows, views = target
    shape = (len(rows), *points.shape)
    _, weight = grid.match(rows, points.expand(shape), normals.expand(shape), SHARPNESS)
    there = points.flatten(0, 1) @ posed.rotation[views].mT + posed.translation[views][:, None]
    _, hidden = take(posed.views, views).free_and_hidden(there, BEHIND)
    unseen = weight.clamp_min(UNSEEN * (1 - HIDDEN_COST))
    return torch.where(hidden.view_as(weight), unseen, weight)


def _gain(
    posed: PosedViews,
    grid: NearestGrid,
    target: tuple[int, int],
    points: Float[Tensor, "V D K 3"],
    normals: Float[Tensor, "V D K 3"],
) -> Float[Tensor, "V D K"]:
    """What each motion explains of each point in the target view beyond standing still."""
    row, view = (torch.tensor([index], device=points.device) for index in target)
    weight = matched(posed, grid, (row, view), points.flatten(0, 1), normals.flatten(0, 1))
    weight = weight.view(points.shape[:3])
    return torch.maximum(weight, weight[:, :1]) - weight[:, :1]
