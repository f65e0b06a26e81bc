# SPDX-License-Identifier: MIT
"""Sides of the body that no view has built yet, by mirror symmetry.

The views that agree first may all show the same side. Views of the other side then find nothing
that explains it, are turned until they look like the first ones, and so never build it. Bodies of
made things are mostly symmetric: the base together with its mirror image is tried, and whether it
explains other views better is for the caller to ask.
"""

from __future__ import annotations

import torch

from scapo.part_evidence import farthest_features
from scapo.template import ArticulatedTemplate


@torch.no_grad()
def mirrored(template: ArticulatedTemplate, axis: int) -> ArticulatedTemplate:
    """The template with the mirror image of its base added, as dense as it was.

    Args:
        template: Its parts and joints stay.
        axis: Of the template's frame, normal of the plane through the middle of the base (2 to
            98 % of its points).
    """
    base = template.logit.argmax(-1) == 0
    points, normals = template.points[base].clone(), template.normals[base].clone()
    if len(points):
        ends = torch.tensor([0.02, 0.98]).to(points)
        points[:, axis] = points[:, axis].quantile(ends).sum() - points[:, axis]
        normals[:, axis] = -normals[:, axis]
    return _with(
        template,
        torch.cat([template.points, points]),
        torch.cat([template.normals, normals]),
        torch.cat([template.logit, template.logit[base]]),
    )


@torch.no_grad()
def thinned(template: ArticulatedTemplate, count: int) -> ArticulatedTemplate:
    """The template with at most `count` of its points, spread over surface, normals and parts."""
    features = [template.points, 0.06 * template.normals, 0.1 * template.logit.softmax(-1)]
    index = farthest_features(torch.cat(features, -1), min(count, len(template.points)))
    return _with(template, template.points[index], template.normals[index], template.logit[index])


def _with(
    template: ArticulatedTemplate,
    points: torch.Tensor,
    normals: torch.Tensor,
    logit: torch.Tensor,
) -> ArticulatedTemplate:
    """Other points (M, 3) with normals and part logits (M, P), the same joints."""
    made = ArticulatedTemplate(template.kinds, len(points)).to(points)
    made.assign(points, normals, logit)
    made.axis.copy_(template.axis)
    made.pivot.copy_(template.pivot)
    return made
