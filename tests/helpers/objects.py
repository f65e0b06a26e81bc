# SPDX-License-Identifier: MIT
"""Objects of one kind in several views, with all labels: what fused templates are made from.

Each is a box with a part on it, the same shape stretched along its axes: a flap on a hinge, or a
drawer, which sits at another height in each. Views leave out what faces away.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.rigid import apply, joint_motion, random_rotations, rigid
from scapo.types import Joints, Labels, Observation
from tests.helpers.sighted import AXIS, PIVOT, surface
from tests.helpers.sliding import DRAWER, OUT, UP, cabinet
from tests.helpers.strategies import generator

OPEN = {"revolute": (0.2, 1.2), "prismatic": (0.05, 0.2)}
"""States of the views."""


@dataclass(frozen=True)
class Objects:
    """K objects, V views of each, one object after the other."""

    observation: Observation
    labels: Labels
    stretch: Tensor
    """(K, 3) of each object against the shape that they share."""
    height: Tensor
    """(K,) of the drawer on the body, before the stretch; 0 for a flap."""
    surfaces: list[tuple[Tensor, Tensor]]
    """Many points of each object at rest, and their parts."""


def objects(
    count: int, views: int, *, kind: JointKind = "revolute", points: int = 400, seed: int = 0
) -> Objects:
    """The objects, in frames whose origin all share."""
    g = generator(seed)
    stretch = torch.exp(0.2 * torch.randn(count, 3, generator=g))
    height = (
        0.3 * torch.rand(count, generator=g) - 0.15 if kind == "prismatic" else torch.zeros(count)
    )
    clouds, labels, surfaces = [], [], []
    for k in range(count):
        shape, normals, part = _shape(kind, float(height[k]), 1000 * seed + k)
        rest, normals = shape * stretch[k], normals / stretch[k]
        surfaces.append((rest, part))
        for _ in range(views):
            cloud, label = _view((rest, normals, part), stretch[k], kind, points, g)
            clouds.append(cloud)
            labels.append(label)
    joined = Labels(
        part=torch.stack([one["part"] for one in labels]),
        camera_T_part=torch.stack([one["pose"] for one in labels]),
        joints=Joints(
            pivot=torch.stack([one["pivot"] for one in labels]),
            axis=torch.stack([one["axis"] for one in labels]),
            state=torch.stack([one["state"] for one in labels]),
        ),
        instance=10 + torch.arange(count).repeat_interleave(views),
    )
    return Objects(
        observation=Observation(points=torch.stack(clouds)),
        labels=joined,
        stretch=stretch,
        height=height,
        surfaces=surfaces,
    )


def _shape(kind: JointKind, height: float, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    if kind == "revolute":
        return surface(6000, seed)
    made = cabinet(OUT, seed, 6000)
    part = made.logit.detach().argmax(-1)
    points = made.points.detach() - 0.02 * (part == 1)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    return points + height * (part == 1)[:, None] * UP, made.normals, part


def _view(
    shape: tuple[Tensor, Tensor, Tensor],
    stretch: Tensor,
    kind: JointKind,
    points: int,
    g: torch.Generator,
) -> tuple[Tensor, dict[str, Tensor]]:
    """A cloud in the camera's frame, from in front of the moving part, and its labels."""
    rest, normals, part = shape
    low, high = OPEN[kind]
    state = low + (high - low) * torch.rand(1, generator=g)
    axis, pivot = (AXIS, PIVOT * stretch) if kind == "revolute" else (OUT, -DRAWER * stretch)
    motion = joint_motion(pivot, axis, state[0], kind)
    away = torch.tensor([-1.5, 0.0, 1.0]) + 0.5 * torch.randn(3, generator=g)
    turn = random_rotations(1, g)[0]
    camera_T_base = rigid(turn, -2.0 * turn @ torch.nn.functional.normalize(away, dim=0))
    pose = torch.stack([camera_T_base, camera_T_base @ motion])
    cloud = torch.where((part == 1)[:, None], apply(pose[1], rest), apply(pose[0], rest))
    facing = torch.where(
        (part == 1)[:, None], normals @ pose[1, :3, :3].T, normals @ pose[0, :3, :3].T
    )
    seen = ((cloud * facing).sum(-1) < 0).nonzero()[:, 0]
    kept = seen[torch.randperm(len(seen), generator=g)[:points]]
    return cloud[kept], {
        "part": part[kept],
        "pose": pose,
        "pivot": apply(pose[0], pivot[None]),
        "axis": (turn @ axis)[None],
        "state": state,
    }
