# SPDX-License-Identifier: MIT
"""Steps: derivatives by a turn, the damped solution, and its bound."""

from __future__ import annotations

import roma
import torch
from torch.testing import assert_close

from scapo.registered.gauss_newton import bounded, by_turn, damped_step
from tests.helpers.strategies import generator


def test_points_move_by_a_turn_as_differences_say():
    arm = torch.randn(2, 5, 3, generator=generator(0)).double()
    columns = by_turn(arm)
    for axis in range(3):
        turn = 1e-6 * torch.eye(3).double()[axis]
        moved = arm @ roma.rotvec_to_rotmat(turn).T
        assert_close((moved - arm) / 1e-6, columns[:, :, axis], atol=1e-5, rtol=0)


def test_without_damping_the_step_is_that_of_least_squares():
    g = generator(1)
    rows, right = torch.randn(4, 9, 5, generator=g), torch.randn(4, 9, 1, generator=g)
    system, gradient = rows.mT @ rows, (rows.mT @ right)[..., 0]
    expected = -torch.linalg.lstsq(rows, right).solution[..., 0]
    assert_close(damped_step(system, gradient, torch.zeros(4, 5)), expected, atol=1e-4, rtol=1e-3)
    damped = damped_step(system, gradient, torch.full((4, 1), 1e4))
    assert_close(damped, -1e-4 * gradient, atol=1e-5, rtol=1e-2)


def test_long_steps_are_shortened_and_others_stay():
    step = torch.tensor([[0.3, 0.4, 0.0], [0.0, 0.0, 0.1]])
    assert_close(bounded(step, 0.25), torch.tensor([[0.15, 0.2, 0.0], [0.0, 0.0, 0.1]]))
