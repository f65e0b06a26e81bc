# SPDX-License-Identifier: MIT
"""Every term of OP-Align against a naive twin in numpy; gradients against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.baselines.op_align import losses
from scapo.paper.heads import JointPairs
from tests.helpers.strategies import normal, unit_vectors


def cloud(seed: int, *shape: int) -> Tensor:
    return 0.2 * normal(seed, *shape, 3)


def simplex(seed: int, *shape: int) -> Tensor:
    return torch.softmax(2 * normal(seed, *shape), -1)


def nearest_squares(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """By the whole table of distances."""
    return ((source[:, None] - target[None]) ** 2).sum(-1).min(1)


def two_way(a: np.ndarray, b: np.ndarray) -> float:
    there = np.mean([1 - np.exp(-30 * d) for d in nearest_squares(a, b)])
    back = np.mean([1 - np.exp(-120 * d) for d in nearest_squares(b, a)])
    return float(there + 0.25 * back)


def test_rigid_is_the_two_way_robust_distance() -> None:
    a, b = cloud(0, 3, 20), cloud(1, 3, 15)
    expected = np.mean([two_way(x, y) for x, y in zip(a.numpy(), b.numpy(), strict=True)])
    assert float(losses.rigid(a, b)) == pytest.approx(expected, rel=1e-6)
    assert float(losses.rigid(a, a)) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("parts", [2, 3])
def test_articulated_weighs_points_by_their_parts(parts: int) -> None:
    moved, shape = cloud(0, 2, parts, 12), cloud(1, 2, 9)
    weights, shape_weights = simplex(2, 2, 12, parts), simplex(3, 2, 9, parts)
    total = 0.0
    for b in range(2):
        for p in range(parts):
            d = nearest_squares(moved[b, p].numpy(), shape[b].numpy())
            total += (weights[b, :, p].numpy() * (1 - np.exp(-30 * d))).mean() / 2
            d = nearest_squares(shape[b].numpy(), moved[b, p].numpy())
            total += 0.25 * (shape_weights[b, :, p].numpy() * (1 - np.exp(-120 * d))).mean() / 2
    found = losses.articulated(moved, shape, weights, shape_weights)
    assert float(found) == pytest.approx(total, rel=1e-6)


def test_articulated_with_one_part_alone_is_rigid() -> None:
    a, b = cloud(0, 2, 12), cloud(1, 2, 9)
    moved = torch.stack([a, a + 5.0], 1)
    one, other = (torch.tensor([1.0, 0.0]).double().expand(2, n, 2) for n in (12, 9))
    torch.testing.assert_close(losses.articulated(moved, b, one, other), losses.rigid(a, b))


def test_colours_count_as_further_coordinates() -> None:
    moved, shape = normal(0, 1, 1, 8, 6), normal(1, 1, 7, 6)
    one = torch.ones(1, 8, 1).double(), torch.ones(1, 7, 1).double()
    there = np.mean(1 - np.exp(-30 * nearest_squares(moved[0, 0].numpy(), shape[0].numpy())))
    back = np.mean(1 - np.exp(-120 * nearest_squares(shape[0].numpy(), moved[0, 0].numpy())))
    assert float(losses.articulated(moved, shape, *one)) == pytest.approx(there + back / 4)


def test_density_is_the_variance_of_neighbour_distances() -> None:
    shape = cloud(0, 2, 30)
    expected = 0.0
    for points in shape.numpy():
        distance = KDTree(points).query(points, 6)[0][:, 1:]
        expected += np.mean([np.var(distance[:, k], ddof=1) for k in range(5)]) / 2
    assert float(losses.density(shape, 5)) == pytest.approx(expected, rel=1e-6)


def test_density_of_an_even_shape_is_zero() -> None:
    turns = 2 * torch.pi * torch.arange(40).double() / 40
    circle = torch.stack([turns.cos(), turns.sin(), torch.zeros(40).double()], -1)[None]
    assert float(losses.density(circle, 6)) == pytest.approx(0, abs=1e-12)


def test_centroid() -> None:
    shape = cloud(0, 3, 10)
    expected = np.mean([np.linalg.norm(points.mean(0)) ** 2 for points in shape.numpy()])
    assert float(losses.centroid(shape)) == pytest.approx(expected)


def test_pivots_are_drawn_to_their_eight_nearest_points() -> None:
    pivot, points = cloud(0, 2, 2), cloud(1, 2, 40)
    expected = []
    for b in range(2):
        for j in range(2):
            near = np.sort(np.linalg.norm(points[b].numpy() - pivot[b, j].numpy(), axis=1))[:8]
            expected.append(1 - np.exp(-30 * near.mean() ** 2))
    found = losses.pivot_near_points(pivot, points)
    assert float(found) == pytest.approx(np.mean(expected), rel=1e-6)
    points.requires_grad_()
    pivot.requires_grad_()
    losses.pivot_near_points(pivot, points).backward()
    assert points.grad is None
    assert pivot.grad is not None
    assert float(pivot.grad.abs().sum()) > 0


def pairs(seed: int) -> JointPairs:
    return JointPairs(
        pivot=cloud(seed, 3, 2), axis=unit_vectors(seed + 1, 3, 2), state=normal(seed + 2, 3, 2, 2)
    )


def test_same_turn_compares_the_rotations_of_two_joints() -> None:
    source, target = pairs(0), pairs(10)
    expected = 0.0
    for b in range(3):
        turns = []
        for j in range(2):
            a, c = source.axis[b, j].numpy(), target.axis[b, j].numpy()
            normal_ = np.cross(a, c)
            angle = np.arctan2(np.linalg.norm(normal_), a @ c)
            turns.append(
                Rotation.from_rotvec(angle * normal_ / np.linalg.norm(normal_)).as_matrix()
            )
        expected += np.mean((turns[0] - turns[1]) ** 2) / 3
    assert float(losses.same_turn(source, target)) == pytest.approx(expected, rel=1e-6)


def test_same_base_is_the_mean_square_distance() -> None:
    one, other = cloud(0, 2, 5), cloud(1, 2, 5)
    expected = np.mean(np.linalg.norm(one.numpy() - other.numpy(), axis=-1) ** 2)
    assert float(losses.same_base(one, other)) == pytest.approx(expected)


def test_attention_is_the_expected_distance() -> None:
    weight, distance = simplex(0, 4, 60), normal(1, 4, 60).abs()
    expected = np.mean([w @ d for w, d in zip(weight.numpy(), distance.numpy(), strict=True)])
    assert float(losses.attention(weight, distance)) == pytest.approx(expected)


def test_part_share_asks_for_points_and_for_doubt() -> None:
    even = torch.full((2, 10, 2), 0.5)
    assert float(losses.part_share(even, even)) == 0
    first = torch.tensor([1.0, 0.0]).expand(2, 10, 2)
    # An empty part of two costs half of 0.05; weights of 0 cost 0.01 in either shape.
    assert float(losses.part_share(first, first)) == pytest.approx(0.05 / 2 + 0.01 + 0.01)
    assert float(losses.part_share(first, even)) == pytest.approx(0.01)


@pytest.mark.parametrize("block", [1, 1 << 15])
def test_hypothesis_distances_are_those_of_brute_force(
    block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(losses, "BLOCK", block)
    aligned, shape = cloud(0, 2, 60, 7), cloud(1, 2, 11)
    expected = np.zeros((2, 60))
    for b in range(2):
        for k in range(60):
            table = np.abs(aligned[b, k].numpy()[:, None] - shape[b].numpy()[None]).sum(-1)
            expected[b, k] = table.min(1).mean()
    np.testing.assert_allclose(losses.hypothesis_distances(aligned, shape).numpy(), expected)


def test_gradients_pass_through_the_matched_points() -> None:
    shape, weights = cloud(1, 1, 9), (simplex(2, 1, 8, 2), simplex(3, 1, 9, 2))
    moved = cloud(0, 1, 2, 8).requires_grad_()
    shape.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda a, b: losses.articulated(a, b, *weights), (moved, shape), atol=1e-6
    )
    assert torch.autograd.gradcheck(lambda b: losses.density(b, 4), (shape,), atol=1e-6)
