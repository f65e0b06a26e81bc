# SPDX-License-Identifier: MIT
"""Pose by search: one view against another over a grid of rotations, without labels.

The score of a hypothesis asks of every point of either view: is there surface of the other view
here, with the same normal (cost near 0); would it be hidden there (no evidence, a fixed middle
cost); or does it stand in space that the other camera saw empty (cost 1)? The best hypotheses are
refined by weighted point-to-plane steps. The margin between the best and the second, different
rotation tells how much a registration may be trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.points import gather
from scapo.registered.views import Views, free_and_hidden

NORMAL_WEIGHT = 1.5
"""Of 1 - cosine of the normals beside sharpness times squared distance."""
HIDDEN_COST = 0.55
"""Largest cost of a point about which the other view says nothing."""
EXTENT = 0.8
"""Half the side of the cube of nearest points; a cloud reaches about 0.6."""
CELLS = 28


def rotation_grid(count: int) -> Float[Tensor, "{count} 3 3"]:
    """Evenly spread rotations: the super-Fibonacci spiral of Alexa (CVPR 2022)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    radius, other = (i / count).sqrt(), (1 - i / count).sqrt()
    alpha = 2 * math.pi * i / math.sqrt(2)
    beta = 2 * math.pi * i / 1.533751168755204288118041
    quaternion = [
        radius * alpha.sin(),
        radius * alpha.cos(),
        other * beta.sin(),
        other * beta.cos(),
    ]
    return roma.unitquat_to_rotmat(torch.stack(quaternion, -1)).float()


def within(cosine_trace: Float[Tensor, "*B"], degrees: float) -> Tensor:
    """Whether rotations A, B with trace(A^T B) given differ by less than `degrees`."""
    return cosine_trace > 1 + 2 * math.cos(math.radians(degrees))


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestGrid:
    """Nearest oriented point of each of B sets for every cell of a cube: one gather a query."""

    table: Float[Tensor, "R 6"]
    """Row set * CELLS^3 + cell: point and normal."""

    @staticmethod
    @torch.no_grad()
    def build(points: Float[Tensor, "B K 3"], normals: Float[Tensor, "B K 3"]) -> NearestGrid:
        """The grid of sets of oriented points."""
        axis = ((torch.arange(CELLS) + 0.5) / CELLS * 2 - 1) * EXTENT
        axis = axis.to(points)
        cells = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).flatten(0, 2)
        rows = []
        for p, n in zip(points, normals, strict=True):
            index = torch.cat(
                [(p.square().sum(-1) - 2 * part @ p.mT).argmin(-1) for part in cells.split(4096)]
            )
            rows.append(torch.cat([p[index], n[index]], -1))
        return NearestGrid(table=torch.cat(rows))

    def lookup(
        self, index: Int[Tensor, " Q"], points: Float[Tensor, "Q H 3"]
    ) -> tuple[Float[Tensor, "Q H 3"], Float[Tensor, "Q H 3"]]:
        """Nearest point of set `index` and its normal, exact to half a cell."""
        cell = ((points + EXTENT) * (CELLS / (2 * EXTENT))).long().clamp_(0, CELLS - 1)
        row = (cell[..., 0] * CELLS + cell[..., 1]) * CELLS + cell[..., 2]
        row = row + index[:, None] * CELLS**3
        found = self.table.index_select(0, row.flatten()).unflatten(0, row.shape)
        return found[..., :3], found[..., 3:]


@dataclass(frozen=True, slots=True, kw_only=True)
class Modes:
    """The best distinct poses of Q pairs, target_T_source, best first."""

    rotation: Float[Tensor, "Q K 3 3"]
    translation: Float[Tensor, "Q K 3"]
    score: Float[Tensor, "Q K"]
    """Mean cost, 0 perfect."""


def one_way_cost(
    views: Views,
    grid: NearestGrid,
    index: Int[Tensor, " Q"],
    points: Float[Tensor, "Q H P 3"],
    normals: Float[Tensor, "Q H P 3"],
) -> Float[Tensor, "Q H"]:
    """Mean cost of oriented points placed into views `index` under H hypotheses."""
    shape = points.shape[:3]
    flat = points.flatten(1, 2)
    near, near_normal = grid.lookup(index, flat)
    cosine = (normals.flatten(1, 2) * near_normal).sum(-1)
    cost = 1 - torch.exp(-140.0 * (flat - near).square().sum(-1) - NORMAL_WEIGHT * (1 - cosine))
    _, hidden = free_and_hidden(views.take(index), flat, 0.05)
    cost = torch.where(hidden, cost.clamp_max(HIDDEN_COST), cost)
    return cost.unflatten(1, shape[1:]).mean(-1)


@torch.no_grad()
def pair_cost(
    views: Views,
    grid: NearestGrid,
    pairs: Int[Tensor, "Q 2"],
    rotation: Float[Tensor, "Q H 3 3"],
    translation: Float[Tensor, "Q H 3"],
    count: int,
) -> Float[Tensor, "Q H"]:
    """Cost of hypotheses target_T_source, both ways, from `count` points of each view."""
    source, target = pairs[:, 0], pairs[:, 1]
    points, normals = views.points[:, None, :count], views.normals[:, None, :count]
    there = points[source] @ rotation.mT + translation[:, :, None]
    forward = one_way_cost(views, grid, target, there, normals[source] @ rotation.mT)
    back = (points[target] - translation[:, :, None]) @ rotation
    return (forward + one_way_cost(views, grid, source, back, normals[target] @ rotation)) / 2


@torch.no_grad()
def slide(
    views: Views,
    grid: NearestGrid,
    pairs: Int[Tensor, "Q 2"],
    rotation: Float[Tensor, "Q H 3 3"],
    count: int,
) -> Float[Tensor, "Q H 3"]:
    """The translation of each rotation: from centroid on centroid to the mean of the matches.

    Centroids of two partial views are not the same point of the object, and a wrong translation
    hides a right rotation.
    """
    points = (views.points[:, None, :count])[pairs[:, 0]] @ rotation.mT
    normals = (views.normals[:, None, :count])[pairs[:, 0]] @ rotation.mT
    move = rotation.new_zeros(*rotation.shape[:2], 3)
    for sharpness in (20.0, 60.0):
        placed = points + move[:, :, None]
        near, near_normal = (
            x.unflatten(1, placed.shape[1:3])
            for x in grid.lookup(pairs[:, 1], placed.flatten(1, 2))
        )
        gap = near - placed
        cosine = (normals * near_normal).sum(-1)
        weight = torch.exp(-sharpness * gap.square().sum(-1) - NORMAL_WEIGHT * (1 - cosine))
        total = weight.sum(-1, keepdim=True).clamp_min(1e-6)
        move = move + (weight[..., None] * gap).sum(-2) / total
    return move


@torch.no_grad()
def distinct(
    rotation: Float[Tensor, "Q H 3 3"], score: Float[Tensor, "Q H"], count: int, degrees: float
) -> Int[Tensor, "Q {count}"]:
    """Indices of the best hypotheses, each `degrees` away from those before it.

    Where there are no more such, the best of the rest follow.
    """
    score = score.clone()
    rows = torch.arange(len(score), device=score.device)
    chosen = []
    for _ in range(count):
        best = score.argmin(-1)
        chosen.append(best)
        trace = (rotation * rotation[rows, best][:, None]).sum((-1, -2))
        score = torch.where(within(trace, degrees), score + 10, score)
        score[rows, best] += 100
    return torch.stack(chosen, -1)


def plane_step(
    moved: Float[Tensor, "B P 3"],
    target: Float[Tensor, "B P 3"],
    normal: Float[Tensor, "B P 3"],
    weight: Float[Tensor, "B P"],
    slide: float = 0.1,
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
    """One Gauss-Newton step of point-to-plane plus `slide` times point-to-point distances.

    Returns:
        Rotation and translation to apply after the present pose, x -> R x + t.
    """
    residual = moved - target
    jacobian = torch.cat([torch.linalg.cross(moved, normal), normal], -1)
    weighted = jacobian * weight[..., None]
    system = weighted.mT @ jacobian
    right = (weighted * (residual * normal).sum(-1, keepdim=True)).sum(-2)
    eye = torch.eye(3).to(moved).expand(*moved.shape[:-1], 3, 3)
    skew = torch.linalg.cross(moved[..., None, :].expand_as(eye), eye)
    full = torch.cat([skew, eye], -1).flatten(-3, -2)  # (B, 3P, 6): d residual / d twist
    spread = weight.repeat_interleave(3, -1)[..., None] * slide * full
    system = system + spread.mT @ full
    right = right + (spread * residual.flatten(-2)[..., None]).sum(-2)
    damping = 1e-4 * system.diagonal(dim1=-2, dim2=-1).mean(-1) + 1e-8
    system = system + damping[..., None, None] * torch.eye(6).to(moved)
    twist = -torch.linalg.solve(system, right)
    return roma.rotvec_to_rotmat(twist[..., :3]), twist[..., 3:]


@torch.no_grad()
def icp(
    views: Views,
    pairs: Int[Tensor, "Q 2"],
    rotation: Float[Tensor, "Q 3 3"],
    translation: Float[Tensor, "Q 3"],
    *,
    steps: int = 8,
    count: int = 96,
) -> tuple[Float[Tensor, "Q 3 3"], Float[Tensor, "Q 3"]]:
    """Weighted point-to-plane refinement of target_T_source, weights sharper each step."""
    points, normals = views.points[pairs[:, 0], :count], views.normals[pairs[:, 0], :count]
    target, target_normals = views.points[pairs[:, 1]], views.normals[pairs[:, 1]]
    square = target.square().sum(-1)[:, None]
    for step in range(steps):
        sharpness = 60.0 * (400.0 / 60.0) ** (step / max(steps - 1, 1))
        moved = points @ rotation.mT + translation[:, None]
        index = (square - 2 * moved @ target.mT).argmin(-1)
        near, near_normal = gather(target, index), gather(target_normals, index)
        cosine = ((normals @ rotation.mT) * near_normal).sum(-1)
        weight = (moved - near).square().sum(-1) * -sharpness - NORMAL_WEIGHT * (1 - cosine)
        turn, shift = plane_step(moved, near, near_normal, weight.exp())
        rotation = turn @ rotation
        translation = (turn @ translation[..., None])[..., 0] + shift
    return rotation, translation


@torch.no_grad()
def register_pairs(
    views: Views,
    pairs: Int[Tensor, "Q 2"],
    *,
    rotations: Float[Tensor, "H 3 3"],
    keep: int = 4,
    chunk: int = 8,
) -> Modes:
    """The `keep` best distinct poses of each pair's first view in the frame of its second.

    Only rotations under which the two cameras look from the same side are tried: surfaces that
    were seen from opposite sides do not overlap.
    """
    grid = NearestGrid.build(views.points, views.normals)
    found = [_register(views, grid, part, rotations, keep) for part in pairs.split(chunk)]
    rotation, translation, score = (torch.cat(rows) for rows in zip(*found, strict=True))
    return Modes(rotation=rotation, translation=translation, score=score)


def _register(
    views: Views,
    grid: NearestGrid,
    pairs: Int[Tensor, "Q 2"],
    rotations: Float[Tensor, "H 3 3"],
    keep: int,
) -> tuple[Tensor, Tensor, Tensor]:
    camera = views.direction()
    move = views.points.new_zeros(0)
    score = views.points.new_zeros(0)
    side = torch.einsum("hab,qb,qa->qh", rotations, camera[pairs[:, 0]], camera[pairs[:, 1]])
    index = side.topk(round(0.62 * len(rotations)), dim=-1).indices
    for count, left in ((28, 96), (96, None)):
        hypotheses = rotations[index]
        move = slide(views, grid, pairs, hypotheses, min(count, 48))
        score = pair_cost(views, grid, pairs, hypotheses, move, count)
        if left is not None:
            index = index.gather(1, score.topk(left, largest=False).indices)
    best = distinct(rotations[index], score, keep + 2, 28.0)
    move = move.gather(1, best[..., None].expand(-1, -1, 3))
    index = index.gather(1, best)
    many = pairs.repeat_interleave(keep + 2, 0)
    rotation, translation = icp(views, many, rotations[index].flatten(0, 1), move.flatten(0, 1))
    rotation, translation = (x.unflatten(0, index.shape) for x in (rotation, translation))
    score = pair_cost(views, grid, pairs, rotation, translation, 192)
    best = distinct(rotation, score, keep, 20.0)
    rows = torch.arange(len(pairs), device=best.device)[:, None]
    rotation, translation, score = rotation[rows, best], translation[rows, best], score[rows, best]
    return rotation, translation, _unrivalled(rotation, score)


def _unrivalled(
    rotation: Float[Tensor, "Q K 3 3"], score: Float[Tensor, "Q K"]
) -> Float[Tensor, "Q K"]:
    """Scores of modes that repeat a better one set a clear margin above the best.

    All hypotheses came to the same pose, so nothing rivals it; the margin stays one that other
    pairs reach too, or a few such pairs would outvote the rest.
    """
    trace = torch.einsum("qkab,qlab->qkl", rotation, rotation)
    repeats = within(trace, 20.0).tril(-1).any(-1)
    clear = torch.maximum(score[:, :1] + 0.1, score.amax(1, keepdim=True))
    return torch.where(repeats, clear, score)
