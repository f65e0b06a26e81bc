# SPDX-License-Identifier: MIT
"""Mirror images: of a base that lacks a side, and of one of two parts of one kind for the other.

Made things are mostly symmetric. Of what the first views did not show, or of a part that they mixed
up with its like, the mirror image through the middle of the base is a guess, which a round of
search and fit then proves.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.registered.bundle_adjustment import Candidate
from scapo.registered.motion_segmentation import TAKEN
from scapo.registered.template import SPAN, ArticulatedTemplate, spread_out, surface_features

MIDDLES = 200  # States of a part among which is sought where it lies in the mirror plane
BEYOND = 0.15
"""Share of the views, at least, in which a part lies beyond that plane that was taken for two."""


@torch.no_grad()
def mirrored(template: ArticulatedTemplate, axis: int) -> ArticulatedTemplate:
    """The template with the mirror image of its base added, with as many points as before.

    Args:
        template: Its parts and joints stay.
        axis: Of the template's frame, normal of the plane through the middle of the base (`SPAN`).
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
def paired(candidate: Candidate, joint: int, axis: int, *, body: bool = False) -> Candidate:
    """The candidate with the mirror image of one part, and of its joint, in place of the other.

    Args:
        candidate: Of two joints of one kind.
        joint: Whose part is mirrored.
        axis: Of the template's frame, normal of the plane through the middle of the base (`SPAN`).
        body: Whether the other is left to the base, a piece of which it was.
    """
    template, other = candidate.template, 1 - joint
    part, swapped = template.logit.argmax(-1), [0, 2, 1]
    own, lost, across = part == joint + 1, part == other + 1, _across(template, axis)
    kept, logit = ~lost | body, template.logit.clone()
    logit[lost, 0] = logit[lost].amax(-1) + TAKEN
    made = _with_surface(
        template,
        torch.cat([template.points[kept], _reflected(template, template.points[own], axis)]),
        torch.cat([template.normals[kept], template.normals[own] * across]),
        torch.cat([logit[kept], logit[own][:, swapped]]),
    )
    made.pivot[other] = _reflected(template, template.pivot[joint, None], axis)[0]
    way = -1.0 if template.kinds[joint] == "revolute" else 1.0  # turns are mirrored the other way
    made.axis[other] = way * template.axis[joint] * across
    placement = candidate.inliers.placement
    state, shift = placement.state.clone(), placement.shift.clone()
    state[:, joint], state[:, other] = divided(template, state[:, joint], joint, axis)
    shift[:, other] = 0
    inliers = replace(candidate.inliers, placement=replace(placement, state=state, shift=shift))
    return replace(candidate, template=made, inliers=inliers)


@torch.no_grad()
def divided(
    template: ArticulatedTemplate, state: Float[Tensor, " B"], joint: int, axis: int
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """States of a part, and of its mirror image, where it may have been taken for both.

    Two handles that meet in the middle are alike: one that explains either leaves nothing to the
    other, and goes twice as far. Where it lies beyond the mirror plane it was the other, turned
    likewise to its own side. What a view does not tell are states of other views.

    Args:
        template: Before there is the mirror image.
        state: Of the part in B views.
        joint: That moves it.
        axis: Of the template's frame, normal of the plane (`SPAN`).
    """
    if template.kinds[joint] == "prismatic":
        return state, state.roll(1)
    part = template.points[template.logit.argmax(-1) == joint + 1]
    if not len(part):
        return state, state.roll(1)
    arm = (part - template.pivot[joint]).mean(0)
    tried = torch.cat([state, torch.linspace(float(state.min()), float(state.max()), MIDDLES)])
    turn = rotvec_to_rotmat(template.directions()[joint] * tried[:, None])
    centre = template.pivot[joint] + (turn @ arm[:, None])[..., 0]
    off = (centre - _reflected(template, centre, axis))[:, axis]
    side, grid = off[: len(state)], off[len(state) :]
    beyond = side * side.median() < 0
    if float(beyond.float().mean()) < BEYOND:
        return state, state.roll(1)
    middle = tried[len(state) :][grid.abs().argmin()]
    own, others = state[~beyond], 2 * middle - state[beyond]
    return _filled(state, ~beyond, own), _filled(state, beyond, others)


def _filled(
    like: Float[Tensor, " B"], rows: Bool[Tensor, " B"], known: Float[Tensor, " K"]
) -> Float[Tensor, " B"]:
    """What is known in some rows, and in the others what others know, in turn."""
    made = known[torch.arange(len(like)) % len(known)]
    made[rows] = known
    return made


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
    ends = base[:, axis].quantile(torch.tensor(SPAN).to(base)).sum()
    return points * _across(template, axis) + ends * torch.eye(3).to(base)[axis]
