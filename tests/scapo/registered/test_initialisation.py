# SPDX-License-Identifier: MIT
"""What is tried before anything is known, and what a view's moved points are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.geometry.rigid import axis_angle
from scapo.registered.initialisation import DiscoveryConfig, moved_sets, starts, wide_states
from scapo.registered.joint_proposals import Posed
from tests.helpers.sighted import sighted
from tests.helpers.sliding import OUT, UP, cabinet, placements, seen
from tests.helpers.strategies import generator


def test_ranges_before_anything_is_known():
    assert wide_states(("revolute", "prismatic"), 5)[:, -1].tolist() == pytest.approx([1.7, 0.25])


def test_points_that_no_other_view_confirms_are_shared_among_the_joints():
    views, truth = sighted(12, seed=3)
    posed = Posed(views=views, rotation=truth.rotation, translation=truth.translation)
    alone = moved_sets(posed, 1, generator(0))[0]
    assert 0.2 < alone.float().mean() < 0.4
    points, _ = posed.world(alone.shape[1])
    flap = (points[..., 0] < -0.22) | (points[..., 2].abs() > 0.17)
    assert flap[alone].float().mean() > 1.5 * flap.float().mean()
    several = moved_sets(posed, 2, generator(0))
    assert not (several[0] & several[1]).any()
    assert torch.equal(several[0] | several[1], alone)


@pytest.mark.slow
def test_a_drawer_at_different_heights_slides_out_not_up():
    truth = placements(24)
    truth = replace(
        truth, shift=truth.shift + 0.6 * truth.state[..., None] * UP, state=0 * truth.state
    )
    views = seen(cabinet(OUT, 7, 4000), truth)
    posed = Posed(views=views, rotation=truth.rotation, translation=truth.translation)
    tried = starts(posed, ("prismatic",), DiscoveryConfig(starts=2), generator(0))
    assert len(tried) == 2
    for template, trusted in tried:
        assert axis_angle(template.directions()[0].detach(), OUT).rad2deg() < 10
        opened = torch.stack([trusted.placement.state[:, 0], truth.shift[:, 0] @ OUT])
        assert torch.corrcoef(opened)[0, 1].abs() > 0.9
