# SPDX-License-Identifier: MIT
"""Discovery from bare views: joints and missing sides are found without labels."""

from __future__ import annotations

import pytest
import torch

from scapo.geometry.rigid import axis_angle
from scapo.records import take
from scapo.registered.bundle_adjustment import Candidate, Inliers, densified, refit
from scapo.registered.config import DiscoveryConfig
from scapo.registered.discovery import completed, held_out, leaders, mirrored
from scapo.registered.initialisation import fitted_proposals
from scapo.registered.joint_proposals import PosedViews
from scapo.registered.template import ArticulatedTemplate
from tests.helpers.sighted import AXIS, sighted, template
from tests.helpers.strategies import generator


@pytest.mark.slow
def test_the_joint_is_found_once_the_bases_are_in_one_frame():
    views, truth = sighted(20, seed=50)
    posed = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    config = DiscoveryConfig(starts=2, rotations=300)
    tried = fitted_proposals(posed, ("revolute",), config, generator(0))
    assert len(tried) == 2
    best = leaders(tried, take(views, torch.arange(0, 20, 5)), 1, config)[0]
    refit(best, config, generator(1), rounds=2)
    assert axis_angle(best.template.directions()[0].detach(), AXIS).rad2deg() < 12
    state = torch.corrcoef(torch.stack([best.inliers.placement.state[:, 0], truth.state[:, 0]]))[
        0, 1
    ]
    assert abs(state) > 0.8
    cameras = Inliers(views=views, placement=truth).cameras()
    assert torch.allclose(cameras.norm(dim=-1), torch.ones(20), atol=1e-4)


@pytest.mark.slow
def test_a_template_with_a_wrong_axis_is_not_the_leader():
    views, truth = sighted(16, seed=51)
    right, wrong = template(), template()
    with torch.no_grad():
        wrong.axis.copy_(torch.roll(AXIS, 1)[None])
    inliers = Inliers(views=views, placement=truth)
    config = DiscoveryConfig(rotations=300)
    tried = [Candidate(template=one, inliers=inliers) for one in (wrong, right)]
    assert leaders(tried, views, 1, config)[0].template is right
    assert leaders(tried[:1], views, 1, config)[0].template is wrong


def test_views_that_judge_are_held_out():
    views, _ = sighted(9, seed=1)
    judges, others = held_out(views, 48)
    assert len(judges.points) == 2
    assert len(others.points) == 7
    assert torch.cdist(judges.points[:, 0], others.points[:, 0]).min() > 0


def without_a_side() -> ArticulatedTemplate:
    """The box with its flap, but without its side at positive y."""
    whole = template(count=500)
    kept = (whole.normals[:, 1] < 0.8) | (whole.logit.argmax(-1) == 1)
    cut = whole.with_points(400)
    cut.assign(whole.points[kept][:400], whole.normals[kept][:400], whole.logit[kept][:400])
    return cut


def test_the_base_is_mirrored_and_the_part_is_not() -> None:
    cut = without_a_side()
    part, none = cut.logit.argmax(-1), cut.normals[:, 1] > 0.8
    assert not (none & (part == 0)).any()
    whole = mirrored(cut, 1)
    assert len(whole.points) == len(cut.points)
    base = whole.logit.argmax(-1) == 0
    right = base & (whole.normals[:, 1] > 0.8)
    left = base & (whole.normals[:, 1] < -0.8)
    assert right.sum() > 0.6 * left.sum() > 10
    middle = (whole.points[right, 1].mean() + whole.points[left, 1].mean()) / 2
    assert middle.abs() < 0.02
    flap, before = whole.points[~base], cut.points[part == 1]
    assert (flap[:, None] - before).norm(dim=-1).amin(1).max() < 1e-6
    assert torch.equal(whole.axis, cut.axis)
    assert torch.equal(whole.pivot, cut.pivot)


@pytest.mark.slow
def test_a_side_that_inliers_never_saw_is_there_after_a_round(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "scapo.registered.discovery")
    views, truth = sighted(28, seed=91)
    config = DiscoveryConfig(rotations=300, trusted=(0.8,), template_points=200, final_points=600)
    left = Inliers(views=views, placement=truth).cameras()[:, 1] < -0.1
    seen = left.nonzero()[:, 0]
    inliers = Inliers(views=take(views, seen), placement=take(truth, seen))
    start = Candidate(template=without_a_side(), inliers=inliers)
    after = completed(start, views, views, config, generator(0))
    found = after.template
    assert "kept: 2" in caplog.text  # 0 as it was, then its image along x, y, z
    base = found.logit.argmax(-1) == 0
    assert (found.normals[base, 1] > 0.8).sum() > 15
    assert (found.normals[base, 1] < -0.8).sum() > 15
    dense = densified(after, config, generator(0))
    assert len(dense.template.points) == config.final_points
