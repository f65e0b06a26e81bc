# SPDX-License-Identifier: MIT
"""The first guess of a joint: candidate axes tried like candidate rotations.

With all bases in one frame, what one view shows and others contradict has moved. For a pair of
views the moved points of one are carried by every candidate motion (axis, pivot, amount) and
compared with the other. The axis that explains most over many pairs is the guess; the amount is
free for each pair, so no state need be known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import roma
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.rigid import project_rotation
from scapo.registered.motion_segmentation import gather_evidence, spread
from scapo.registered.pairwise import HIDDEN_COST, NORMAL_WEIGHT, NearestGrid, rotation_grid
from scapo.registered.template import ArticulatedTemplate, PartPoses, Placement
from scapo.registered.views import Views, free_and_hidden

TOLD = 0.05
"""Share of the base's normals that a direction needs to be one of its main ones."""
LOST = 0.2
"""Where no direction of a frame has this share, the frame is sought anew."""
NEAR = 0.9
"""Cosine of normals that count for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointGuess:
    """A candidate joint, better with a higher score."""

    axis: Float[Tensor, " 3"]
    pivot: Float[Tensor, " 3"]
    score: float
    """Mean share of the moved points that it explains beyond standing still."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Posed:
    """Views with their poses in one frame."""

    views: Views
    rotation: Float[Tensor, "B 3 3"]
    """view_R_world"""
    translation: Float[Tensor, "B 3"]

    def world(self, count: int) -> tuple[Float[Tensor, "B K 3"], Float[Tensor, "B K 3"]]:
        """The first `count` points of every view and their normals in the common frame."""
        points = (self.views.points[:, :count] - self.translation[:, None]) @ self.rotation
        return points, self.views.normals[:, :count] @ self.rotation


@torch.no_grad()
def still_evidence(posed: Posed, *, count: int = 128, observers: int = 24) -> Float[Tensor, "B K"]:
    """How far other views confirm that each point stays where it is; smoothed log support."""
    poses = PartPoses(rotation=posed.rotation[:, None], translation=posed.translation[:, None])
    step = max(1, len(posed.rotation) // observers)
    index = torch.arange(0, len(posed.rotation), step, device=posed.rotation.device)
    none = torch.zeros_like(posed.translation)
    evidence = gather_evidence(posed.views, poses, none, count=count, observers=index[:observers])
    return spread(posed.views, evidence.log_support[..., 0, None], 3.0)[..., 0]


@torch.no_grad()
def principal_frame(
    normals: Float[Tensor, "K 3"], rotations: Float[Tensor, "H 3 3"]
) -> Float[Tensor, "3 3"]:
    """Rows: the orthogonal directions that most normals follow (a Manhattan frame).

    Shapes without such directions get the best there is: any frame will do for them.
    """
    aligned = torch.stack([(normals @ r.T).abs().amax(-1) for r in rotations])
    return _settled(normals, rotations[torch.exp(-8 * (1 - aligned)).mean(-1).argmax()])


@torch.no_grad()
def along_main_directions(template: ArticulatedTemplate, placement: Placement) -> Placement:
    """Turn the template's frame to the main directions of its base that are nearest, in place.

    While shape, axes and all placements are fitted together nothing holds the frame: the whole
    template can turn in it. What is said of directions (axes along the main ones, scales along the
    frame's) then means something else in every round. Scales keep their numbers along the new
    axes: with unequal ones the placed template changes a little. A flat base tells one direction
    only; about it the frame follows the first joint's axis.

    Returns:
        The placements of the turned template.
    """
    base = template.logit.argmax(-1) == 0
    normals = template.normals[base]
    frame = _settled(normals, torch.eye(3).to(normals))
    told = _support(normals, frame)
    if told.max() < LOST:
        frame = principal_frame(normals, rotation_grid(1500).to(normals))
        told = _support(normals, frame)
    if told.sort().values[1] < TOLD:
        frame = _turned_to(frame, int(told.argmax()), template.directions()[0])
    for vectors in (template.points, template.normals, template.axis, template.pivot):
        vectors.copy_(vectors @ frame.T)
    return replace(
        placement,
        rotation=placement.rotation @ frame.T,
        shift=placement.shift @ frame.T,
        lean=placement.lean @ frame.T,
    )


@torch.no_grad()
def tells_frame(template: ArticulatedTemplate) -> bool:
    """Whether the normals of the base follow two directions of the template's frame at least.

    Those of a plate follow one. About it the frame follows the hinge, so a pull of the hinge to
    the frame would hold it wherever it began.
    """
    normals = template.normals[template.logit.argmax(-1) == 0]
    return bool(_support(normals, torch.eye(3).to(normals)).sort().values[1] >= TOLD)


def _settled(normals: Float[Tensor, "K 3"], frame: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """The orthogonal directions near those of `frame` that most normals follow."""
    for _ in range(20):
        projected = normals @ frame.T
        axis = projected.abs().argmax(-1)
        along = projected.gather(1, axis[:, None])
        weight = torch.exp(-12 * (1 - along.abs())) * along.sign()
        rows = torch.stack([(normals * weight)[axis == c].sum(0) for c in range(3)])
        frame = project_rotation(F.normalize(rows, dim=-1))
    return frame


def _support(normals: Float[Tensor, "K 3"], frame: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
    """Share of the normals near each direction, either sign."""
    near = (normals @ frame.T).abs() > NEAR
    return near.float().sum(0) / max(len(normals), 1)


def _turned_to(
    frame: Float[Tensor, "3 3"], held: int, axis: Float[Tensor, " 3"]
) -> Float[Tensor, "3 3"]:
    """The frame turned about its direction `held` until another one lies along the axis."""
    across = axis - (axis @ frame[held]) * frame[held]
    if across.norm() < 0.3:  # the axis is the held direction: nothing tells the others
        return frame
    across = F.normalize(across, dim=0)
    along = frame @ across
    along[held] = 0
    first = int(along.abs().argmax())
    rows = frame.clone()
    rows[first] = across * along[first].sign()
    last = 3 - held - first
    rows[last] = torch.linalg.cross(rows[(last + 1) % 3], rows[(last + 2) % 3])
    return rows


def _amounts(kind: JointKind) -> Float[Tensor, " D"]:
    if kind == "prismatic":
        half = torch.linspace(0.06, 0.5, 6)
    else:
        half = torch.linspace(math.radians(12), math.radians(100), 6)
    return torch.cat([torch.zeros(1), half, -half])


@torch.no_grad()
def search_joint(
    posed: Posed,
    moved: Bool[Tensor, "B K"],
    kind: JointKind,
    directions: Float[Tensor, "A 3"],
    *,
    generator: torch.Generator,
    pairs: int = 100,
) -> list[JointGuess]:
    """The best joint along each direction, best first.

    Args:
        posed: Views in one frame.
        moved: Which of the first K points of each view have moved.
        kind: Of the joint.
        directions: Candidate axes.
        generator: Draws the pairs of views.
        pairs: How many.
    """
    points, normals = posed.world(moved.shape[1])
    rows = (moved.sum(1) >= 12).nonzero()[:, 0]
    if len(rows) < 2:
        return [JointGuess(axis=d, pivot=torch.zeros(3), score=0.0) for d in directions]
    pick = moved[rows].to(points) + 0.01 * torch.rand(moved[rows].shape, generator=generator)
    index = pick.topk(min(40, moved.shape[1]), dim=1).indices
    weight = moved[rows].gather(1, index).to(points)
    spot = index[..., None].expand(-1, -1, 3)
    points, normals = points[rows].gather(1, spot), normals[rows].gather(1, spot)
    grid = NearestGrid.build(torch.where(weight[..., None] > 0, points, 9.0), normals)
    drawn = torch.randint(len(rows), (pairs, 2), generator=generator)
    drawn = drawn[drawn[:, 0] != drawn[:, 1]]
    guesses = []
    for direction in directions:
        pivots = _pivots(points[weight > 0], direction, kind)
        score = points.new_zeros(len(pivots))
        for i, j in drawn.tolist():
            motion = _motions(direction, pivots, kind)
            moved_points = torch.einsum("vdab,kb->vdka", motion[0], points[i]) + motion[1]
            moved_normals = torch.einsum("vdab,kb->vdka", motion[0], normals[i])
            gain = _gain(posed, grid, (j, int(rows[j])), moved_points, moved_normals)
            score += (gain * weight[i]).sum(-1).amax(1) / weight[i].sum()
        best = score.argmax()
        guesses.append(
            JointGuess(axis=direction, pivot=pivots[best], score=float(score[best]) / len(drawn))
        )
    return sorted(guesses, key=lambda guess: -guess.score)


def _pivots(
    points: Float[Tensor, "C 3"], direction: Float[Tensor, " 3"], kind: JointKind
) -> Float[Tensor, "V 3"]:
    """Points of a grid across the direction, a little beyond the moved points."""
    centre = points.median(0).values
    if kind == "prismatic":
        return centre[None]
    other = F.one_hot(direction.abs().argmin(), 3).to(direction)
    u = F.normalize(torch.linalg.cross(direction, other), dim=0)
    v = torch.linalg.cross(direction, u)
    lines = []
    for side in (u, v):
        low, high = (points @ side).quantile(torch.tensor([0.02, 0.98]).to(points)).tolist()
        lines.append(torch.linspace(low - 0.08, high + 0.08, 9).to(points))
    across = lines[0][:, None, None] * u + lines[1][None, :, None] * v
    return across.flatten(0, 1) + (centre @ direction) * direction


def _motions(
    direction: Float[Tensor, " 3"], pivots: Float[Tensor, "V 3"], kind: JointKind
) -> tuple[Float[Tensor, "V D 3 3"], Float[Tensor, "V D 1 3"]]:
    """Rotation and translation of every pivot and amount; the first amount is none."""
    step = _amounts(kind).to(direction)[:, None] * direction
    if kind == "prismatic":
        turn = torch.eye(3).to(direction).expand(1, len(step), 3, 3)
        return turn, step[None, :, None]
    turn = roma.rotvec_to_rotmat(step).expand(len(pivots), -1, 3, 3)
    move = pivots[:, None] - (turn @ pivots[:, None, :, None])[..., 0]
    return turn, move[:, :, None]


def _gain(
    posed: Posed,
    grid: NearestGrid,
    target: tuple[int, int],
    points: Float[Tensor, "V D K 3"],
    normals: Float[Tensor, "V D K 3"],
) -> Float[Tensor, "V D K"]:
    """What each motion explains of each point in the target view beyond standing still."""
    row, view = target
    flat = points.flatten(0, 2)
    near, near_normal = grid.lookup(torch.tensor([row], device=flat.device), flat[None])
    cosine = (normals.flatten(0, 2) * near_normal[0]).sum(-1)
    match = torch.exp(-300 * (flat - near[0]).square().sum(-1) - NORMAL_WEIGHT * (1 - cosine))
    there = flat @ posed.rotation[view].T + posed.translation[view]
    one: Int[Tensor, " 1"] = torch.tensor([view], device=flat.device)
    _, hidden = free_and_hidden(posed.views.take(one), there[None], 0.04)
    match = torch.where(hidden[0], match.clamp_min(0.8 * (1 - HIDDEN_COST)), match)
    match = match.unflatten(0, points.shape[:3])
    return torch.maximum(match, match[:, :1]) - match[:, :1]
