# SPDX-License-Identifier: MIT
"""Mirror images: of a base that lacks a side, and of one of two parts of one kind for the other.

Made things are mostly symmetric. Of what the first views did not show, or of a part that they mixed
up with its like, the mirror image through the middle of the base is a guess, which a round of
search and fit then proves.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.points import ends
from scapo.registered.bundle_adjustment import Candidate
from scapo.registered.template import ArticulatedTemplate, spread_out, surface_features


@torch.no_grad()
def mirrored(template: ArticulatedTemplate, axis: int) -> ArticulatedTemplate:
    """The template with the mirror image of its base added, with as many points as before.

    Args:
        template: Its parts and joints stay.
        axis: Of the template's frame, normal of the plane through the middle of the base (`ends`).
    """
    base = template.logit.argmax(-1) == 0
    image = _reflected(template, template.points[base], axis)
    return _with_surface(
        template,
        torch.cat([template.points, image]),
        torch.cat([template.normals, template.normals[base] * _across(template, axis)]),
        torch.cat([template.logit, template.logit[base]]),
    )


@torch.no_grad()
def paired(candidate: Candidate, joint: int, axis: int) -> Candidate:
    """The candidate with the mirror image of one part, and of its joint, in place of the other.

    Args:
        candidate: Of two joints of one kind.
        joint: Whose part is mirrored.
        axis: Of the template's frame, normal of the plane through the middle of the base (`ends`).
    """
    template, other = candidate.template, 1 - joint
    part, swapped = template.logit.argmax(-1), [0, 2, 1]
    own, kept, across = part == joint + 1, part != other + 1, _across(template, axis)
    made = _with_surface(
        template,
        torch.cat([template.points[kept], _reflected(template, template.points[own], axis)]),
        torch.cat([template.normals[kept], template.normals[own] * across]),
        torch.cat([template.logit[kept], template.logit[own][:, swapped]]),
    )
    made.pivot[other] = _reflected(template, template.pivot[joint, None], axis)[0]
    way = -1.0 if template.kinds[joint] == "revolute" else 1.0  # turns are mirrored the other way
    made.axis[other] = way * template.axis[joint] * across
    placement = candidate.inliers.placement
    state, shift = placement.state.clone(), placement.shift.clone()
    state[:, other] = state[:, joint].roll(1)  # states that occur, of other views
    shift[:, other] = 0
    inliers = replace(candidate.inliers, placement=replace(placement, state=state, shift=shift))
    return replace(candidate, template=made, inliers=inliers)


def _with_surface(
    template: ArticulatedTemplate,
    points: Float[Tensor, "M 3"],
    normals: Float[Tensor, "M 3"],
    logit: Float[Tensor, "M P"],
) -> ArticulatedTemplate:
    """Another template of these points, as many as it has, spread out."""
    index = spread_out(surface_features(points, normals, logit.softmax(-1)), len(template.points))
    made = template.with_points(len(index))
    made.assign(points[index], normals[index], logit[index])
    return made


def _across(template: ArticulatedTemplate, axis: int) -> Float[Tensor, " 3"]:
    return 1 - 2 * torch.eye(3).to(template.points)[axis]


def _reflected(
    template: ArticulatedTemplate, points: Float[Tensor, "K 3"], axis: int
) -> Float[Tensor, "K 3"]:
    """Mirror images through the middle of the base."""
    base = template.points[template.logit.argmax(-1) == 0]
    if not len(base):
        return points
    twice = ends(base[:, axis]).sum()
    return points * _across(template, axis) + twice * torch.eye(3).to(base)[axis]
