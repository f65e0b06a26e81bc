# SPDX-License-Identifier: MIT
"""Groups of points, their weights at the kernel's points, and levels that share them."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial import KDTree
from torch.testing import assert_close

from scapo.equivariant.levels import (
    LevelConfig,
    in_ball,
    kernel_points,
    levels,
    neighbourhood,
    sample,
)
from scapo.geometry.points import farthest_points, gather
from tests.helpers.strategies import normal, rotations


def test_balls_are_a_trees_in_the_order_of_the_cloud() -> None:
    points = normal(0, 1, 80, 3)
    index, inside = in_ball(points[:, :20], points, 0.9, 6)
    found = KDTree(points[0].numpy()).query_ball_point(points[0, :20].numpy(), 0.9)
    assert any(len(some) > 6 for some in found)
    assert any(len(some) < 6 for some in found)
    for k, some in enumerate(found):
        wanted = sorted(some)[:6]
        assert index[0, k][inside[0, k]].tolist() == wanted


def test_a_small_cloud_has_small_groups() -> None:
    index, inside = in_ball(normal(1, 2, 3, 3), normal(1, 2, 3, 3), 0.1, 9)
    assert index.shape == inside.shape == (2, 3, 3)
    assert inside.sum() == 6  # each finds itself


def test_the_kernel_is_a_shell_and_its_centre() -> None:
    kernel = kernel_points(2.0)
    assert_close(kernel[:12].norm(dim=1), torch.full((12,), 1.4, dtype=torch.float64))
    assert kernel[12].tolist() == [0, 0, 0]


def test_weights_by_hand() -> None:
    points = normal(2, 1, 30, 3)
    centre = torch.tensor([[4, 9]])
    near = neighbourhood(points, centre, 1.2, 5)
    for k in range(2):
        middle = points[0, centre[0, k]]
        within = [m for m in range(30) if math.dist(points[0, m], middle) <= 1.2][:5]
        for kernel, p in enumerate(kernel_points(1.2)):
            for place, m in enumerate(within):
                square = math.dist(points[0, m] - middle, p) ** 2
                wanted = max(0.0, 1 - square / (0.5 * 1.2**2)) / len(within)
                assert float(near.weight[0, k, kernel, place]) == pytest.approx(wanted, abs=1e-12)
        assert (near.weight[0, k, :, len(within) :] == 0).all()
    assert near.index.shape == (1, 2, 5)


def test_neighbours_carry_no_gradient_and_move_with_the_cloud() -> None:
    points = normal(3, 2, 40, 3).requires_grad_()
    centre = sample(points, 4, "stride")
    near = neighbourhood(points, centre, 0.8, 8)
    assert not near.weight.requires_grad
    moved = neighbourhood(points.detach() + torch.tensor([1.0, 2.0, 3.0]), centre, 0.8, 8)
    assert torch.equal(near.index, moved.index)
    assert_close(near.weight, moved.weight)


def test_samples() -> None:
    points = normal(4, 2, 20, 3)
    assert sample(points, 3, "stride").tolist() == [[0, 3, 6, 9, 12, 15]] * 2
    assert torch.equal(sample(points, 4, "farthest"), farthest_points(points, 5))
    assert sample(points, 1, "farthest").tolist() == [list(range(20))] * 2
    assert sample(points[:, :2], 4, "stride").tolist() == [[0], [0]]


def test_equal_layers_share_their_neighbours() -> None:
    first, second = (LevelConfig(radius=r, neighbours=6, stride=2) for r in (0.5, 0.9))
    inner = LevelConfig(radius=0.9, neighbours=6)
    points = normal(5, 2, 32, 3)
    near, ends = levels(points, (first, second, inner, inner), "stride")
    assert [end.shape[1] for end in ends] == [16, 8, 8, 8]
    assert near[3] is near[2] is not near[1]
    assert_close(ends[0], points[:, ::2])
    assert_close(gather(ends[0], near[1].centre), ends[1])


def test_levels_do_not_depend_on_the_pose() -> None:
    points, turn = normal(6, 2, 40, 3), rotations(7)
    layers = (LevelConfig(radius=0.8, neighbours=8, stride=2),)
    (near,), _ = levels(points, layers, "farthest")
    (other,), _ = levels(points @ turn.mT, layers, "farthest")
    assert torch.equal(near.centre, other.centre)
    assert torch.equal(near.index, other.index)
