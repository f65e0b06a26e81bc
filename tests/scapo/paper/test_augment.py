# SPDX-License-Identifier: MIT
"""Disturbances keep the pose and come from their generator alone."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from scapo.paper.augment import DISTURBANCES, Disturbance, disturb, one_side, random_pose
from tests.helpers.strategies import generator, is_rotation, normal

POINTS = normal(0, 3, 600, 3, dtype=torch.float32)


def test_poses_are_rigid_and_within_the_shift() -> None:
    pose = random_pose(50, 0.1, generator(0), POINTS)
    assert bool(is_rotation(pose[:, :3, :3], 1e-5).all())
    assert 0.05 < pose[:, :3, 3].abs().max() <= 0.1
    assert pose[:, 3].tolist() == [[0, 0, 0, 1]] * 50


@pytest.mark.parametrize("kind", DISTURBANCES)
def test_the_same_generator_gives_the_same_cloud(kind: Disturbance) -> None:
    state = torch.get_rng_state()
    assert torch.equal(disturb(POINTS, kind, generator(1)), disturb(POINTS, kind, generator(1)))
    assert torch.equal(state, torch.get_rng_state())


def test_noise_is_small() -> None:
    moved = disturb(POINTS, "noise", generator(1)) - POINTS
    assert moved.std().item() == pytest.approx(0.025, rel=0.05)


@pytest.mark.parametrize("kind", ["spread", "crop", "resample"])
def test_other_disturbances_choose_points(kind: Disturbance) -> None:
    found = disturb(POINTS, kind, generator(1))
    distance = torch.cdist(found, POINTS, compute_mode="donot_use_mm_for_euclid_dist").amin(-1)
    assert distance.max() == 0


def test_counts() -> None:
    assert 300 <= disturb(POINTS, "spread", generator(1)).shape[1] <= 500
    assert disturb(POINTS, "crop", generator(1)).shape[1] == 540
    assert disturb(POINTS, "resample", generator(1)).shape[1] == 600
    assert disturb(POINTS[:, :50], "spread", generator(1)).shape[1] == 50


def test_a_crop_removes_a_ball_and_keeps_the_order() -> None:
    found = disturb(POINTS[:1], "crop", generator(1))[0]
    kept = torch.cdist(found, POINTS[0]).argmin(-1)
    assert bool((kept.diff() > 0).all())
    gone = torch.ones(600, dtype=torch.bool).index_fill(0, kept, False)
    removed = POINTS[0, gone]
    assert removed.shape == (60, 3)
    spread = torch.cdist(removed, removed).amax(-1).amin()  # its centre's reach
    outside = torch.cdist(removed, found).amin(-1)
    assert_close(outside.min() > 0, torch.tensor(True))
    assert spread < torch.cdist(found, found).amax(-1).amin()


def test_a_camera_far_away_sees_one_half_of_a_ball_and_its_own_points() -> None:
    ball = torch.nn.functional.normalize(normal(0, 20, 4000, 3, dtype=torch.float32), dim=-1) / 4
    found = one_side(ball, 500, generator(1))
    assert found.shape == (20, 500, 3)
    assert torch.cdist(found, ball, compute_mode="donot_use_mm_for_euclid_dist").amin(-1).max() == 0
    middle = torch.nn.functional.normalize(found.mean(1), dim=-1)
    along = (found @ middle[..., None])[..., 0]
    assert (along > -0.08).float().mean() > 0.98  # a cell is seen a little past the edge
    assert along.quantile(0.5, dim=1).min() > 0.08
    assert middle.mean(0).norm() < 0.6  # from a direction of its own each


def test_what_is_behind_a_wall_is_not_seen() -> None:
    side = torch.linspace(-0.3, 0.3, 30)
    wall = torch.cartesian_prod(side, side)
    two = torch.cat([torch.nn.functional.pad(wall, (0, 1), value=z) for z in (-0.08, 0.08)])
    found = one_side(two.expand(40, -1, -1), 400, generator(1))
    front = (found[..., 2] > 0).float().mean(1)
    facing = torch.maximum(front, 1 - front)
    assert (facing > 0.75).float().mean() > 0.3
    assert bool((front < 0.15).any())
    assert bool((front > 0.85).any())
