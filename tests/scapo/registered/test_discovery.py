# SPDX-License-Identifier: MIT
"""Discovery from bare views: joints and missing sides are found without labels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.categories import JointKind
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
    mirrored,
    paired,
    ranked,
)
from scapo.registered.initialisation import fitted_proposals
from scapo.registered.joint_proposals import PosedViews
from scapo.registered.pose_search import SearchResult, find_inliers
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import PartialViews
from tests.helpers.sighted import AXIS, sighted, template
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
    views, _ = sighted(9, seed=1)
    judges, others = held_out(views, 48)
    assert len(judges.points) == 2
    assert len(others.points) == 7
    assert torch.cdist(judges.points[:, 0], others.points[:, 0]).min() > 0


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
        discovery.discover(views, ("revolute",), config, generator(0))
        assert calls == wanted


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


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("joint", [0, 1])
def test_one_part_is_mirrored_in_place_of_the_other(joint: int, kind: JointKind) -> None:
    """Opened as far, the two lie as each other's mirror images; the other itself is gone."""
    g, other = generator(3), 1 - joint
    base = torch.rand(80, 3, generator=g) * torch.tensor([0.4, 0.6, 0.3])
    lid = torch.rand(40, 3, generator=g) * torch.tensor([0.4, 0.1, 0.02]) + 0.3
    rest = torch.rand(60, 3, generator=g)
    shape = ArticulatedTemplate((kind, kind), 180)
    part = torch.tensor([0, joint + 1, other + 1]).repeat_interleave(torch.tensor([80, 40, 60]))
    normals = torch.nn.functional.normalize(torch.randn(180, 3, generator=g), dim=-1)
    shape.assign(torch.cat([base, lid, rest]), normals, 9.0 * torch.eye(3)[part])
    with torch.no_grad():
        shape.axis[joint] = torch.tensor([0.9, 0.1, 0.3])
        shape.pivot[joint] = torch.tensor([0.1, 0.5, 0.2])
    still = Placement.at(torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3), torch.zeros(4, 2))
    views, _ = sighted(4, seed=3)
    found = paired(
        Candidate(template=shape, inliers=Inliers(views=views, placement=still)), joint, 1
    )
    made = found.template
    placed, facing = made.place(replace(still, state=torch.full((4, 2), 0.7)))
    of = made.logit.argmax(-1)
    middle = base[:, 1].quantile(torch.tensor([0.02, 0.98])).mean()
    mirror = torch.tensor([1.0, -1.0, 1.0])
    first, second = placed[0, of == joint + 1], placed[0, of == other + 1]
    assert len(second) >= 30
    image = second * mirror + torch.tensor([0.0, 2.0, 0.0]) * middle
    apart, nearest = (image[:, None] - first).norm(dim=-1).min(1)
    assert apart.max() < 1e-5
    turned = facing[0, of == joint + 1][nearest]
    assert torch.allclose(facing[0, of == other + 1] * mirror, turned, atol=1e-4)
    assert torch.equal(found.inliers.placement.state, still.state)


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
    course = Course(("revolute",), generator(0), {}, Journal())
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
