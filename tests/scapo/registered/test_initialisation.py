# SPDX-License-Identifier: MIT
"""First templates: what slides out of a body, and what is proposed at all."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.geometry.rigid import axis_angle
from scapo.registered.config import DiscoveryConfig
from scapo.registered.initialisation import (
    LINKS,
    PARTNERS,
    RING,
    first_template,
    fitted_proposals,
    pairs_of_one,
)
from scapo.registered.joint_proposals import JointProposal, PosedViews
from tests.helpers.sighted import AXIS, PIVOT, sighted
from tests.helpers.sliding import OUT, UP, cabinet, placements, seen
from tests.helpers.strategies import generator


@pytest.mark.parametrize(("count", "starts"), [(8, 1), pytest.param(24, 2, marks=pytest.mark.slow)])
def test_a_drawer_at_different_heights_slides_out_not_up(count: int, starts: int):
    truth = placements(count)
    truth = replace(
        truth, shift=truth.shift + 0.6 * truth.state[..., None] * UP, state=0 * truth.state
    )
    views = seen(cabinet(OUT, 7, 4000), truth)
    posed = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    config = DiscoveryConfig(starts=starts)
    tried = fitted_proposals(posed, ("prismatic",), config, generator(0))
    assert len(tried) == starts
    for candidate in tried:
        assert axis_angle(candidate.template.directions()[0].detach(), OUT).rad2deg() < 10
        state = candidate.inliers.placement.state[:, 0]
        opened = torch.stack([state, truth.shift[:, 0] @ OUT])
        assert torch.corrcoef(opened)[0, 1].abs() > 0.9


@torch.no_grad()
def test_still_points_begin_as_base_and_moved_ones_as_parts_of_the_proposed_joint():
    views, truth = sighted(4, seed=3)
    posed = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    moved = torch.arange(128).expand(4, 128) % 4 == 0
    joint = JointProposal(axis=AXIS, pivot=PIVOT, score=1.0)
    surface = posed.world(128)
    made = first_template(surface, (moved,), (joint,), ("revolute",), 60)
    points, _ = surface
    for part, own in enumerate((~moved, moved)):
        mine = made.points[made.logit.argmax(-1) == part]
        assert len(mine) > 10
        assert torch.cdist(mine, points[own]).amin(1).max() < 1e-3
    assert torch.equal(made.axis[0], AXIS)
    assert torch.equal(made.pivot[0], PIVOT)


def test_views_of_one_object_are_registered_with_others_of_a_ring():
    pairs = pairs_of_one(RING)
    assert (pairs[:, 0] > pairs[:, 1]).all()
    assert len(pairs.unique(dim=0)) == len(pairs) == RING * PARTNERS
    assert pairs.flatten().bincount().tolist() == [2 * PARTNERS] * RING
    assert [RING - 1, 4] in pairs.tolist()
    assert len(pairs_of_one(11)) == 55  # all
    assert len(pairs_of_one(2)) == 1
    more = pairs_of_one(2 * RING)
    assert torch.equal(more[: len(pairs)], pairs)
    further, known = more[len(pairs) :].unbind(1)
    assert further.bincount()[RING:].tolist() == [LINKS] * RING
    assert known.bincount().tolist() == [LINKS] * RING  # none is asked more often than others
    assert len(more.unique(dim=0)) == len(more)
