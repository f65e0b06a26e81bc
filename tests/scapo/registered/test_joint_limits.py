# SPDX-License-Identifier: MIT
"""Of two ranges that explain the views alike the narrower is taken; outside is charged."""

from __future__ import annotations

import pytest
import torch

from scapo.registered.joint_limits import OUTSIDE_COST, JointLimits, limits_of, narrowest_limits
from scapo.registered.template import Placement
from tests.helpers.strategies import generator


def hypotheses(state: torch.Tensor) -> Placement:
    """Placements with these states (B, F) of one joint."""
    count = state.numel()
    turn = torch.eye(3).expand(count, 3, 3)
    return Placement.at(turn, torch.zeros(count, 3), state.reshape(-1, 1))


def test_a_mirrored_range_is_given_up():
    g = generator(0)
    true = 0.5 + 1.5 * torch.rand(200, generator=g)
    state = torch.stack([true, -true], 1)
    loss = 0.2 + 0.01 * torch.rand(200, 2, generator=g)
    chosen = narrowest_limits(hypotheses(state), loss, ("revolute",))
    one_side = chosen.low > 0.3 if chosen.high > 0 else chosen.high < -0.3
    assert bool(one_side)
    assert float(chosen.high - chosen.low) == pytest.approx(1.5, abs=0.25)


def test_a_range_that_nothing_else_explains_is_kept():
    state = torch.linspace(-1, 1, 100)[:, None].expand(-1, 2)
    loss = torch.tensor([0.2, 0.3]).expand(100, 2)
    chosen = narrowest_limits(hypotheses(state), loss, ("revolute",))
    assert float(chosen.low) == pytest.approx(-0.96, abs=0.12)
    assert float(chosen.high) == pytest.approx(0.96, abs=0.12)


def test_penalty_grid_and_room():
    states = JointLimits(
        low=torch.tensor([0.0, 0.0]), high=torch.tensor([1.0, 0.2]), unit=torch.tensor([1.0, 4.0])
    )
    charged = states.penalty(torch.tensor([[0.5, 0.1], [1.05, 0.1], [0.5, 0.21], [9.0, 0.1]]))
    assert charged.tolist() == pytest.approx([0.0, 0.1, 0.08, OUTSIDE_COST], abs=1e-6)
    assert states.wider(0.5).high.tolist() == pytest.approx([1.5, 0.3])
    assert states.grid(3)[1].tolist() == pytest.approx([0.0, 0.1, 0.2])
    assert states.extent(torch.tensor([0.5, 0.25])) == pytest.approx(0.5 + 0.25 * 4 * 0.2)
    assert limits_of(
        torch.linspace(0, 1, 101)[:, None], ("prismatic",)
    ).low.item() == pytest.approx(0.02)
