# SPDX-License-Identifier: MIT
"""Two hinged plates, the smallest articulated object, as clouds with full labels."""

from __future__ import annotations

import torch
from torch import Tensor

from scapo.geometry.rigid import apply, joint_motion, random_rotations, rigid
from scapo.types import Joints, Labels, Observation
from tests.helpers.strategies import generator


def plates(count: int, points: int = 256, seed: int = 0) -> tuple[Observation, Labels]:
    """`count` clouds in the camera frame, metres: base 0, lid 1, hinge along x, 40 to 140 degrees.

    Width and depth vary; every cloud has a pose of its own about two metres from the camera.
    """
    g = generator(seed)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=g)

    flat = (
        between(-0.5, 0.5, points, 2)
        * torch.stack([between(0.8, 1.2), between(0.5, 0.8)], -1)[:, None]
    )
    depth = flat[..., 1:].amax(1, keepdim=True)
    closed = torch.cat([flat[..., :1], flat[..., 1:] + depth, torch.zeros(count, points, 1)], -1)
    part = (torch.rand(count, points, generator=g) < 0.5).long()
    pivot, axis = torch.zeros(count, 3), torch.tensor([1.0, 0, 0]).expand(count, 3)
    state = between(0.7, 2.4)
    opened = apply(joint_motion(pivot, axis, state, "revolute"), closed)
    posed = torch.where(part[..., None] == 1, opened, closed)
    shift = torch.tensor([0, 0, 2.0]) + 0.1 * torch.randn(count, 3, generator=g)
    camera_T_base = rigid(random_rotations(count, g), shift)
    camera_T_lid = camera_T_base @ joint_motion(pivot, axis, state, "revolute")
    joints = Joints(
        pivot=apply(camera_T_base, pivot[:, None]),
        axis=(camera_T_base[:, :3, :3] @ axis[..., None]).mT,
        state=state[:, None],
    )
    labels = Labels(
        part=part, camera_T_part=torch.stack([camera_T_base, camera_T_lid], 1), joints=joints
    )
    return Observation(points=apply(camera_T_base, posed)), labels
