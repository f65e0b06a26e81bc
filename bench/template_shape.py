# SPDX-License-Identifier: MIT
"""The template of a trained method: its points, parts and joints, and how its joints move it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from scapo import geometry
from scapo.method import AbstractMethod
from scapo.model import Scapo
from scapo.registered import RegisteredScapo
from scapo.template import Placement


@dataclass(frozen=True, slots=True, kw_only=True)
class TemplateShape:
    """In the frame of the predicted base pose; lengths in 4 x mean radius."""

    points: Float[np.ndarray, "M 3"]
    weight: Float[np.ndarray, "M P"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    normals: Float[np.ndarray, "M 3"] | None = None
    """Unit, where the method has them."""


def template_shape(method: AbstractMethod) -> TemplateShape | None:
    """The template at the states that the method calls 0; None for a method without one."""
    with torch.no_grad():
        if isinstance(method, RegisteredScapo):
            return _registered(method)
        if isinstance(method, Scapo):
            return _scapo(method)
    return None


def _registered(method: RegisteredScapo) -> TemplateShape:
    template = method.template
    origin, none = template.part_centres()[0], torch.zeros_like(template.points[:1])
    at_rest = Placement.at(torch.eye(3).to(none)[None], none, template.rest[None])
    points, normals = template.place(at_rest)
    return TemplateShape(
        points=_plain(points[0] - origin),
        weight=_plain(template.logit.softmax(-1)),
        pivot=_plain(template.pivot - origin),
        axis=_plain(template.directions()),
        normals=_plain(normals[0]),
    )


def _scapo(method: Scapo) -> TemplateShape:
    """Y_base without residual; its joints as the joint network sees them."""
    points, keypoints = method.template.points[None], method.template.keypoints[None]
    _, joints = method.joint_network.pair(points, points)
    return TemplateShape(
        points=_plain(points[0]),
        weight=_plain(method.bones.weights(points, keypoints)[0]),
        pivot=_plain(joints.pivot[0]),
        axis=_plain(torch.nn.functional.normalize(joints.axis[0], dim=-1)),
    )


def _plain(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().numpy().astype(np.float64)


def carried(shape: TemplateShape, pose: Float[np.ndarray, "4 4"]) -> TemplateShape:
    """The shape in another frame, `pose` mapping its own there."""
    turn, shift = pose[:3, :3], pose[:3, 3]
    return replace(
        shape,
        points=shape.points @ turn.T + shift,
        pivot=shape.pivot @ turn.T + shift,
        axis=shape.axis @ turn.T,
        normals=None if shape.normals is None else shape.normals @ turn.T,
    )


def at_states(
    shape: TemplateShape, state: Float[np.ndarray, " J"], revolute: np.ndarray
) -> TemplateShape:
    """The shape with its joints moved: rad, or 4 x mean radius; parts blended by weight."""
    points, normals = shape.weight[:, :1] * shape.points, None
    if shape.normals is not None:
        normals = shape.weight[:, :1] * shape.normals
    for joint, turns in enumerate(revolute):
        motion = geometry.joint_motion(
            torch.from_numpy(shape.pivot[joint].copy()),
            torch.from_numpy(shape.axis[joint].copy()),
            torch.tensor(float(state[joint]), dtype=torch.float64),
            "revolute" if turns else "prismatic",
        ).numpy()
        share = shape.weight[:, joint + 1 : joint + 2]
        points = points + share * (shape.points @ motion[:3, :3].T + motion[:3, 3])
        if normals is not None and shape.normals is not None:
            normals = normals + share * (shape.normals @ motion[:3, :3].T)
    return replace(shape, points=points, normals=normals)
