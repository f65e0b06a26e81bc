# SPDX-License-Identifier: MIT
"""The search of parts on two plates that a hinge joins: it must find the plates and the hinge."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry.rigid import apply, joint_motion, rigid
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.part_search import (
    PartSearch,
    Placements,
    SearchConfig,
    Skeleton,
    misfit,
    motionless,
    posed,
    split_skeleton,
    splits,
)
from tests.helpers.strategies import generator

CONFIG = SearchConfig(points=160, asked=160)


def hinged(states: Tensor) -> tuple[Tensor, Tensor]:
    """Plates of 0.8 x 0.4 joined along x at y = 0, one turned up; clouds (B, 200, 3), parts."""
    flat = torch.rand(len(states), 200, 2, generator=generator(0))
    x, y = 0.8 * flat[..., 0] - 0.4, 0.8 * flat[..., 1] - 0.4
    points = torch.stack([x, y, torch.zeros_like(x)], -1)
    part = (y > 0).long()
    axis = torch.tensor([1.0, 0, 0]).expand(len(states), 3)
    moved = apply(joint_motion(torch.zeros_like(axis), axis, states, "revolute"), points)
    return torch.where(part[..., None] == 1, moved, points), part


def test_the_split_at_the_hinge_fits_better_than_one_across_it() -> None:
    states = torch.linspace(0.4, 2.0, 7)
    clouds, part = hinged(states)
    template, search_of = clouds[3], PartSearch(("revolute",), CONFIG)
    others = [0, 1, 2, 4, 5, 6]
    still = motionless(clouds[others], 1)
    left = []
    for child in (part[3] == 1, template[:, 0] > 0):
        start = split_skeleton(template, [child], CONFIG.spread)
        found, at = search_of.descend(clouds[others], start, still, 30, "skeleton")
        left.append(search_of.place(clouds[others], found, still, 20)[1].mean())
        if len(left) == 1:
            axis = torch.nn.functional.normalize(found.axis[0], dim=0)
            assert axis[0].abs() > 0.95
            assert found.pivot[0, 1:].norm() < 0.1
            pair = torch.stack([at.state[:, 0], states[others]])
            assert torch.corrcoef(pair)[0, 1].abs() > 0.9
    assert left[0] < 0.8 * left[1]


def test_a_skeleton_lies_as_its_placement_says() -> None:
    points = 0.2 * torch.randn(40, 3, generator=generator(1)).double()
    points[20:, 0] += 5
    keypoints = torch.stack([points[:20].mean(0), points[20:].mean(0)])
    skeleton = Skeleton(
        points=points,
        keypoints=keypoints,
        factor=10 * torch.eye(3).double().expand(2, 3, 3),
        pivot=torch.tensor([[2.5, 0, 0]]).double(),
        axis=torch.tensor([[0.0, 0, 2]]).double(),
    )
    turn, shift = torch.tensor([[0.1, 0.2, 0.3]]).double(), torch.tensor([[1.0, 2, 3]]).double()
    size = torch.tensor([[0.1, 0.0, -0.1]]).double()
    aside = torch.tensor([[[0.05, -0.1, 0.2]]]).double()
    state = torch.tensor([[0.7]]).double()
    at = Placements(turn=turn, shift=shift, size=size, aside=aside, state=state)
    sized = points * size.exp()
    motion = joint_motion(
        skeleton.pivot[0] * size.exp()[0], torch.tensor([0.0, 0, 1]).double(),
        torch.tensor(0.7).double(), "revolute",
    )  # fmt: skip
    sized[20:] = apply(motion, sized[20:]) + aside[0]
    expected = apply(rigid(rotvec_to_rotmat(turn), shift), sized[None])
    assert_close(posed(skeleton, at, ("revolute",)), expected, atol=1e-6, rtol=0)
    assert misfit(expected, expected, 40).item() == pytest.approx(2e-3)
    still = motionless(expected, 1)
    assert misfit(expected, posed(skeleton, still, ("revolute",)), 40).item() > 0.5


@pytest.mark.parametrize("joints", [1, 2])
def test_every_split_leaves_each_part_some_points(joints: int) -> None:
    points = torch.randn(120, 3, generator=generator(4))
    stray = torch.rand(120, generator=generator(5))
    for children in splits(points, stray, joints, 6):
        assert len(children) == joints
        taken = torch.stack(children).sum(0)
        assert taken.max() <= 1
        assert all(child.any() for child in children)
        assert bool((taken == 0).any())


def test_points_that_stray_are_tried_together() -> None:
    points = torch.randn(120, 3, generator=generator(4))
    stray = torch.zeros(120)
    stray[7:31] = 1 + torch.rand(24, generator=generator(5))
    tried = [child.nonzero()[:, 0].tolist() for (child,) in splits(points, stray, 1, 6)]
    assert list(range(7, 31)) in tried


def test_a_skeleton_is_laid_over_a_shape_point_by_point() -> None:
    clouds, part = hinged(torch.tensor([1.0]))
    whole = split_skeleton(clouds[0], [part[0] == 1], CONFIG.spread)
    shape = whole.points[torch.randperm(200, generator=generator(3))[:60]] + 1e-4
    assert_close(whole.laid_over(shape).points, shape, atol=1e-3, rtol=0)


def test_clouds_of_like_objects_come_first_whatever_their_states() -> None:
    flat = 0.8 * torch.rand(6, 200, 2, generator=generator(7)) - 0.4
    points = torch.cat([flat, torch.zeros(6, 200, 1)], -1)
    points[::2] *= torch.tensor([0.6, 1.5, 1.0])  # other objects
    flap = points[..., 1] > 0.25 * points[..., 1].amax(1, keepdim=True) / 0.4
    axis, pivot = torch.tensor([1.0, 0, 0]).expand(6, 3), torch.zeros(6, 3)
    pivot[:, 1] = 0.25
    states = torch.tensor([0.9, 0.1, 0.9, 0.9, 0.9, 1.7])
    moved = apply(joint_motion(pivot, axis, states, "revolute"), points)
    clouds = torch.where(flap[..., None], moved, points)
    some = replace(CONFIG, clouds=(3, 5), placing=5, points=100)
    search_of = PartSearch(("revolute",), some)
    found, at = search_of.most_alike(clouds, search_of.in_one_piece(clouds[3]))
    assert found.shape[0] == at.state.shape[0] == 5
    like = {tuple(cloud[0].tolist()) for cloud in clouds[1::2]}
    assert {tuple(cloud[0].tolist()) for cloud in found[:3]} == like
    assert torch.equal(at.state, torch.zeros(5, 1))


def test_every_round_says_what_its_starts_left() -> None:
    clouds, _ = hinged(torch.tensor([0.6, 1.0, 1.4, 1.8]))
    brief = replace(
        CONFIG, seeds=1, clouds=(1, 2), kept=(2,), steps=(1, 1), points=60, asked=60, placing=1
    )
    _, said = PartSearch(("revolute",), brief).search(clouds[0], clouds)
    assert [len(row) for row in said] == [13, 2]
    assert all(row == sorted(row) for row in said)


def test_a_shape_of_more_points_than_asked_for_is_covered() -> None:
    clouds, _ = hinged(torch.linspace(0.4, 2.0, 4))
    few = SearchConfig(
        seeds=1, clouds=(1,), alike=1, kept=(), steps=(1,), points=20, asked=20, placing=1
    )
    found, _ = PartSearch(("revolute",), few).search(clouds[0], clouds)
    assert found.laid_over(clouds[0]).points.shape == clouds[0].shape
