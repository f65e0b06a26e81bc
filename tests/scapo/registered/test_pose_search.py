# SPDX-License-Identifier: MIT
"""Search over rotations and states finds known placements; the margin tells the sure ones."""

from __future__ import annotations

from dataclasses import replace

import torch

from scapo.geometry.rigid import rotation_angle
from scapo.registered.joint_limits import OUTSIDE_COST, JointLimits
from scapo.registered.pose_search import (
    ALONE,
    THOROUGH,
    SearchResult,
    SearchSpace,
    askew,
    best_of,
    combinations,
    modes_of,
    of_one,
    rank_by_confidence,
    refine_states,
    search,
    surface_moved,
)
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_bank import ViewBank
from tests.helpers.sighted import sighted, template


def test_known_placements_are_found():
    views, truth = sighted(4, seed=40)
    states = torch.linspace(0, 1, 4)[None]
    bank = ViewBank.rendered(template(), modes_of(truth, states), None)
    space = SearchSpace(rendered=bank, placed=None, states=states)
    hypotheses = search(template(), views, space, replace(THOROUGH, proposed=8))
    free = JointLimits(low=torch.tensor([-9.0]), high=torch.tensor([9.0]), unit=torch.ones(1))
    found = hypotheses.best(free)
    errors = rotation_angle(found.placement.rotation, truth.rotation).rad2deg()
    assert errors.median() < 8
    assert (errors < 15).sum() >= 3
    assert bool((found.margin[errors < 15] > 0.02).any())
    state = (found.placement.state - truth.state).abs()[errors < 15]
    assert state.max() < 0.2
    high = JointLimits(low=torch.tensor([3.0]), high=torch.tensor([4.0]), unit=torch.ones(1))
    assert torch.allclose(hypotheses.best(high).loss, found.loss + OUTSIDE_COST)


def test_joints_of_one_kind_are_askew_that_are_not_parallel():
    made = ArticulatedTemplate(("revolute", "prismatic", "revolute", "revolute"), 10)
    axes = torch.tensor([[2.0, 0, 0], [0, 0, 1], [-1, 0, 0], [0.6, 0.8, 0]])
    made.axis.data.copy_(axes)  # no length, and no sense, is asked for
    assert abs(askew(made) - 2 * 0.4) < 1e-6
    assert askew(ArticulatedTemplate(("revolute",), 10)) == 0


def test_the_range_of_a_small_part_costs_little() -> None:
    made = ArticulatedTemplate(("revolute", "revolute"), 10)
    part = torch.tensor([0] * 4 + [1] * 5 + [2])
    made.logit.data.copy_(40 * torch.nn.functional.one_hot(part))
    assert torch.allclose(surface_moved(made), torch.tensor([1.0, 0.2]))
    assert surface_moved(ArticulatedTemplate(("revolute",), 10)).tolist() == [1.0]


def test_a_wrong_state_is_corrected_and_the_rest_kept():
    views, truth = sighted(4, seed=41)
    wrong = replace(truth, state=(truth.state + 0.5) % 1.0)
    found = SearchResult(placement=wrong, loss=torch.zeros(4), margin=torch.zeros(4))
    limits = JointLimits(low=torch.zeros(1), high=torch.ones(1), unit=torch.ones(1))
    refined = refine_states(template(), views, found, limits)
    assert (refined.state - truth.state).abs().max() < 0.15
    assert rotation_angle(refined.rotation, truth.rotation).rad2deg().max() < 8


def test_all_combinations_of_states():
    grid = combinations(torch.tensor([[0.0, 1], [2, 3]]))
    assert grid.tolist() == [[0, 2], [0, 3], [1, 2], [1, 3]]


def test_the_best_and_its_margin():
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    rotation = torch.stack([torch.eye(3), turn, torch.eye(3), turn, turn, torch.eye(3)])
    start = Placement.at(rotation, torch.zeros(6, 3), torch.arange(6.0)[:, None])
    loss = torch.tensor([[0.3, 0.2, 0.5], [0.1, 0.15, 0.4]])
    found = best_of(start, loss, torch.zeros(2, 3))
    assert found.placement.state[:, 0].tolist() == [1, 3]
    assert torch.allclose(found.margin, torch.tensor([0.1, 0.3]))
    odd = best_of(start, loss, torch.tensor([[0.0, 0.4, 0.0], [0.0, 0.0, 0.0]]))
    assert odd.placement.state[:, 0].tolist() == [0, 3]
    assert torch.allclose(odd.loss, torch.tensor([0.3, 0.1]))
    assert torch.allclose(odd.margin, torch.tensor([0.3, 0.3]))


def test_views_are_ordered_by_confidence():
    none = Placement.at(torch.eye(3).expand(3, 3, 3), torch.zeros(3, 3), torch.zeros(3, 1))
    found = SearchResult(
        placement=none, loss=torch.tensor([0.4, 0.2, 0.2]), margin=torch.tensor([0.1, 0.1, 0.3])
    )
    assert rank_by_confidence(found).tolist() == [2, 1, 0]


def test_dense_steps_are_taken_once_where_axes_deviate() -> None:
    shape = template()
    assert of_one(shape) == ALONE
    shape.load.fill_(0.1)
    assert (of_one(shape).last.steps, of_one(shape).long) == (0, ALONE.long)
