# SPDX-License-Identifier: MIT
"""First templates of several objects, of each of which some views are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NoReturn

import pytest
import torch

from scapo.categories import CATEGORIES
from scapo.geometry.rigid import axis_angle, random_rotations, rotation_angle
from scapo.registered import joint_proposals, method
from scapo.registered import objects as room
from scapo.registered.config import DiscoveryConfig, RegisteredConfig
from scapo.registered.inliers import OwnedViews, voted
from scapo.registered.joint_limits import limits_of
from scapo.registered.joint_proposals import JointProposal, PosedViews
from scapo.registered.method import TemplateRegistration
from scapo.registered.objects import (
    OneObject,
    agreeing,
    grouped,
    object_candidate,
    one_object,
    owned_views,
    surest_first,
)
from scapo.registered.orientation import quarter_turns
from scapo.registered.pose_search import Hypotheses
from scapo.registered.template import Placement
from scapo.registered.view_states import Motion
from scapo.types import Labels, Observation
from tests.helpers.sighted import AXIS, sighted
from tests.helpers.strategies import generator


def known(turn: torch.Tensor, seed: int, scores: tuple[float, float, float]) -> OneObject:
    """An object with true poses in a frame that is turned; the first score is the true axis's."""
    views, truth = sighted(6, seed=seed)
    moved = torch.arange(128).expand(6, 128) % 4 == 0
    axes = (AXIS, AXIS.roll(1), AXIS.roll(2))
    proposals = [
        JointProposal(axis=turn @ axis, pivot=torch.zeros(3), score=score)
        for axis, score in zip(axes, scores, strict=True)
    ]
    return OneObject(
        posed=PosedViews(
            views=views, rotation=truth.rotation @ turn.T, translation=truth.translation
        ),
        moved=(moved,),
        proposals=(sorted(proposals, key=lambda one: -one.score),),
        motions=(Motion(state=truth.state[:, 0], moved=moved, score=0.3, support=-0.2),),
        centre=torch.zeros(3),
        half=torch.full((3,), 0.3),
    )


def test_objects_whose_frames_are_turned_come_to_one_frame() -> None:
    turns = quarter_turns()
    picked = [turns[k] for k in (0, 5, 11, 16, 23)]
    some = [known(turn, seed, (0.2, 0.1, 0.1)) for seed, turn in enumerate(picked)]
    readings = agreeing(some, ("revolute",))
    common = torch.stack([x.turn @ turn for x, turn in zip(readings, picked, strict=True)])
    assert torch.equal(common, common[:1].expand(5, 3, 3))


def test_an_axis_that_one_object_told_badly_is_taken_from_the_others() -> None:
    some = [known(torch.eye(3), seed, (0.2, 0.1, 0.1)) for seed in range(4)]
    some.append(known(torch.eye(3), 4, (0.199, 0.2, 0.1)))
    assert not torch.equal(some[-1].proposals[0][0].axis, AXIS)
    readings = agreeing(some, ("revolute",))
    assert torch.equal(readings[-1].turn @ readings[-1].joints[0].axis, readings[0].turn @ AXIS)


def test_groups_hold_clouds_of_one_object_and_pass_over_those_with_few() -> None:
    order = torch.randperm(54, generator=generator(0))
    instance = torch.tensor([3] * 20 + [5] * 4 + [8] * 9 + [1] * 12 + [9] * 9)[order]
    config = DiscoveryConfig(objects=10, object_views=10)
    groups = grouped(instance, config)
    assert [instance[rows].unique().tolist() for rows in groups] == [[1], [3], [8], [9]]
    assert [len(rows) for rows in groups] == [10, 10, 9, 9]
    groups = grouped(instance, DiscoveryConfig(objects=2))
    assert [instance[rows].unique().tolist() for rows in groups] == [[1], [9]]
    assert grouped(instance[instance != 9], config) == []  # three objects tell no category
    assert grouped(torch.arange(40), config) == []


@pytest.mark.parametrize("each", [5, 8])
def test_clouds_are_grouped_where_each_object_shows_enough(
    each: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[int] = []

    def discovering(*args: Any) -> NoReturn:
        told.extend(len(views.points) for views in args[4])
        raise InterruptedError

    monkeypatch.setattr(method, "discover", discovering)
    config = RegisteredConfig(supervision=("instance",), points=32)
    registered = TemplateRegistration(config, CATEGORIES["oven"], generator(0))
    points = torch.randn(4 * each, 64, 3, generator=generator(1)) + torch.tensor([0.0, 0, 9])
    labels = Labels(instance=torch.arange(4).repeat(each))
    with pytest.raises(InterruptedError):
        registered.start("votes", Observation(points=points), labels, generator(2))
    assert told == ([8] * 4 if each == 8 else [])
    assert ("too few clouds" in caplog.text) == (each == 5)


def test_views_of_each_object_are_owned_by_it_and_stand_in_one_frame() -> None:
    picked = [quarter_turns()[k] for k in (0, 5, 16)]
    some = [known(turn, seed, (0.2, 0.1, 0.1)) for seed, turn in enumerate(picked)]
    shown = owned_views(some, ("revolute",))
    assert shown.owner.tolist() == [0] * 6 + [1] * 6 + [2] * 6
    assert torch.equal(shown.views.points[7], some[1].posed.views.points[1])
    truth = torch.cat([sighted(6, seed=seed)[1].rotation for seed in range(3)])
    frame = shown.rotation.mT @ truth  # common_R_template
    assert torch.allclose(frame, frame[:1].expand(18, 3, 3), atol=1e-5)
    cameras = torch.stack([one.cameras().var(0).sum() for one in some])
    assert shown.variance == pytest.approx(float(cameras.mean()))
    assert shown.some(6).owner.tolist() == [0, 0, 1, 1, 2, 2]
    assert shown.some(99, objects=2).owner.tolist() == [0] * 6 + [1] * 6


def turned_views(variance: float) -> tuple[OwnedViews, Hypotheses, torch.Tensor]:
    """Ten views of two objects; each has its true pose and three others; and the true rotations.

    Three views of the second object like the same wrong turn of it better than the true one.
    """
    g = generator(0)
    shown = replace(
        owned_views([known(torch.eye(3), k, (0.2, 0.1, 0.1)) for k in range(2)], ("revolute",)),
        variance=variance,
    ).some(10)
    shown = replace(shown, rotation=random_rotations(10, g), owner=torch.arange(10) // 5)
    true = shown.rotation @ random_rotations(1, g).mT
    rotation = torch.cat([true[:, None], random_rotations(30, g).view(10, 3, 3, 3)], 1)
    rotation[5:, 1] = shown.rotation[5:] @ random_rotations(1, g).mT
    loss = torch.full((10, 4), 0.5)
    loss[:, 0], loss[0, 2], loss[5:8, 1], loss[8:, 1] = 0.4, 0.38, 0.36, 0.41
    turn = rotation.flatten(0, 1)
    placement = Placement.at(turn, torch.zeros(40, 3), torch.zeros(40, 1))
    return shown, Hypotheses(placement=placement, loss=loss, unlike=torch.zeros(10, 4)), true


def spread_as(wanted: float) -> tuple[OwnedViews, Hypotheses, torch.Tensor]:
    """Those whose cameras spread so widely beside single views'."""
    shown, hypotheses, _ = turned_views(variance=1.0)
    return turned_views(variance=wanted / shown.spread(hypotheses.best_rotation()))


@pytest.mark.parametrize(
    ("spread", "together", "outvoted"),
    [(1.0, True, True), (0.6, True, False), (1.3, True, False), (1.0, False, False)],
    ids=["together", "gathered", "scattered", "exchanged"],
)
def test_views_of_all_objects_outvote_turns_that_one_object_prefers(
    spread: float, together: bool, outvoted: bool
) -> None:
    """Unless the objects' cameras gather or scatter, or parts may be exchanged."""
    shown, hypotheses, true = spread_as(spread)
    limits = limits_of(torch.linspace(-1, 1, 10)[:, None], ("revolute",))
    alone = hypotheses.best(limits).placement.rotation
    assert torch.equal(alone, hypotheses.best_rotation())
    assert int((rotation_angle(alone, true) > 0.1).sum()) == 4
    found, agrees = voted(hypotheses, limits, shown, together=together)
    assert agrees.all()
    wrong = rotation_angle(found.placement.rotation, true) > 1e-3
    assert wrong.tolist() == [False] * 5 + [not outvoted] * 5


def test_a_view_none_of_whose_hypotheses_is_right_does_not_agree() -> None:
    shown, hypotheses, _ = spread_as(1.0)
    limits = limits_of(torch.linspace(-1, 1, 10)[:, None], ("revolute",))
    rotation = hypotheses.rotation().clone()
    rotation[3] = random_rotations(4, generator(5))
    placement = replace(hypotheses.placement, rotation=rotation.flatten(0, 1))
    turned = replace(hypotheses, placement=placement)
    agrees = voted(turned, limits, shown, together=True)[1]
    assert agrees.tolist() == [True] * 3 + [False] + [True] * 6


def test_views_of_one_object_tell_its_frame_and_its_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_proposals, "PAIRS", 30)
    views, truth = sighted(6, seed=0)
    found = one_object(views, ("revolute",), DiscoveryConfig(rotations=200), generator(0))
    which = torch.cdist(found.posed.views.points[:, 0], views.points[:, 0]).argmin(1)
    common = found.posed.rotation.mT @ truth.rotation[which]
    off = rotation_angle(common, common[:1].expand_as(common))
    assert float((off.rad2deg() < 20).float().mean()) > 0.8
    axis = found.proposals[0][0].axis
    assert float(axis_angle(axis, common[0] @ AXIS).rad2deg()) < 15


def test_a_template_of_objects_in_turned_frames_is_in_one_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What each object tells is known; some of their views, a fit of few points."""
    monkeypatch.setattr(room, "FITTED", 8)
    some = [known(quarter_turns()[5 * k], k, (0.2, 0.1, 0.1)) for k in range(4)]
    config = DiscoveryConfig(template_points=100)
    found = object_candidate(some, ("revolute",), config, generator(0))
    shown = [sighted(6, seed=k) for k in range(4)]
    points = torch.cat([views.points[:, 0] for views, _ in shown])
    which = torch.cdist(found.inliers.views.points[:, 0], points).argmin(1)
    truth = torch.cat([placement.rotation for _, placement in shown])[which]
    common = found.inliers.placement.rotation.mT @ truth
    off = rotation_angle(common, common[:1].expand_as(common))
    assert len(off) == 8
    assert float((off.rad2deg() < 25).float().mean()) > 0.7
    axis = found.template.directions()[0].detach()
    assert float(axis_angle(axis, common[0] @ AXIS).rad2deg()) < 15


@pytest.mark.slow
def test_a_template_is_found_from_views_of_a_few_objects() -> None:
    """Rotations of the views of four boxes with a flap, and the flap's axis."""
    some = [sighted(8, seed=50 * k) for k in range(4)]
    config = DiscoveryConfig(rotations=300, template_points=150)
    with_truth = {tuple(v.points[i, 0].tolist()): t.rotation[i] for v, t in some for i in range(8)}
    g = generator(0)
    shown = surest_first([one_object(views, ("revolute",), config, g) for views, _ in some])
    found = object_candidate(shown, ("revolute",), config, generator(0))
    views, placement = found.inliers.views, found.inliers.placement
    truth = torch.stack([with_truth[tuple(p.tolist())] for p in views.points[:, 0]])
    common = placement.rotation.mT @ truth
    off = rotation_angle(common, common[:1].expand_as(common))
    assert float((off.rad2deg() < 20).float().mean()) > 0.8
    axis = common[0] @ AXIS
    assert float(axis_angle(found.template.directions()[0].detach(), axis).rad2deg()) < 15
