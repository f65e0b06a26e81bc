# SPDX-License-Identifier: MIT
"""The core of all Gauss-Newton steps: the normal equations, one damped solve, a bounded step.

Pairs of views (`pairwise`) and single parts (`axis_deviation`) minimise distances of points across
the surface and, with less weight, all of them (`point_equations`). Placements (`pose_refinement`)
have many coordinates and few parts: there the second sum is over parts' moments.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.rigid import skew_matrix


def by_turn(arm: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3 3"]:
    """What a small turn about each coordinate axis (column) moves points by, `arm` off the centre.

    Column a is e_a x arm.
    """
    return skew_matrix(-arm)


def weighted_equations(
    rows: Float[Tensor, "B N D"], residual: Float[Tensor, "B N"], weight: Float[Tensor, "B N"]
) -> tuple[Float[Tensor, "B D D"], Float[Tensor, "B D"]]:
    """System and gradient of half the sum of weight (residual + rows x)^2 at x = 0."""
    system = (rows * weight[..., None]).mT @ rows
    return system, (rows.mT @ (residual * weight)[..., None])[..., 0]


def point_equations(
    jacobian: Float[Tensor, "B N 3 D"],
    off: Float[Tensor, "B N 3"],
    normal: Float[Tensor, "B N 3"],
    across: Float[Tensor, "B N"],
    along: Float[Tensor, "B N"],
) -> tuple[Float[Tensor, "B D D"], Float[Tensor, "B D"]]:
    """System and gradient of half the sum of across (n . d)^2 + along |d|^2, d = off + J x.

    Args:
        jacobian: J, what each of the D coordinates x moves a point by.
        off: Point minus target.
        normal: n, the target's.
        across: Weight of the distance across the target's surface.
        along: Weight of the distance, whatever its direction.
    """
    rows, residual = (normal[:, :, None] @ jacobian)[:, :, 0], (off * normal).sum(-1)
    system, gradient = weighted_equations(rows, residual, across)
    more = weighted_equations(
        jacobian.flatten(1, 2), off.flatten(1), along.repeat_interleave(3, -1)
    )
    return system + more[0], gradient + more[1]


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
