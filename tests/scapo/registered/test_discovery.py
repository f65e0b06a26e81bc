# SPDX-License-Identifier: MIT
"""Discovery from bare views: joints and missing sides are found without labels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.geometry.rigid import axis_angle
from scapo.method import Journal
from scapo.records import take
from scapo.registered import discovery, joint_proposals
from scapo.registered.bundle_adjustment import Candidate, Inliers, densified, refit
from scapo.registered.config import DiscoveryConfig
from scapo.registered.course import Course
from scapo.registered.discovery import (
    advance,
    completed,
    held_out,
    ranked,
)
from scapo.registered.initialisation import fitted_proposals
from scapo.registered.inliers import find_inliers
from scapo.registered.joint_proposals import PosedViews
from scapo.registered.mirror_images import mirrored
from scapo.registered.pose_search import SearchResult
from scapo.registered.template import ArticulatedTemplate
from scapo.registered.views import PartialViews
from tests.helpers.sighted import AXIS, sighted, template, without_a_side
from tests.helpers.strategies import generator


def test_the_joint_is_found_in_a_few_views_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_proposals, "PAIRS", 20)
    views, truth = sighted(8, seed=50)
    posed = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    config = DiscoveryConfig(starts=1, template_points=150)
    (found,) = fitted_proposals(posed, ("revolute",), config, generator(0))
    assert axis_angle(found.template.directions()[0].detach(), AXIS).rad2deg() < 12
    states = torch.stack([found.inliers.placement.state[:, 0], truth.state[:, 0]])
    assert torch.corrcoef(states)[0, 1].abs() > 0.8


@pytest.mark.slow
def test_the_joint_is_found_once_the_bases_are_in_one_frame():
    views, truth = sighted(20, seed=50)
    posed = PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)
    config = DiscoveryConfig(starts=2, rotations=300)
    tried = fitted_proposals(posed, ("revolute",), config, generator(0))
    assert len(tried) == 2
    best = tried[ranked(tried, take(views, torch.arange(0, 20, 5)), config)[0]]
    refit(best, config, generator(1), rounds=2)
    assert axis_angle(best.template.directions()[0].detach(), AXIS).rad2deg() < 12
    state = torch.corrcoef(torch.stack([best.inliers.placement.state[:, 0], truth.state[:, 0]]))[
        0, 1
    ]
    assert abs(state) > 0.8
    cameras = Inliers(views=views, placement=truth).cameras()
    assert torch.allclose(cameras.norm(dim=-1), torch.ones(20), atol=1e-4)


@pytest.mark.parametrize("judges", [4, pytest.param(16, marks=pytest.mark.slow)])
def test_a_template_with_a_wrong_axis_is_not_the_leader(judges: int):
    views, truth = sighted(16, seed=51)
    right, wrong = template(), template()
    with torch.no_grad():
        wrong.axis.copy_(torch.roll(AXIS, 1)[None])
    inliers = Inliers(views=views, placement=truth)
    config = DiscoveryConfig(rotations=300)
    tried = [Candidate(template=one, inliers=inliers) for one in (wrong, right)]
    some = take(views, torch.arange(judges))
    assert ranked(tried, some, config) == [1, 0]
    assert ranked(tried[:1], some, config) == [0]


def test_views_that_judge_are_held_out():
    judges, others = held_out(9, 48)
    assert judges.tolist() == [0, 8]
    assert others.tolist() == [1, 2, 3, 4, 5, 6, 7]


def test_mirror_images_take_the_first_round_on_half_of_the_views(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What `discover` hands to each step, the steps themselves left out."""
    views, truth = sighted(16, seed=1)
    first = Candidate(template=template(), inliers=Inliers(views=views, placement=truth))
    none = torch.zeros(16)
    everywhere = SearchResult(placement=truth, loss=none, margin=none)
    calls: list[tuple[str, int, object]] = []

    def completing(best: Candidate, judges: PartialViews, half: PartialViews, *_: object):
        calls.append(("completed", len(half.points), len(judges.points)))
        return best

    def advancing(best: Candidate, searched: PartialViews, share: float, *_: object):
        calls.append(("advance", len(searched.points), share))
        return best

    for name, step in {
        "common_frame": lambda *_: PosedViews(
            views=views, rotation=truth.rotation, translation=truth.translation
        ),
        "fitted_proposals": lambda *_: [first],
        "completed": completing,
        "advance": advancing,
        "_advance_alone": advancing,
        "densified": lambda best, *_: best,
        "search_views": lambda *_: everywhere,
    }.items():
        monkeypatch.setattr(discovery, name, step)
    tried = DiscoveryConfig(
        draws=1, searched=12, trusted=(0.5, 0.7), heats=(0.3,), halves=False, leans=False
    )
    expected = {
        True: [("advance", 6, 0.3), ("completed", 6, 4), ("advance", 12, 0.7)],
        False: [("advance", 6, 0.3), ("advance", 12, 0.5), ("advance", 12, 0.7)],
    }
    for mirror, wanted in expected.items():
        calls.clear()
        config = replace(tried, mirror=mirror)
        discovery.discover(views, ArticulatedTemplate(("revolute",)), config, generator(0))
        assert calls == wanted


@pytest.mark.slow
def test_the_mirror_image_that_completes_the_base_is_kept(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Rounds left out, as if all views had been placed right: the judges choose."""
    caplog.set_level("INFO", "scapo.registered.discovery")
    views, truth = sighted(28, seed=91)
    anywhere: list[bool] = []

    def placed(one: Candidate, *_: object, **options: bool) -> Candidate:
        anywhere.append(options.get("anywhere", False))
        return replace(one, inliers=Inliers(views=views, placement=truth))

    monkeypatch.setattr(discovery, "advance", placed)
    monkeypatch.setattr(discovery, "densified", lambda one, *_: one)
    start = placed(
        Candidate(template=without_a_side(), inliers=Inliers(views=views, placement=truth))
    )
    anywhere.clear()
    judges = take(
        views, (Inliers(views=views, placement=truth).cameras()[:, 1] > 0.2).nonzero()[:, 0]
    )
    config = DiscoveryConfig(rotations=200)
    course = Course(ArticulatedTemplate(("revolute",)), generator(0), {}, Journal())
    found = completed(start, judges, views, config, course).template
    assert "kept: 2" in caplog.text  # 0 as it was, then its image along x, y, z
    assert (found.normals[found.logit.argmax(-1) == 0, 1] > 0.8).sum() > 15
    assert anywhere == [False, True, True, True]


@pytest.mark.slow
def test_a_mirrored_base_finds_views_of_a_side_that_inliers_never_saw() -> None:
    """The search of a round alone; the base without that side finds few of them."""
    views, truth = sighted(28, seed=91)
    cameras = Inliers(views=views, placement=truth).cameras()
    seen, other = (rows.nonzero()[:, 0] for rows in (cameras[:, 1] < -0.1, cameras[:, 1] > 0.1))
    inliers = Inliers(views=take(views, seen), placement=take(truth, seen))
    some, config = take(views, other[:8]), DiscoveryConfig(rotations=200)
    right = []
    for made in (without_a_side(), mirrored(without_a_side(), 1)):
        start = Candidate(template=made, inliers=inliers)
        found = find_inliers(start, some, 1.0, config, anywhere=True).inliers
        which = torch.cdist(found.views.points[:, 0], views.points[:, 0]).argmin(1)
        right.append(((found.cameras() * cameras[which]).sum(-1) > 0.9).float().mean())
    assert right[1] > 0.6
    assert right[0] < 0.4


@pytest.mark.slow
def test_views_of_a_side_that_inliers_never_saw_find_it() -> None:
    """A round on a mirrored base: its views are placed on that side, which they rebuild."""
    views, truth = sighted(28, seed=91)
    config = DiscoveryConfig(rotations=300, template_points=200, final_points=600)
    cameras = Inliers(views=views, placement=truth).cameras()
    seen = (cameras[:, 1] < -0.1).nonzero()[:, 0]
    inliers = Inliers(views=take(views, seen), placement=take(truth, seen))
    start = Candidate(template=mirrored(without_a_side(), 1), inliers=inliers)
    after = advance(start, views, 0.8, config, generator(0), anywhere=True)
    found, kept = after.template, after.inliers.views.points
    base = found.logit.argmax(-1) == 0
    assert (found.normals[base, 1] > 0.8).sum() > 15
    assert (found.normals[base, 1] < -0.8).sum() > 15
    which = torch.cdist(kept[:, 0], views.points[:, 0]).argmin(1)
    other = cameras[which, 1] > 0.1
    agree = (after.inliers.cameras() * cameras[which]).sum(-1) > 0.9
    assert other.sum() >= 4
    assert agree[other].float().mean() > 0.6
    assert len(densified(after, config, generator(0)).template.points) == config.final_points
