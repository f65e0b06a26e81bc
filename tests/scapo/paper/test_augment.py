# SPDX-License-Identifier: MIT
"""Disturbances keep the pose and come from their generator alone."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from scapo.paper.augment import DISTURBANCES, Disturbance, disturb, random_pose
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
