# SPDX-License-Identifier: MIT
"""Bundle adjustment puts wrong joints right."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.geometry.rigid import axis_angle, point_line_distance
from scapo.registered import bundle_adjustment
from scapo.registered.bundle_adjustment import (
    Candidate,
    FitOptions,
    Inliers,
    bundle_adjust,
    densified,
    refit,
    wide_states,
)
from scapo.registered.config import DiscoveryConfig
from scapo.registered.template import Placement
from tests.helpers.sighted import AXIS, PIVOT, sighted, template
from tests.helpers.sliding import OUT, UP, cabinet, placements, seen
from tests.helpers.strategies import generator


def test_a_wrong_joint_is_put_right():
    views, truth = sighted(12, seed=12)
    shape = template()
    with torch.no_grad():
        shape.axis.copy_(torch.nn.functional.normalize(AXIS + 0.3 * torch.ones(3), dim=0)[None])
        shape.pivot.copy_((PIVOT + torch.tensor([0.06, 0, 0.05]))[None])
    before = axis_angle(shape.directions()[0].detach(), AXIS).rad2deg()
    options = FitOptions(steps=60)
    _, loss = bundle_adjust(shape, views, truth, options, generator=generator(0))
    axis = shape.directions()[0].detach()
    assert axis_angle(axis, AXIS).rad2deg() < before / 3
    assert point_line_distance(shape.pivot[0].detach(), PIVOT, AXIS) < 0.05
    assert loss.mean() < 0.35


@pytest.mark.parametrize(("count", "rounds"), [(8, 1), pytest.param(24, 2, marks=pytest.mark.slow)])
def test_a_sliding_joint_along_a_wrong_axis_is_put_right(count: int, rounds: int):
    truth = placements(count)
    truth = replace(truth, state=0.6 * truth.state)
    views, wrong = seen(cabinet(UP, 7, 4000), truth), cabinet(UP)
    start = Candidate(template=wrong, inliers=Inliers(views=views, placement=truth))
    found = refit(start, DiscoveryConfig(), generator(0), rounds=rounds).inliers
    assert axis_angle(wrong.directions()[0].detach(), OUT).rad2deg() < 10
    opened = torch.stack([found.placement.state[:, 0], truth.shift[:, 0] @ OUT])
    assert torch.corrcoef(opened)[0, 1].abs() > 0.9


@pytest.mark.parametrize("alike", [False, True])
def test_the_hinge_of_two_like_halves_is_not_pulled_to_the_frame_of_one(
    alike: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, truth = sighted(4, seed=12)
    shape, pulls = template(), list[float]()
    shape.alike.fill_(float(alike))

    def fitted(_: object, __: object, placement: Placement, options: FitOptions, **___: object):
        pulls.append(options.axis_weight)
        return placement, torch.zeros(4)

    monkeypatch.setattr(bundle_adjustment, "bundle_adjust", fitted)
    start = Candidate(template=shape, inliers=Inliers(views=views, placement=truth))
    densified(start, DiscoveryConfig(final_points=400), generator(0))
    assert pulls == [0.0 if alike else DiscoveryConfig().axis_weight]


def test_ranges_before_anything_is_known():
    assert wide_states(("revolute", "prismatic"), 5)[:, -1].tolist() == pytest.approx([1.7, 0.25])
