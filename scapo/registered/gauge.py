# SPDX-License-Identifier: MIT
"""What the views leave open of a template, and is fixed by rule: sliding axes, and its frame.

Which of a part's translations is its joint's? A part without rotation differs from view to view by
a translation, for two reasons: its joint is open by some amount, and in each instance it sits
elsewhere on the body (one of several drawers of a cabinet). Single views do not tell the two apart,
and the second may be the larger. But a part that moves leaves the body's outline, while where it
sits is within. So the whole translation is free while the template is fitted, and the main
direction along which the part comes out of the body is made the joint's axis; what remains is the
instance's shift.

The frame of a template is fixed by the main directions of its base (a Manhattan frame).
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.rigid import project_rotation
from scapo.registered.pairwise import rotation_grid
from scapo.registered.template import ArticulatedTemplate, Placement, across_axis

EDGE = 0.97  # Quantile of points that counts as the end of a body: single points say little
OPEN = (0.1, 0.9)  # Quantiles of the views between which a part's way out of the body is measured
FRAMES = 1500  # Rotations of the grid of frames, about 18 degrees apart
PICKED, SETTLED = 8.0, 12.0
"""Sharpness of exp(-k (1 - cosine)), by which normals count for the nearest direction of a frame,
when one is picked from the grid and when it is settled among them."""
SETTLING = 20  # Steps in which a frame settles
TOLD = 0.12
"""Share of the base's normals that a direction needs to be one of its main ones: the edges of a
laptop's plate come to 0.09, those of scissors to 0.1, sides of boxes to 0.15 and more."""
LOST = 0.2  # Where no direction of a frame has this share, the frame is sought anew
NEAR = 0.9  # Cosine of normals that count for it
ASIDE = 0.3
"""Sine of the angle between an axis and the held direction from which on it tells the others."""
REWEIGHTED, SPREAD = 10, 0.04
"""Rounds of robust least squares, and the shift (normalised length) beyond which a view counts
less."""
SEAT = 0.15  # Share of a part's points, those nearest to its axis, that tell where its pivot sits
LOOSE, TOUCHING = 3e-4, 1.0
"""Pull of a hinge to its place, per view, so that what the views leave open stays; and to where its
part touches the base: shifts alone hold it by 0.05 to 0.2."""
NEAREST = 0.02  # Share of a part's points that must be near where it touches; strays are fewer
TOUCH_REACH, TOUCH_STEP = 0.3, 0.01  # Half side and step of the grid that is looked at
ASTRAY = 0.1  # Squared distance from where the hinge was, beside those to the parts


@torch.no_grad()
def protrusion(
    template: ArticulatedTemplate,
    placement: Placement,
    offset: Float[Tensor, "B 3"],
    joint: int,
    directions: Float[Tensor, "A 3"],
) -> Float[Tensor, "B A"]:
    """How far the part of a joint sticks out of the base along each direction; 0 for within.

    Args:
        template: Points and parts.
        placement: Scales of B views.
        offset: Of the part in each view, template frame, after scaling.
        joint: Which one.
        directions: Unit, template frame.
    """
    part = template.logit.argmax(-1)
    scale = placement.log_scale.exp()[:, None]
    ends = []
    for label in (0, joint + 1):
        points = template.points[part == label]
        if len(points) == 0:
            return offset.new_zeros(len(offset), len(directions))
        ends.append(((points * scale) @ directions.T).quantile(EDGE, dim=1))
    return (ends[1] + offset @ directions.T - ends[0]).clamp_min(0)


@torch.no_grad()
def choose_axes(
    template: ArticulatedTemplate, placement: Placement, directions: Float[Tensor, "A 3"]
) -> Placement:
    """Turn each sliding joint's axis to where its part comes out most, states and shifts with it.

    The placed template stays what it was; the mean state becomes 0 but for what scales make of it.

    Args:
        template: Axes and points of parts change.
        placement: Of the views that it was fitted to.
        directions: Candidates, both signs of which are tried.

    Returns:
        The same placements along the new axes.
    """
    state, shift = placement.state.clone(), placement.shift.clone()
    both = torch.cat([directions, -directions]).to(shift)
    for j, kind in enumerate(template.kinds):
        if kind != "prismatic":
            continue
        offset = shift[:, j] + state[:, j, None] * template.directions()[j]
        out = protrusion(template, placement, offset, j, both)
        low, high = OPEN
        spread = out.quantile(high, dim=0) - out.quantile(low, dim=0)
        if not spread.max() > 0:  # it comes out nowhere: the axis stays
            continue
        axis = both[spread.argmax()]
        middle = (offset @ axis).mean()
        weight = template.logit.softmax(-1)[:, j + 1, None]
        template.points.add_(weight * middle * axis)
        template.axis[j] = axis
        rest = offset - middle * axis * placement.log_scale.exp()
        state[:, j] = rest @ axis
        shift[:, j] = rest - state[:, j, None] * axis
    return replace(placement, state=state, shift=shift)


@torch.no_grad()
def seat_hinges(template: ArticulatedTemplate, placement: Placement) -> Placement:
    """Slide each hinge's pivot along its axis to where its part comes near it; axes of length 1.

    In place. Fits care where it is: about a pivot far from its part an axis cannot turn without
    moving the part, and a step turns a long axis little. Where axes deviate from object to object
    they turn about the pivot.

    Returns:
        The placements, where no part has moved: an object that is not as large along all directions
        of the frame takes a pivot aside that slides along an axis askew to them.
    """
    part, scale = template.logit.argmax(-1), placement.log_scale.exp()
    turns, shift = template.turns(placement), placement.shift.clone()
    for j, axis in enumerate(template.directions()):
        template.axis[j] = axis
        arm = template.points[part == j + 1] - template.pivot[j]
        if len(arm) and template.kinds[j] == "revolute":
            along = arm @ axis
            away = (arm - along[:, None] * axis).norm(dim=-1)
            slid = axis * along[away <= away.quantile(SEAT)].median()
            template.pivot[j] += slid
            moved = scale * slid
            shift[:, j] -= moved - (turns[:, j] @ moved[..., None])[..., 0]
    return replace(placement, shift=shift)


@torch.no_grad()
def principal_frame(normals: Float[Tensor, "K 3"]) -> Float[Tensor, "3 3"]:
    """Rows: the orthogonal directions that most normals follow (a Manhattan frame).

    Shapes without such directions get the best there is: any frame will do for them.
    """
    rotations = rotation_grid(FRAMES).to(normals)
    aligned = torch.stack([(normals @ r.T).abs().amax(-1) for r in rotations])
    return _settled(normals, rotations[torch.exp(-PICKED * (1 - aligned)).mean(-1).argmax()])


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
        frame = principal_frame(normals)
        told = _support(normals, frame)
    if told.sort().values[1] < TOLD:
        frame = _turned_to(frame, int(told.argmax()), template.directions()[0])
    for vectors in (template.points, template.normals, template.axis, template.pivot):
        vectors.copy_(vectors @ frame.T)
    return replace(
        placement,
        rotation=placement.rotation @ frame.T,
        shift=placement.shift @ frame.T,
        deviation=placement.deviation @ frame.T,
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
    for _ in range(SETTLING):
        projected = normals @ frame.T
        axis = projected.abs().argmax(-1)
        along = projected.gather(1, axis[:, None])
        weight = torch.exp(-SETTLED * (1 - along.abs())) * along.sign()
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
    if across.norm() < ASIDE:  # the axis is the held direction: nothing tells the others
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


@torch.no_grad()
def settle_hinges(
    template: ArticulatedTemplate, placement: Placement, *, touching: bool = False
) -> Placement:
    """Put every hinge where the observed motions of its part leave the least shift, in place.

    A part that turns about one axis and is then shifted across it has turned about another, which
    is parallel. While every object's hinge may sit elsewhere on its body, which of them is the
    category's is open: it is that about which the shifts of all views are smallest (robust least
    squares), with a constant displacement that the part's points take over.

    Args:
        template: Pivots and points of parts change.
        placement: Of the views that it was fitted to.
        touching: Where sizes differ between objects, and shifts with them, even that is nearly
            open. Of made things the two parts of a hinge touch at it: pull it there.

    Returns:
        The same motions as turns about the new hinges, with the shifts that are left.
    """
    shift, scale = placement.shift.clone(), placement.log_scale.exp()
    for j, kind in enumerate(template.kinds):
        if kind != "revolute":
            continue
        axis = template.directions()[j]
        turn = template.turns(placement)[:, j]
        lever = torch.eye(3).to(turn) - turn
        move = (lever @ (scale * template.pivot[j])[..., None])[..., 0] + shift[:, j]
        across = across_axis(axis)
        both = torch.cat([lever, turn], -1) * scale.repeat(1, 2)[:, None]
        column = across @ both @ torch.block_diag(across.T, across.T)
        goal = touch(template, j) if touching else template.pivot[j]
        start = torch.cat([across @ goal, torch.zeros(2).to(scale)])
        hold = torch.tensor([TOUCHING if touching else LOOSE] * 2 + [LOOSE] * 2).to(scale)
        found = _robust_least_squares(column, move @ across.T, start, hold)
        pivot, moved = found[:2] @ across, found[2:] @ across
        template.pivot[j] = pivot + (template.pivot[j] @ axis) * axis
        template.points.add_(template.logit.softmax(-1)[:, j + 1, None] * moved)
        left = move - (both @ torch.cat([template.pivot[j], moved])[:, None])[..., 0]
        shift[:, j] = left - (left @ axis)[:, None] * axis
    return replace(placement, shift=shift)


@torch.no_grad()
def touch(template: ArticulatedTemplate, joint: int) -> Float[Tensor, " 3"]:
    """The point across a hinge's axis to which its part and the base both come nearest.

    Both are seen along the axis, so where they overlap the hinge stays.
    """
    across = across_axis(template.directions()[joint])
    own, pivot = template.logit.argmax(-1), template.pivot[joint]
    seen = [template.points[own == label] @ across.T for label in (0, joint + 1)]
    if not all(map(len, seen)):
        return pivot
    steps = torch.arange(-TOUCH_REACH, TOUCH_REACH + TOUCH_STEP / 2, TOUCH_STEP).to(pivot)
    away = torch.cartesian_prod(steps, steps)
    cost = ASTRAY * away.square().sum(-1)
    for points in seen:
        count = max(1, round(NEAREST * len(points)))
        distance = torch.cdist(across @ pivot + away, points)
        cost = cost + distance.kthvalue(count, dim=1).values.square()
    return pivot + away[cost.argmin()] @ across


def _robust_least_squares(
    column: Float[Tensor, "B 2 D"],
    target: Float[Tensor, "B 2"],
    start: Float[Tensor, " D"],
    hold: Float[Tensor, " D"],
) -> Float[Tensor, " D"]:
    """The x of least sum of log(1 + |column x - target|^2 / SPREAD^2), held near its start."""
    found, hold = start, hold * len(target)
    for _ in range(REWEIGHTED):
        off = target - column @ found
        weight = 1 / (1 + (off / SPREAD).square().sum(-1))
        rows = column * weight[:, None, None]
        system = (rows.mT @ column).sum(0) + hold.diag()
        right = (rows.mT @ target[..., None]).sum(0)[:, 0] + hold * start
        found = torch.linalg.solve(system, right)
    return found
