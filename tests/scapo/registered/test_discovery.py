# SPDX-License-Identifier: MIT
"""Discovery from bare views: the joint of a box with a flap is found without labels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.geometry.rigid import axis_angle
from scapo.registered.discovery import held_out, improve, leaders, trust_order
from scapo.registered.initialisation import DiscoveryConfig, Trusted, starts
from scapo.registered.joint_proposals import Posed
from scapo.registered.pose_search import Found
from scapo.registered.template import Placement
from tests.helpers.sighted import AXIS, sighted, template
from tests.helpers.sliding import OUT, UP, cabinet, placements, seen
from tests.helpers.strategies import generator


@pytest.mark.slow
def test_the_joint_is_found_once_the_bases_are_in_one_frame():
    views, truth = sighted(20, seed=50)
    posed = Posed(views=views, rotation=truth.rotation, translation=truth.translation)
    config = DiscoveryConfig(starts=2, rotations=300)
    tried = starts(posed, ("revolute",), config, generator(0))
    assert len(tried) == 2
    found, trusted = leaders(tried, views.take(torch.arange(0, 20, 5)), 1, config)[0]
    improve(found, trusted, config, generator(1), rounds=2)
    assert axis_angle(found.directions()[0].detach(), AXIS).rad2deg() < 12
    state = torch.corrcoef(torch.stack([trusted.placement.state[:, 0], truth.state[:, 0]]))[0, 1]
    assert abs(state) > 0.8
    cameras = Trusted(views=views, placement=truth).cameras()
    assert torch.allclose(cameras.norm(dim=-1), torch.ones(20), atol=1e-4)


@pytest.mark.slow
def test_a_start_along_a_wrong_axis_is_not_the_leader():
    views, truth = sighted(16, seed=51)
    right, wrong = template(), template()
    with torch.no_grad():
        wrong.axis.copy_(torch.roll(AXIS, 1)[None])
    trusted = Trusted(views=views, placement=truth)
    config = DiscoveryConfig(rotations=300)
    tried = [(wrong, trusted), (right, trusted)]
    assert leaders(tried, views, 1, config) == [(right, trusted)]
    assert leaders(tried[:1], views, 1, config) == tried[:1]


@pytest.mark.slow
def test_a_sliding_joint_along_a_wrong_axis_is_put_right():
    truth = placements(24)
    truth = replace(truth, state=0.6 * truth.state)
    views, wrong = seen(cabinet(UP, 7, 4000), truth), cabinet(UP)
    start = Trusted(views=views, placement=truth)
    trusted = improve(wrong, start, DiscoveryConfig(), generator(0), rounds=2)
    assert axis_angle(wrong.directions()[0].detach(), OUT).rad2deg() < 10
    opened = torch.stack([trusted.placement.state[:, 0], truth.shift[:, 0] @ OUT])
    assert torch.corrcoef(opened)[0, 1].abs() > 0.9


def test_views_that_judge_are_held_out():
    views, _ = sighted(9, seed=1)
    judges, others = held_out(views, 48)
    assert len(judges.points) == 2
    assert len(others.points) == 7
    assert torch.cdist(judges.points[:, 0], others.points[:, 0]).min() > 0


def test_views_are_ordered_by_trust():
    none = Placement.at(torch.eye(3).expand(3, 3, 3), torch.zeros(3, 3), torch.zeros(3, 1))
    found = Found(
        placement=none, loss=torch.tensor([0.4, 0.2, 0.2]), margin=torch.tensor([0.1, 0.1, 0.3])
    )
    assert trust_order(found).tolist() == [2, 1, 0]
