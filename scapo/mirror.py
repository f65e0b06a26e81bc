# SPDX-License-Identifier: MIT
"""Sides of the body that no view has built yet, by mirror symmetry.

The views that agree first may all show the same side. Views of the other side then find nothing
that explains it, are turned until they look like the first ones, and so never build it. Bodies of
made things are mostly symmetric: the base together with its mirror image is a start to be judged
against the one without, after both went through a round (`discovery.completed`).
"""

from __future__ import annotations

import torch

from scapo.part_evidence import farthest_features, surface_features
from scapo.template import ArticulatedTemplate


@torch.no_grad()
def mirrored(template: ArticulatedTemplate, axis: int) -> ArticulatedTemplate:
    """The template with the mirror image of its base added, with as many points as before.

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
    points = torch.cat([template.points, points])
    normals = torch.cat([template.normals, normals])
    logit = torch.cat([template.logit, template.logit[base]])
    feature = surface_features(points, normals, logit.softmax(-1))
    index = farthest_features(feature, len(template.points))
    made = template.with_points(len(index))
    made.assign(points[index], normals[index], logit[index])
    return made
