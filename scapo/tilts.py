# SPDX-License-Identifier: MIT
"""How far each view sees a hinged part turned away from where the hinge puts it.

Each part is turned about its pivot, base and state held, until it lies on its points. The template
may be a fan of parts that are tilted to either side; against the mean over template points within
reach a part is measured from the middle of the fan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.joint_fit import NORMAL_LENGTH, across_axis, oriented_nearest
from scapo.points import gather
from scapo.sightings import Views
from scapo.template import ArticulatedTemplate, PartPoses, Placement

LEAST_POINTS = 12
"""Of a part, of those of a view, for its tilt to count."""
CHUNK = 64
"""Views whose tilts are measured at once."""
LARGEST = 0.35
"""Tilt (rad) that a part is posed with."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tilts:
    """How B views see J parts turned from where straight axes put them."""

    turn: Float[Tensor, "B J 2"]
    """Rotation vectors (rad) in the part's own frame, along the two directions of `across_axis`;
    what is along the axis belongs to the state."""
    seen: Bool[Tensor, "B J"]


def spread_across(
    turn: Float[Tensor, "B J 2"], template: ArticulatedTemplate
) -> Float[Tensor, "B J 3"]:
    """Rotation vectors along the two directions across each axis, in three coordinates."""
    across = torch.stack([across_axis(axis) for axis in template.directions()])
    return (turn[:, :, None] @ across)[:, :, 0]


@torch.no_grad()
def measure(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    reaches: tuple[float, ...],
    poses: PartPoses | None = None,
) -> Tilts:
    """Turn every hinge's part about its pivot until it lies on its points.

    Args:
        template: Held.
        views: B views.
        placement: Of the base, and the states that tilts are told from.
        reaches: One after the other, of the Gaussian over template points whose mean a view's
            point is matched with; 0 for the nearest one.
        poses: Of the parts, where the turns start, if they are not as placed.
    """
    poses = template.part_poses(placement) if poses is None else poses
    found = [
        _measure(template, views.take(index), placement.take(index), reaches, poses.take(index))
        for index in torch.arange(len(views.points), device=views.points.device).split(CHUNK)
    ]
    return Tilts(
        turn=torch.cat([tilts.turn for tilts in found]),
        seen=torch.cat([tilts.seen for tilts in found]),
    )


def _measure(
    template: ArticulatedTemplate,
    views: Views,
    placement: Placement,
    reaches: tuple[float, ...],
    poses: PartPoses,
) -> Tilts:
    placed = template.place(placement, poses)
    part = template.logit.argmax(-1)
    own = part[oriented_nearest(views.points, views.normals, *placed)]
    base, axes = placement.rotation, template.directions()
    points = (views.points - placement.translation[:, None]) @ base
    normals, scale = views.normals @ base, placement.log_scale.exp()
    turns, seen = [], []
    for j, kind in enumerate(template.kinds):
        mine = own == j + 1
        seen.append((mine.sum(1) >= LEAST_POINTS) & (kind == "revolute"))
        turned = base.mT @ poses.rotation[:, j + 1]
        if bool(seen[-1].any()):
            pivot = (template.pivot[j] * scale)[:, None]
            arms = template.points[part == j + 1] * scale[:, None] - pivot
            source = points - pivot, normals
            target = arms, template.normals[part == j + 1]
            for reach in reaches:
                for _ in range(3):
                    turned = _turn_onto(source, target, turned, mine, reach)
        straight = roma.rotvec_to_rotmat(axes[j] * placement.state[:, j : j + 1])
        tilt = roma.rotmat_to_rotvec(straight.mT @ turned)
        turns.append(tilt @ across_axis(axes[j]).T)
    return Tilts(turn=torch.stack(turns, 1), seen=torch.stack(seen, 1))


def tilted(template: ArticulatedTemplate, placement: Placement, tilts: Tilts) -> PartPoses:
    """Poses of parts that are tilted as was seen; straight where nothing was."""
    straight = template.part_poses(replace(placement, lean=torch.zeros_like(placement.lean)))
    middle = tilts.turn.masked_fill(~tilts.seen[..., None], torch.nan).nanmedian(0).values
    turn = (tilts.turn - middle).nan_to_num()
    turn = turn * (LARGEST / turn.norm(dim=-1, keepdim=True).clamp_min(LARGEST))
    extra = roma.rotvec_to_rotmat(spread_across(turn * tilts.seen[..., None], template))
    pivot = template.pivot * placement.log_scale.exp()[:, None]
    rotation = torch.cat([straight.rotation[:, :1], straight.rotation[:, 1:] @ extra], 1)
    moved = (straight.rotation[:, 1:] - rotation[:, 1:]) @ pivot[..., None]
    translation = straight.translation.clone()
    translation[:, 1:] += moved[..., 0]
    return PartPoses(rotation=rotation, translation=translation)


def _turn_onto(
    source: tuple[Float[Tensor, "B K 3"], Float[Tensor, "B K 3"]],
    target: tuple[Float[Tensor, "B M 3"], Float[Tensor, "M 3"]],
    turned: Float[Tensor, "B 3 3"],
    mine: Bool[Tensor, "B K"],
    reach: float,
) -> Float[Tensor, "B 3 3"]:
    """One Gauss-Newton step of a part's rotation about its pivot.

    Args:
        source: Arms from the pivot to the view's points, and their normals.
        target: Those of the part's template points before they are turned.
        turned: Rotation of the part.
        mine: Which of the view's points are the part's.
        reach: As in `measure`.
    """
    arms, normals = target[0] @ turned.mT, target[1] @ turned.mT
    one = torch.cat([source[0], NORMAL_LENGTH * source[1]], -1)
    other = torch.cat([arms, NORMAL_LENGTH * normals], -1)
    if reach:
        share = torch.softmax(-torch.cdist(one, other).square() / (2 * reach**2), -1)
        met, along, sharpness = share @ arms, 1.0, 60.0
    else:
        nearest = oriented_nearest(*source, arms, normals)
        met, along, sharpness = gather(arms, nearest), 0.25, 150.0
    off = source[0] - met
    weight = mine * torch.exp(-sharpness * off.square().sum(-1))
    eye = torch.eye(3).to(met).expand(*met.shape, 3)
    moved = torch.linalg.cross(eye, met[:, :, None].expand_as(eye))  # (B, K, 3 turns, 3)
    across = (moved @ source[1][..., None])[..., 0]
    gap = (off * source[1]).sum(-1)
    system = torch.einsum("bki,bkj,bk->bij", across, across, (1 - along) * weight)
    system = system + torch.einsum("bkic,bkjc,bk->bij", moved, moved, along * weight)
    right = torch.einsum("bki,bk,bk->bi", across, gap, (1 - along) * weight)
    right = right + torch.einsum("bkic,bkc,bk->bi", moved, off, along * weight)
    step = torch.linalg.solve(system + 0.01 * torch.eye(3).to(system), right)
    step = step * (0.15 / step.norm(dim=-1, keepdim=True).clamp_min(0.15))
    return roma.rotvec_to_rotmat(step) @ turned
