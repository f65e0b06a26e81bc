# SPDX-License-Identifier: MIT
"""States of views of one object from pairs of them, and which points have them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.registered.joint_proposals import JointProposal, PosedViews
from scapo.registered.view_states import apart, motion_of, synchronised_states
from tests.helpers.sighted import AXIS, PIVOT, sighted
from tests.helpers.strategies import generator

JOINT = JointProposal(axis=AXIS, pivot=PIVOT, score=1.0)


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_states_are_those_whose_differences_score_most(wrong: float) -> None:
    """Peaks at the true differences; in some pairs a higher one elsewhere."""
    g, count, most = generator(0), 12, 24
    true = torch.randint(0, most, (count,), generator=g)
    off = true - true[:, None]
    table = 0.2 * torch.rand(count, count, 2 * most + 1, generator=g)
    table.scatter_(2, off[..., None] + most, 1.0)
    elsewhere = torch.randint(0, 2 * most + 1, (count, count, 1), generator=g)
    misled = (torch.rand(count, count, 1, generator=g) < wrong).float()
    table.scatter_add_(2, elsewhere, 1.5 * misled)
    state, score = synchronised_states(table, 0.5)
    assert torch.equal(state - state[0], 0.5 * (true - true[0]))
    assert score > 0.9


def test_views_of_which_nothing_is_known_stay_where_they_are() -> None:
    state, score = synchronised_states(torch.zeros(6, 6, 49), 0.5)
    assert torch.equal(state, torch.zeros(6))
    assert score == 0


def test_nothing_that_moved_is_no_motion() -> None:
    views, truth = sighted(5, seed=7)
    scene = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    found = motion_of(scene, torch.zeros(5, 128, dtype=torch.bool), JOINT, "revolute")
    assert torch.equal(found.state, torch.zeros(5))
    assert found.score == 0


def test_the_flap_and_its_states_are_found_where_its_hinge_is_known() -> None:
    views, truth = sighted(12, seed=7)
    scene = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    points, _ = scene.world(128)
    inside = ((points - torch.tensor([0.0, 0, 0])).abs() < torch.tensor([0.21, 0.29, 0.17])).all(-1)
    anything = torch.rand(inside.shape, generator=generator(1)) < 0.1
    found = motion_of(scene, ~inside | anything, JOINT, "revolute")
    true = truth.state[:, 0] - truth.state[:, 0].mean()
    assert float((found.state - found.state.mean() - true).abs().median()) < 0.08
    assert float((found.moved & ~inside).sum() / found.moved.sum()) > 0.8
    assert 0.3 < found.score <= 1
    back, _ = found.back(scene, JOINT, "revolute")
    flap = back[found.moved & ~inside] - PIVOT
    assert float(torch.linalg.svdvals(flap)[-1] / len(flap) ** 0.5) < 0.03  # flat, as it is
    moving = points[found.moved & ~inside] - PIVOT
    assert float(torch.linalg.svdvals(moving)[-1] / len(moving) ** 0.5) > 0.05


def test_every_point_is_of_one_part_where_several_joints_moved() -> None:
    """Of two joints at the truth's states, the second far from everything, the first has all."""
    views, truth = sighted(12, seed=7)
    scene = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    points, _ = scene.world(128)
    inside = ((points - torch.tensor([0.0, 0, 0])).abs() < torch.tensor([0.21, 0.29, 0.17])).all(-1)
    own = motion_of(scene, ~inside, JOINT, "revolute")
    both = replace(own, moved=~inside)  # As if another joint had taken the flap for its own too
    beside = replace(JOINT, pivot=PIVOT + torch.tensor([0.0, 0.0, 0.6]))
    first, second = apart(scene, (JOINT, beside), (own, both), ("revolute", "revolute"))
    assert not bool((first.moved & second.moved).any())
    assert torch.equal(first.state, own.state)
    flap = ~inside
    assert float((first.moved & flap).sum() / flap.sum()) > 0.6
    assert float((second.moved & flap).sum() / flap.sum()) < 0.1
    assert apart(scene, (JOINT,), (both,), ("revolute",)) == (both,)
