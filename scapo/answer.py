# SPDX-License-Identifier: MIT
"""What a trained method says of clouds, by the category's conventions, and at which side a door is.

A method that learned doors hinged at one side takes one that is hinged at the other for such a door
upside down: joint and parts are right, the object's frame is not, and where it is told which way is
up nothing is. There the cloud's mirror image is asked as well, in which the door hangs as in
training; if that is explained better, its answer is mirrored back.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from scapo.alignment import Alignment, unit_length
from scapo.method import AbstractMethod, Mode
from scapo.records import either
from scapo.types import Observation, Prediction

ASIDE = (-1.0, 1.0, 1.0)
"""The mirror of clouds, in their frame; a camera at its origin stays."""
ACROSS = (1.0, -1.0, 1.0)
"""That of objects, in theirs: left and right change places."""
STANDS = 0.9
"""Cosine with up from which a hinge is upright."""
BETTER = 0.95
"""Share of the misfit that the other side has to be below: what training has is likelier."""


def answered(
    method: AbstractMethod,
    observation: Observation,
    mode: Mode,
    alignment: Alignment | None,
) -> Prediction:
    """What a method says of B clouds.

    Args:
        method: Which knows its `up` where clouds have one.
        observation: Camera frame, metres.
        mode: Of prediction.
        alignment: To the category's conventions; None: the method's own, and one side alone.
    """
    found = _aligned(method, observation, mode, alignment)
    both = observation.up is not None and alignment is not None and hangs_aside(method)
    if not both or found.misfit is None:
        return found
    other = mirrored(_aligned(method, _mirror_image(observation), mode, alignment))
    assert other.misfit is not None  # noqa: S101 - as the other has
    return either(other.misfit < BETTER * found.misfit, other, found)


def hangs_aside(method: AbstractMethod) -> bool:
    """Whether its objects have one upright hinge, which is at one side of them."""
    axes, category = method.axes(), method.category
    if axes is None or method.up is None or category.symmetry is not None:
        return False
    upright = len(axes) == 1 and abs(float(axes[0] @ axes.new_tensor(method.up))) > STANDS
    return upright and category.joints[0].kind == "revolute"


def mirrored(found: Prediction) -> Prediction:
    """The answer to a cloud whose mirror image was asked, where the joints are hinges.

    A mirror turns the sense of a rotation: axes are reflected and point the other way.
    """
    pose, joints, shape = found.camera_T_part, found.joints, found.canonical_points
    aside, across = _mirror(ASIDE, found.part_weight), _mirror(ACROSS, found.part_weight)
    if pose is not None:
        pose = pose.clone()
        pose[..., :3, :3] *= aside[:, None] * across
        pose[..., :3, 3] *= aside
    if joints is not None:
        joints = replace(joints, pivot=aside * joints.pivot, axis=-aside * joints.axis)
    normals = found.canonical_normals
    return replace(
        found,
        camera_T_part=pose,
        joints=joints,
        canonical_points=None if shape is None else across * shape,
        canonical_normals=None if normals is None else across * normals,
    )


def _aligned(
    method: AbstractMethod, observation: Observation, mode: Mode, alignment: Alignment | None
) -> Prediction:
    found = method.predict(observation, mode)
    if alignment is None:
        return found
    return alignment.apply(found, unit_length(observation.points), method.category)


def _mirror_image(observation: Observation) -> Observation:
    points, sensor, up = observation.points, observation.sensor, observation.up
    aside = _mirror(ASIDE, points)
    return replace(
        observation,
        points=aside * points,
        sensor=None if sensor is None else aside * sensor,
        up=None if up is None else aside * up,
    )


def _mirror(signs: tuple[float, ...], like: Tensor) -> Tensor:
    return torch.tensor(signs, dtype=like.dtype, device=like.device)
