# SPDX-License-Identifier: MIT
"""Pose by search: one view against another over a grid of rotations, without labels.

The score of a hypothesis asks of every point of either view: is there surface of the other view
here, with the same normal (cost near 0); would it be hidden there (no evidence, a fixed middle
cost); or does it stand in space that the other camera saw empty (cost 1)? The best hypotheses are
refined by weighted point-to-plane steps (ICP). The margin between the best and the second,
different rotation tells how much a registration may be trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.points import gather
from scapo.geometry.rotations import rotvec_to_rotmat, unitquat_to_rotmat
from scapo.records import cat, take
from scapo.registered.gauss_newton import by_turn, damped_step, point_equations
from scapo.registered.view_loss import match_weight, sharpened
from scapo.registered.views import TINY, PartialViews

HIDDEN_COST = 0.55
"""Largest cost of a point about which the other view says nothing, where two objects differ: what
overlaps is never the same, so much of it has to."""
OWN_HIDDEN_COST = 0.25
"""That for two views of one object, of which what overlaps is the same: two sides that share an
edge overlap less than two that look alike, but only they match."""
HIDDEN_BEHIND = 0.05  # Normalised length behind what a camera saw at which a point is hidden
EXTENT = 0.8  # Half the side of the cube of nearest points; a cloud reaches about 0.6
CELLS = 28
"""Of that cube along either side: 0.057 each, half of which is what a look-up may be wrong by."""
BLOCK = 4096  # Cells whose nearest points are sought at once: a few MB
SPIRAL = 1.533751168755204288118041
"""The second winding number of the super-Fibonacci spiral, the positive root of x^4 = x + 4."""
SLIDES = (20.0, 60.0)
"""Sharpness (of `match_weight`, per squared normalised length) as a view slides to its matches."""
SCORED = 140.0  # Sharpness of the score
ICP = (60.0, 400.0)  # Sharpness of the first and the last step of refinement
ICP_STEPS, ICP_POINTS = 8, 96  # Of refinement, and points of the moved view in it
SAME_SIDE = 0.62
"""Share of the grid that is tried: rotations under which both cameras look from one side."""
COARSE, FINE, FINAL = 28, 96, 192
"""Points of a view for a first score of all rotations, a second of those left, and the last."""
SLID = 48  # Points of a view, at most, that slide to their matches
LEFT = 96  # Rotations of a pair that are scored a second time
KEPT = 4  # Modes of a pair
SPARE = 2  # Hypotheses refined beyond those, as some will come to the same pose
APART = 28.0  # Degrees between hypotheses that are refined: a little more than the grid's spacing
DISTINCT = 20.0  # Degrees within which refined hypotheses are the same mode
CLEAR = 0.1  # Margin of a pair that has one mode only: one that other pairs reach too
ALONG = 0.1  # Weight of distances along the surface beside those across it
DAMPING = 1e-4  # Share of the system's mean diagonal that is added to it
NONE = 1e-8  # And beyond that, for pairs without a match
CHUNK = 8  # Pairs registered at once, each with all rotations: a matter of memory
REPEATED, CHOSEN = 10.0, 100.0
"""Added to a score, of at most 1, where it is near one that was chosen, and where it was itself."""


def rotation_grid(count: int) -> Float[Tensor, "{count} 3 3"]:
    """Evenly spread rotations: the super-Fibonacci spiral of Alexa (CVPR 2022)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    radius, other = (i / count).sqrt(), (1 - i / count).sqrt()
    alpha = 2 * math.pi * i / math.sqrt(2)
    beta = 2 * math.pi * i / SPIRAL
    quaternion = [
        radius * alpha.sin(),
        radius * alpha.cos(),
        other * beta.sin(),
        other * beta.cos(),
    ]
    return unitquat_to_rotmat(torch.stack(quaternion, -1)).float()


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
                [(p.square().sum(-1) - 2 * part @ p.mT).argmin(-1) for part in cells.split(BLOCK)]
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

    def match(
        self,
        index: Int[Tensor, " Q"],
        points: Float[Tensor, "Q H K 3"],
        normals: Float[Tensor, "Q H K 3"],
        sharpness: float,
    ) -> tuple[Float[Tensor, "Q H K 3"], Float[Tensor, "Q H K"]]:
        """From each oriented point to its nearest one of set `index`: the gap, `match_weight`."""
        near, near_normal = (
            x.unflatten(1, points.shape[1:3]) for x in self.lookup(index, points.flatten(1, 2))
        )
        gap = near - points
        cosine = (normals * near_normal).sum(-1)
        return gap, match_weight(gap.square().sum(-1), sharpness, cosine)

    def slide(
        self,
        index: Int[Tensor, " Q"],
        points: Float[Tensor, "#Q H K 3"],
        normals: Float[Tensor, "Q H K 3"],
        move: Float[Tensor, "Q H 3"],
    ) -> Float[Tensor, "Q H 3"]:
        """The translation from `move` on to where the points lie on their matches on average."""
        for sharpness in SLIDES:
            gap, weight = self.match(index, points + move[:, :, None], normals, sharpness)
            total = weight.sum(-1, keepdim=True).clamp_min(TINY)
            move = move + (weight[..., None] * gap).sum(-2) / total
        return move


@dataclass(frozen=True, slots=True, kw_only=True)
class Modes:
    """The best distinct poses of Q pairs, target_T_source, best first."""

    rotation: Float[Tensor, "Q K 3 3"]
    translation: Float[Tensor, "Q K 3"]
    score: Float[Tensor, "Q K"]
    """Mean cost, 0 perfect."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Views that are registered with one another."""

    views: PartialViews
    grid: NearestGrid
    """Of their points."""
    hidden_cost: float
    """Largest cost of a point about which the other view says nothing."""


def one_way_cost(
    scene: Scene,
    index: Int[Tensor, " Q"],
    points: Float[Tensor, "Q H K 3"],
    normals: Float[Tensor, "Q H K 3"],
) -> Float[Tensor, "Q H"]:
    """Mean cost of oriented points placed into views `index` under H hypotheses."""
    cost = 1 - scene.grid.match(index, points, normals, SCORED)[1]
    _, hidden = take(scene.views, index).free_and_hidden(points.flatten(1, 2), HIDDEN_BEHIND)
    return torch.where(hidden.view_as(cost), cost.clamp_max(scene.hidden_cost), cost).mean(-1)


@torch.no_grad()
def pair_cost(
    scene: Scene,
    pairs: Int[Tensor, "Q 2"],
    rotation: Float[Tensor, "Q H 3 3"],
    translation: Float[Tensor, "Q H 3"],
    count: int,
) -> Float[Tensor, "Q H"]:
    """Cost of hypotheses target_T_source, both ways, from `count` points of each view."""
    source, target, views = pairs[:, 0], pairs[:, 1], scene.views
    points, normals = views.points[:, None, :count], views.normals[:, None, :count]
    there = points[source] @ rotation.mT + translation[:, :, None]
    forward = one_way_cost(scene, target, there, normals[source] @ rotation.mT)
    back = (points[target] - translation[:, :, None]) @ rotation
    return (forward + one_way_cost(scene, source, back, normals[target] @ rotation)) / 2


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
        score = torch.where(within(trace, degrees), score + REPEATED, score)
        score[rows, best] += CHOSEN
    return torch.stack(chosen, -1)


def plane_step(
    moved: Float[Tensor, "B P 3"],
    target: Float[Tensor, "B P 3"],
    normal: Float[Tensor, "B P 3"],
    weight: Float[Tensor, "B P"],
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
    """One Gauss-Newton step of point-to-plane plus `ALONG` times point-to-point distances.

    Returns:
        Rotation and translation to apply after the present pose, x -> R x + t.
    """
    eye = torch.eye(3).to(moved).expand(*moved.shape, 3)
    jacobian = torch.cat([by_turn(moved), eye], -1)
    system, gradient = point_equations(jacobian, moved - target, normal, weight, ALONG * weight)
    damping = DAMPING * system.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True) + NONE
    twist = damped_step(system, gradient, damping)
    return rotvec_to_rotmat(twist[..., :3]), twist[..., 3:]


@torch.no_grad()
def icp(
    views: PartialViews,
    pairs: Int[Tensor, "Q 2"],
    rotation: Float[Tensor, "Q 3 3"],
    translation: Float[Tensor, "Q 3"],
) -> tuple[Float[Tensor, "Q 3 3"], Float[Tensor, "Q 3"]]:
    """Weighted point-to-plane refinement of target_T_source, weights sharper each step."""
    points, normals = (x[pairs[:, 0], :ICP_POINTS] for x in (views.points, views.normals))
    target, target_normals = views.points[pairs[:, 1]], views.normals[pairs[:, 1]]
    square = target.square().sum(-1)[:, None]
    for sharpness in sharpened(ICP, ICP_STEPS):
        moved = points @ rotation.mT + translation[:, None]
        index = (square - 2 * moved @ target.mT).argmin(-1)
        near, near_normal = gather(target, index), gather(target_normals, index)
        cosine = ((normals @ rotation.mT) * near_normal).sum(-1)
        weight = match_weight((moved - near).square().sum(-1), sharpness, cosine)
        turn, shift = plane_step(moved, near, near_normal, weight)
        rotation = turn @ rotation
        translation = (turn @ translation[..., None])[..., 0] + shift
    return rotation, translation


@torch.no_grad()
def register_pairs(
    views: PartialViews,
    pairs: Int[Tensor, "Q 2"],
    *,
    rotations: Float[Tensor, "H 3 3"],
    hidden_cost: float = HIDDEN_COST,
) -> Modes:
    """The `KEPT` best distinct poses of each pair's first view in the frame of its second.

    Only rotations under which the two cameras look from the same side are tried: surfaces that
    were seen from opposite sides do not overlap.

    Args:
        views: All of them.
        pairs: First and second view of each.
        rotations: That are tried.
        hidden_cost: See `OWN_HIDDEN_COST`.
    """
    grid = NearestGrid.build(views.points, views.normals)
    scene = Scene(views=views, grid=grid, hidden_cost=hidden_cost)
    return cat([_register(scene, part, rotations) for part in pairs.split(CHUNK)])


def _register(
    scene: Scene,
    pairs: Int[Tensor, "Q 2"],
    rotations: Float[Tensor, "H 3 3"],
) -> Modes:
    rotation, move = _hypotheses(scene, pairs, rotations)
    many = pairs.repeat_interleave(rotation.shape[1], 0)
    refined = icp(scene.views, many, rotation.flatten(0, 1), move.flatten(0, 1))
    rotation, translation = (x.unflatten(0, move.shape[:2]) for x in refined)
    score = pair_cost(scene, pairs, rotation, translation, FINAL)
    best = distinct(rotation, score, KEPT, DISTINCT)
    rows = torch.arange(len(pairs), device=best.device)[:, None]
    rotation, translation, score = rotation[rows, best], translation[rows, best], score[rows, best]
    return Modes(rotation=rotation, translation=translation, score=_unrivalled(rotation, score))


def _hypotheses(
    scene: Scene,
    pairs: Int[Tensor, "Q 2"],
    rotations: Float[Tensor, "H 3 3"],
) -> tuple[Float[Tensor, "Q K 3 3"], Float[Tensor, "Q K 3"]]:
    """Of each pair the best distinct rotations of the grid and their translations."""
    camera = scene.views.direction()
    side = torch.einsum("hab,qb,qa->qh", rotations, camera[pairs[:, 0]], camera[pairs[:, 1]])
    index = side.topk(round(SAME_SIDE * len(rotations)), dim=-1).indices
    move = _slide(scene, pairs, rotations[index], COARSE)
    score = pair_cost(scene, pairs, rotations[index], move, COARSE)
    index = index.gather(1, score.topk(LEFT, largest=False).indices)
    move = _slide(scene, pairs, rotations[index], SLID)
    score = pair_cost(scene, pairs, rotations[index], move, FINE)
    best = distinct(rotations[index], score, KEPT + SPARE, APART)
    return rotations[index.gather(1, best)], move.gather(1, best[..., None].expand(-1, -1, 3))


def _slide(
    scene: Scene,
    pairs: Int[Tensor, "Q 2"],
    rotation: Float[Tensor, "Q H 3 3"],
    count: int,
) -> Float[Tensor, "Q H 3"]:
    """The translation of each rotation: from centroid on centroid to the mean of the matches.

    Centroids of two partial views are not the same point of the object, and a wrong translation
    hides a right rotation.
    """
    points = (scene.views.points[:, None, :count])[pairs[:, 0]] @ rotation.mT
    normals = (scene.views.normals[:, None, :count])[pairs[:, 0]] @ rotation.mT
    none = rotation.new_zeros(*rotation.shape[:2], 3)
    return scene.grid.slide(pairs[:, 1], points, normals, none)


def _unrivalled(
    rotation: Float[Tensor, "Q K 3 3"], score: Float[Tensor, "Q K"]
) -> Float[Tensor, "Q K"]:
    """Scores of modes that repeat a better one set a clear margin above the best.

    All hypotheses came to the same pose, so nothing rivals it; the margin stays one that other
    pairs reach too, or a few such pairs would outvote the rest.
    """
    trace = torch.einsum("qkab,qlab->qkl", rotation, rotation)
    repeats = within(trace, DISTINCT).tril(-1).any(-1)
    clear = torch.maximum(score[:, :1] + CLEAR, score.amax(1, keepdim=True))
    return torch.where(repeats, clear, score)
