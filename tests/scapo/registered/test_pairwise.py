# SPDX-License-Identifier: MIT
"""Registration: the grid's spacing, nearest points against brute force, known poses found."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations, rotation_angle
from scapo.registered.pairwise import (
    CELLS,
    EXTENT,
    NearestGrid,
    distinct,
    icp,
    plane_step,
    register_pairs,
    rotation_grid,
)
from tests.helpers.sighted import sighted
from tests.helpers.strategies import generator, is_rotation


def angles(a: Tensor, b: Tensor) -> Tensor:
    """Degrees between rotations of shapes that broadcast."""
    return rotation_angle(*torch.broadcast_tensors(a, b)).rad2deg()


def test_the_grid_is_spread_over_all_rotations():
    grid = rotation_grid(1000)
    assert bool(is_rotation(grid).all())
    random = random_rotations(200, generator(0))
    gaps = angles(random[:, None], grid[None]).amin(1)
    assert gaps.max() < 30
    assert gaps.mean() < 17


def test_nearest_points_of_the_grid_are_near():
    points = 0.4 * torch.rand(2, 50, 3, generator=generator(1)) - 0.2
    grid = NearestGrid.build(points, points)
    query = points[:, :20] + 0.001
    found, _ = grid.lookup(torch.tensor([0, 1]), query)
    best = torch.cdist(query, points).amin(-1)
    assert bool(((query - found).norm(dim=-1) <= best + 3**0.5 * 2 * EXTENT / CELLS).all())


def test_distinct_keeps_the_best_and_skips_its_neighbours():
    rotation = rotation_grid(300)[None]
    score = torch.rand(1, 300, generator=generator(2))
    chosen = distinct(rotation, score, 4, 40.0)[0]
    assert chosen[0] == score.argmin()
    apart = angles(rotation[0, chosen][:, None], rotation[0, chosen][None])
    assert (apart + 360 * torch.eye(4)).min() > 40


def test_a_plane_step_undoes_a_small_motion():
    g = generator(3)
    target = torch.randn(1, 60, 3, generator=g)
    normal = torch.nn.functional.normalize(torch.randn(1, 60, 3, generator=g), dim=-1)
    angle = torch.tensor(0.01)
    turn = torch.tensor(
        [[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1.0]]
    )
    moved = target @ turn.T + torch.tensor([0.01, -0.02, 0.005])
    back, shift = plane_step(moved, target, normal, torch.ones(1, 60))
    assert_close(moved @ back.mT + shift[:, None], target, atol=3e-4, rtol=0)


def test_two_views_of_one_object_are_registered():
    views, truth = sighted(3, seed=4)
    pairs = torch.tensor([[0, 1], [2, 1]])
    base = truth.rotation[pairs[:, 1]] @ truth.rotation[pairs[:, 0]].mT
    modes = register_pairs(views, pairs, rotations=rotation_grid(1000))
    assert bool((modes.score.diff(dim=-1) >= -1e-6).all())
    errors = angles(modes.rotation, base[:, None])
    assert errors.amin(1).max() < 12
    same = torch.tensor([[0, 0]])
    start = rotation_grid(1)[0] * 0 + torch.eye(3)
    rotation, translation = icp(views, same, start[None], torch.full((1, 3), 0.03))
    assert_close(rotation[0], torch.eye(3), atol=2e-2, rtol=0)
    assert translation.norm() < 0.5 * 0.03 * 3**0.5
