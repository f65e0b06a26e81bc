# SPDX-License-Identifier: MIT
"""Discovery from bare views: the joint of a box with a flap is found without labels."""

from __future__ import annotations

import pytest
import torch
from sighted import AXIS, sighted
from strategies import generator

from scapo.axis_search import Posed
from scapo.discovery import (
    DiscoveryConfig,
    Trusted,
    improve,
    starts,
    trust_order,
    wide_states,
    winner,
)
from scapo.geometry import axis_angle
from scapo.pose_search import Found
from scapo.template import Placement


@pytest.mark.slow
def test_the_joint_is_found_once_the_bases_are_in_one_frame():
    views, truth = sighted(20, seed=50)
    posed = Posed(views=views, rotation=truth.rotation, translation=truth.translation)
    config = DiscoveryConfig(starts=2, judged=4, rotations=300)
    tried = starts(posed, ("revolute",), config, generator(0))
    assert len(tried) == 2
    template, trusted = winner(tried, views, config)
    improve(template, trusted, generator(1), rounds=2)
    assert axis_angle(template.directions()[0].detach(), AXIS).rad2deg() < 12
    state = torch.corrcoef(torch.stack([trusted.placement.state[:, 0], truth.state[:, 0]]))[0, 1]
    assert abs(state) > 0.8
    cameras = Trusted(views=views, placement=truth).cameras()
    assert torch.allclose(cameras.norm(dim=-1), torch.ones(20), atol=1e-4)


def test_ranges_before_anything_is_known():
    assert wide_states(("revolute", "prismatic"), 5)[:, -1].tolist() == pytest.approx([1.7, 0.25])


def test_views_are_ordered_by_trust():
    none = Placement.at(torch.eye(3).expand(3, 3, 3), torch.zeros(3, 3), torch.zeros(3, 1))
    found = Found(
        placement=none, loss=torch.tensor([0.4, 0.2, 0.2]), margin=torch.tensor([0.1, 0.1, 0.3])
    )
    assert trust_order(found).tolist() == [2, 1, 0]
