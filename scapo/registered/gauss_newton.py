# SPDX-License-Identifier: MIT
"""The core of all Gauss-Newton steps: derivatives by a turn, one damped solve, a bounded step.

Pairs of views (`pairwise`), placements (`pose_refinement`) and single parts (`axis_deviation`) set
up their own normal equations, of distances across the surface and, with less weight, along it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def by_turn(arm: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3 3"]:
    """What a small turn about each coordinate axis (row) moves points by, `arm` off the centre."""
    eye = torch.eye(3).to(arm).expand(*arm.shape, 3)
    return torch.linalg.cross(eye, arm[:, :, None].expand_as(eye))


def damped_step(
    system: Float[Tensor, "*B D D"],
    gradient: Float[Tensor, "*B D"],
    damping: Float[Tensor, "*B #D"],
) -> Float[Tensor, "*B D"]:
    """The step -(system + diag(damping))^-1 gradient."""
    damped = system + torch.diag_embed(damping.expand_as(gradient))
    return -torch.linalg.solve(damped, gradient)


def bounded(step: Float[Tensor, "*B D"], length: float) -> Float[Tensor, "*B D"]:
    """The step, shortened where it is longer: matches hold near the present place only."""
    return step * (length / step.norm(dim=-1, keepdim=True).clamp_min(length))
