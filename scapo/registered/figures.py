# SPDX-License-Identifier: MIT
"""What the registered method shows of its training: the template, and where it puts it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.pictures import Panel, PictureData
from scapo.registered.joint_limits import JointLimits
from scapo.registered.template import ArticulatedTemplate, Placement


def template_pictures(
    template: ArticulatedTemplate,
    limits: JointLimits,
    clouds: Float[Tensor, "B K 3"],
    placement: Placement,
) -> dict[str, PictureData]:
    """The template over its range of states, and placed on clouds.

    Args:
        template: Found.
        limits: Of the inliers' states.
        clouds: Normalised.
        placement: Of the clouds, as the network votes.
    """
    part = template.logit.argmax(-1)
    grid = limits.grid(3).T
    turn = torch.eye(3).to(clouds).expand(len(grid), 3, 3)
    poses = Placement.at(turn, clouds.new_zeros(len(grid), 3), grid)
    pivot, axis = template.joints_in_view(poses)
    opened = tuple(
        Panel(points=points, part=part, pivot=p, axis=a)
        for points, p, a in zip(template.place(poses)[0], pivot, axis, strict=True)
    )
    canonical = (clouds - placement.translation[:, None]) @ placement.rotation
    aligned = tuple(Panel(points=template.points, part=part, beneath=cloud) for cloud in canonical)
    placed = template.place(placement)[0]
    fitted = tuple(
        Panel(points=points, part=part, beneath=cloud)
        for points, cloud in zip(placed, clouds, strict=True)
    )
    return {
        "template": PictureData(
            panels=opened, caption="the template at its lowest, middle and highest states"
        ),
        "canonical": PictureData(
            panels=aligned, caption="clouds (grey) in the base's frame, under the template"
        ),
        "reconstruction": PictureData(
            panels=fitted, caption="the placed template over the observed cloud (grey)"
        ),
    }
