# SPDX-License-Identifier: MIT
"""Steps: derivatives by a turn, the solution, held against a dense one, and its bound."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import roma
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations
from scapo.registered import axis_deviation, pairwise, pose_refinement
from scapo.registered.gauss_newton import bounded, by_turn, damped_step
from scapo.registered.pose_refinement import Motion, Skin
from scapo.registered.template import Placement
from tests.helpers.sighted import template
from tests.helpers.strategies import generator

Array = NDArray[Any]


def test_points_move_by_a_turn_as_differences_say():
    arm = torch.randn(2, 5, 3, generator=generator(0)).double()
    columns = by_turn(arm)
    for axis in range(3):
        turn = 1e-6 * torch.eye(3).double()[axis]
        moved = arm @ roma.rotvec_to_rotmat(turn).T
        assert_close((moved - arm) / 1e-6, columns[..., axis], atol=1e-5, rtol=0)


def dense_step(
    residual: Callable[[Array], Array], size: int, damping: Callable[[Array], Array]
) -> Array:
    """The least of |residual|^2 + damping . x^2, linear about 0: differences, dense, no sums.

    Args:
        residual: Of the coordinates, each term by the root of its weight.
        size: Of the coordinates.
        damping: By the diagonal of the system.
    """
    steps = 1e-6 * np.eye(size)
    rows = np.stack([(residual(step) - residual(-step)) / 2e-6 for step in steps], -1)
    added = np.diag(np.sqrt(damping((rows**2).sum(0))))
    right = np.concatenate([residual(np.zeros(size)), np.zeros(size)])
    return -np.linalg.lstsq(np.concatenate([rows, added]), right)[0]


def pulls(off: Array, normal: Array, across: Array, along: Array) -> Array:
    """Distances across the surface, then all, by the roots of their weights."""
    whole = off * np.sqrt(along)[:, None]
    return np.concatenate([(off * normal).sum(-1) * np.sqrt(across), whole.ravel()])


def cloud(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points at least 0.2 apart, unit normals, and points up to 0.04 beside them."""
    g = generator(seed)
    grid = torch.cartesian_prod(*[torch.arange(4.0).double() * 0.25 - 0.4] * 3)
    points = grid[torch.randperm(len(grid), generator=g)[:count]]
    normal, off = torch.randn(2, count, 3, generator=g).double()
    return points, F.normalize(normal, dim=-1), points + 0.02 * off.clamp(-1, 1)


def test_a_step_of_a_pair_is_that_of_dense_least_squares():
    points, normal, target = cloud(30, 1)
    weight = torch.rand(30, generator=generator(2)).double()
    turn, shift = pairwise.plane_step(points[None], target[None], normal[None], weight[None])

    def residual(x: Array) -> Array:
        off = Rotation.from_rotvec(x[:3]).apply(points.numpy()) + x[3:] - target.numpy()
        return pulls(off, normal.numpy(), weight.numpy(), pairwise.ALONG * weight.numpy())

    expected = dense_step(residual, 6, lambda d: np.full(6, pairwise.DAMPING * d.mean()))
    got = np.concatenate([Rotation.from_matrix(turn[0].numpy()).as_rotvec(), shift[0].numpy()])
    assert np.abs(expected[:3]).max() > 1e-3
    np.testing.assert_allclose(got, expected, atol=1e-8)


@pytest.mark.parametrize("reach", [0.0, 0.001])
def test_a_turn_of_a_part_is_that_of_dense_least_squares(reach: float):
    arms, normal, seen = cloud(30, 3)
    mine, eye = torch.arange(30)[None] < 24, torch.eye(3).double()[None]
    turned = axis_deviation._turn_onto(
        (seen[None], normal[None]), (arms[None], normal), eye, mine, reach
    )
    along = 1.0 if reach else axis_deviation.ALONG  # with means both count alike
    sharpness = axis_deviation.MEAN_SHARPNESS if reach else axis_deviation.SHARPNESS
    weight = np.exp(-sharpness * (arms - seen).square().sum(-1).numpy()) * mine[0].numpy()

    def residual(x: Array) -> Array:
        off = Rotation.from_rotvec(x).apply(arms.numpy()) - seen.numpy()
        return pulls(off, normal.numpy(), (1 - along) * weight, along * weight)

    expected = dense_step(residual, 3, lambda d: np.full(3, axis_deviation.DAMPING))
    assert 1e-3 < np.linalg.norm(expected) < axis_deviation.MOST_TURN
    got = Rotation.from_matrix(turned[0].numpy()).as_rotvec()
    np.testing.assert_allclose(got, expected, atol=1e-8)


def test_a_step_of_a_placement_is_that_of_dense_least_squares():
    """From the derivatives of each point, which the sums over parts' moments never form."""
    g = generator(4)
    made = template(count=40).double()
    turn, state = random_rotations(1, g).double(), torch.rand(1, 1, generator=g).double()
    here = Placement.at(turn, torch.zeros(1, 3).double(), state)
    skin, motion = Skin.of(made), Motion.of(made, here)
    normal, off = torch.randn(2, 1, 40, 3, generator=g).double()
    off, weight = 0.01 * off, torch.rand(1, 40, generator=g).double()
    every = torch.einsum("mq,qcd->mcd", skin.points, motion.jacobian[0]).detach().numpy()
    normal = F.normalize(normal, dim=-1)
    with torch.no_grad():
        system, gradient = pose_refinement._normal_equations(
            skin.points[None], motion, (off, normal, weight)
        )
        step = damped_step(system, gradient, torch.full_like(gradient, 0.2))

    def residual(x: Array) -> Array:
        share = weight[0].numpy()
        return pulls(
            off[0].numpy() + every @ x, normal[0].numpy(), share, pose_refinement.ALONG * share
        )

    expected = dense_step(residual, every.shape[-1], lambda d: np.full_like(d, 0.2))
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(step[0].numpy(), expected, atol=1e-8)


def test_long_steps_are_shortened_and_others_stay():
    step = torch.tensor([[0.3, 0.4, 0.0], [0.0, 0.0, 0.1]])
    assert_close(bounded(step, 0.25), torch.tensor([[0.15, 0.2, 0.0], [0.0, 0.0, 0.1]]))
