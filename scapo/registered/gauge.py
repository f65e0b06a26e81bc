# SPDX-License-Identifier: MIT
"""Which of a part's translations is its joint's: the one that takes it out of the body.

A part without rotation differs from view to view by a translation, for two reasons: its joint is
open by some amount, and in each instance it sits elsewhere on the body (one of several drawers of
a cabinet). Single views do not tell the two apart, and the second may be the larger. But a part
that moves leaves the body's outline, while where it sits is within. So the whole translation is
free while the template is fitted, and the main direction along which the part comes out of the body
is made the joint's axis; what remains is the instance's shift.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.registered.template import ArticulatedTemplate, Placement

EDGE = 0.97
"""Quantile of points that counts as the end of a body: single points say little."""


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
        spread = out.quantile(0.9, dim=0) - out.quantile(0.1, dim=0)
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
