# SPDX-License-Identifier: MIT
"""Where the hinges of objects sit, told by many views of each.

A view alone tells little of it: the template's hinge is stretched with the body, and a part that
sits elsewhere takes its hinge along. But an object's door, seen at many angles, has turned about
one line. If the part lies at R_v x + m_v on the base in view v, x on the part of the template and
R_v its turn, then m_v = p + R_v c, with p on the hinge and c the same in all views: linear least
squares, in which views that were placed otherwise are left out by degrees. The network learns
where such hinges sit, and says it of single views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.rigid import apply, invert, rigid
from scapo.registered.template import ArticulatedTemplate, Placement

PRIOR = (0.04, 4e-4)
"""Pull of p to the middle of what the views say one by one, and of c to 0, in views."""
FAR, NEAR, SHRINK, SWEEPS = 0.15, 0.02, 0.8, 40
"""Misfit at which a view counts half, at first and in the end, its factor, and fits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hinges:
    """Of B clouds the hinges of the objects that they show."""

    pivot: Float[Tensor, "B J 3"]
    """A point of each, on the base as placed, template frame."""
    trust: Float[Tensor, "B J"]
    """How well the view agrees with the others of its object, 1 to 0; 0 for a sliding joint."""


@torch.no_grad()
def hinges_of_objects(
    template: ArticulatedTemplate,
    placement: Placement,
    size: Float[Tensor, " B"],
    objects: Sequence[Int[Tensor, " V"]],
) -> Hinges:
    """By how the parts lie in all views of each object.

    Args:
        template: As placed.
        placement: Of B clouds.
        size: Normalised lengths to a metre in each.
        objects: Rows of the clouds that show the same.
    """
    pivot, trust = template.pivots(placement), torch.zeros_like(placement.state)
    poses = template.part_poses(placement)
    back = invert(rigid(poses.rotation[:, :1], poses.translation[:, :1]))
    motion = back @ rigid(poses.rotation[:, 1:], poses.translation[:, 1:])  # (B, J, 4, 4)
    for row in objects:
        unit = size[row] / size[row].median()
        for j, kind in enumerate(template.kinds):
            if kind == "revolute":
                own, move = pivot[row, j] / unit[:, None], motion[row, j]
                move[:, :3, 3] /= unit[:, None]
                found, trust[row, j] = _centre(move, own.median(0).values)
                pivot[row, j] = found * unit[:, None]
    return Hinges(pivot=pivot, trust=trust)


def _centre(
    motion: Float[Tensor, "V 4 4"], guess: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, " 3"], Float[Tensor, " V"]]:
    """The p of m = p + R c, and how well each view agrees."""
    turn, move = motion[:, :3, :3], motion[:, :3, 3]
    design = torch.cat([torch.eye(3).to(turn).expand_as(turn), turn], -1)  # (V, 3, 6)
    pull = torch.diag(move.new_tensor(PRIOR).repeat_interleave(3))
    aim = pull @ torch.cat([guess, torch.zeros_like(guess)])
    weight, found = move.new_ones(len(move)), move.new_zeros(6)
    for sweep in range(SWEEPS):
        share = weight[:, None, None]
        left = (share * design.mT @ design).sum(0) + pull
        found = torch.linalg.solve(left, (share * design.mT @ move[..., None]).sum(0)[:, 0] + aim)
        off = (design @ found - move).norm(dim=-1)
        weight = 1 / (1 + (off / max(NEAR, FAR * SHRINK**sweep)).square())
    return found[:3], weight


@torch.no_grad()
def as_placed_by(
    candidates: Placement,
    best: Int[Tensor, " B"],
    hinges: Hinges,
    template: ArticulatedTemplate,
) -> Float[Tensor, "B C J 3"]:
    """The same hinges on the base as each candidate places it, template frame.

    Where a candidate takes two parts for each other, their hinges change places as well.

    Args:
        candidates: B * C, those of a cloud in a row.
        best: Whose base the hinges are given on.
        hinges: Of the clouds.
        template: As placed.
    """
    pose = rigid(candidates.rotation, candidates.translation).unflatten(0, (len(best), -1))
    row = torch.arange(len(best), device=best.device)
    seen = apply(pose[row, best], hinges.pivot)  # (B, J, 3), in the cloud
    found = apply(invert(pose), seen[:, None])
    if len(template.kinds) == 1:
        return found
    own = template.pivots(candidates).unflatten(0, (len(best), -1))
    other = found.flip(2)
    off = [(some - own).norm(dim=-1).sum(-1) for some in (found, other)]
    return torch.where((off[1] < off[0])[..., None, None], other, found)
