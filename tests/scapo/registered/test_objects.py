# SPDX-License-Identifier: MIT
"""First templates of several objects, of each of which some views are known."""

from __future__ import annotations

import pytest
import torch

from scapo.geometry.rigid import axis_angle, rotation_angle
from scapo.registered.config import DiscoveryConfig
from scapo.registered.joint_proposals import JointProposal, PosedViews
from scapo.registered.objects import OneObject, agreeing, grouped, object_candidate, quarter_turns
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
        centre=torch.zeros(3),
        half=torch.full((3,), 0.3),
    )


def test_quarter_turns_are_the_rotations_of_a_cube() -> None:
    turns = torch.stack(quarter_turns())
    assert torch.equal(turns @ turns.mT, torch.eye(3).expand(24, 3, 3))
    assert torch.equal(torch.det(turns), torch.ones(24))
    assert len({tuple(turn.flatten().tolist()) for turn in turns}) == 24


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
    instance = torch.tensor([3] * 20 + [5] * 4 + [8] * 9 + [1] * 12)[torch.randperm(45)]
    config = DiscoveryConfig(objects=10, object_views=10)
    groups = grouped(instance, config)
    assert [instance[rows].unique().tolist() for rows in groups] == [[1], [3], [8]]
    assert [len(rows) for rows in groups] == [10, 10, 9]
    assert len(grouped(instance, DiscoveryConfig(objects=2))) == 2
    assert grouped(torch.arange(40), config) == []


@pytest.mark.slow
def test_a_template_is_found_from_views_of_a_few_objects() -> None:
    """Rotations of the views of four boxes with a flap, and the flap's axis."""
    some = [sighted(8, seed=50 * k) for k in range(4)]
    config = DiscoveryConfig(rotations=300, template_points=150)
    with_truth = {tuple(v.points[i, 0].tolist()): t.rotation[i] for v, t in some for i in range(8)}
    found = object_candidate([v for v, _ in some], ("revolute",), config, generator(0))
    views, placement = found.inliers.views, found.inliers.placement
    truth = torch.stack([with_truth[tuple(p.tolist())] for p in views.points[:, 0]])
    common = placement.rotation.mT @ truth
    off = rotation_angle(common, common[:1].expand_as(common))
    assert float((off.rad2deg() < 20).float().mean()) > 0.8
    axis = common[0] @ AXIS
    assert float(axis_angle(found.template.directions()[0].detach(), axis).rad2deg()) < 15
