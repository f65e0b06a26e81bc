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


CELLS, WIDTH, BEHIND = 10, 1.2, 0.06
"""Of a camera's image along either side, its width, and how far behind what a cell shows a point
is hidden; normalised lengths. A shape of a few hundred points has some in every cell."""


@torch.no_grad()
def one_side(
    points: Float[Tensor, "B N 3"], count: int, generator: torch.Generator
) -> Float[Tensor, "B {count} 3"]:
    """So many of the points that a camera far away sees, in a random direction for each cloud.

    They are drawn with replacement and stay where they are.
    """
    batch, _, _ = points.shape
    turn = random_rotations(batch, generator, dtype=points.dtype)
    seen = points @ turn.mT
    cell = ((seen[..., :2] / WIDTH + 0.5) * CELLS).floor().clamp(0, CELLS - 1).long()
    index = cell[..., 0] * CELLS + cell[..., 1]
    depth = seen[..., 2]
    nearest = torch.full((batch, CELLS**2), torch.inf, dtype=points.dtype, device=points.device)
    nearest = nearest.scatter_reduce(1, index, depth, "amin")
    shown = depth <= nearest.gather(1, index) + BEHIND
    return gather(points, torch.multinomial(shown.float(), count, True, generator=generator))
