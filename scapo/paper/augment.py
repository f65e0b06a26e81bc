# SPDX-License-Identifier: MIT
"""Random poses of the input and the disturbances that a pose should survive (Sec. 3.1, VNT).

All on the device of the clouds, from one generator; clouds are (B, N, 3) in normalised units.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.points import farthest_points, gather
from scapo.geometry.rigid import random_rotations, rigid

Disturbance = Literal["noise", "spread", "crop", "resample"]
DISTURBANCES: tuple[Disturbance, ...] = ("noise", "spread", "crop", "resample")


def random_pose(
    batch: int, shift: float, generator: torch.Generator, like: Tensor
) -> Float[Tensor, "B 4 4"]:
    """Rotation uniform on SO(3), translation uniform in a cube of half side `shift`."""
    rotation = random_rotations(batch, generator, dtype=like.dtype)
    offset = torch.rand(batch, 3, generator=generator, dtype=like.dtype, device=like.device)
    return rigid(rotation, shift * (2 * offset - 1))


def disturb(
    points: Float[Tensor, "B N 3"], kind: Disturbance, generator: torch.Generator
) -> Float[Tensor, "B M 3"]:
    """A changed cloud with the same pose.

    noise: sigma 0.025. spread: thinned evenly to 300 to 500 points. crop: without the 100 points
    around one of them (a tenth of a smaller cloud). resample: drawn anew with replacement.
    """
    batch, number, _ = points.shape
    draw = {"generator": generator, "device": points.device}
    if kind == "noise":
        return points + 0.025 * torch.randn(points.shape, dtype=points.dtype, **draw)
    if kind == "spread":
        count = int(torch.randint(300, 501, (), **draw))
        return gather(points, farthest_points(points, min(count, number)))
    if kind == "resample":
        return gather(points, torch.randint(number, (batch, number), **draw))
    centre = gather(points, torch.randint(number, (batch, 1), **draw))
    distance = (points - centre).square().sum(-1)
    kept = distance.topk(number - min(100, number // 10), dim=1).indices
    return gather(points, kept.sort(1).values)
