# SPDX-License-Identifier: MIT
"""Every term of EAP against a naive twin in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.baselines.eap import losses
from tests.helpers.strategies import normal, unit_vectors


def cloud(seed: int, *shape: int) -> Tensor:
    return 0.2 * normal(seed, *shape, 3)


def nearest_squares(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """By the whole table of distances."""
    return ((source[:, None] - target[None]) ** 2).sum(-1).min(1)


def two_way(a: Tensor, b: Tensor) -> float:
    one, other = a.numpy(), b.numpy()
    return float(nearest_squares(one, other).mean() + nearest_squares(other, one).mean())


def test_shape_distances_are_two_way_for_every_hypothesis() -> None:
    clouds, shape = cloud(0, 2, 60, 9), cloud(1, 2, 7)
    found = losses.shape_distances(clouds, shape).numpy()
    expected = [[two_way(clouds[b, k], shape[b]) for k in range(60)] for b in range(2)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_every_point_answers_for_every_slot_by_its_weight() -> None:
    posed, points = cloud(0, 2, 3, 4, 6), cloud(1, 2, 12)
    weights = torch.softmax(3 * normal(2, 2, 12, 3), -1)
    weights[1, :, 2] = 0
    found = losses.slot_distances(posed, points, weights)
    for b in range(2):
        for k in range(4):
            expected = sum(
                weights[b, :, s].numpy()
                @ nearest_squares(points[b].numpy(), posed[b, s, k].numpy())
                / 12
                for s in range(3)
            )
            assert float(found[b, k]) == pytest.approx(expected, rel=1e-6)


def test_weights_are_drawn_to_the_slot_that_fits_better() -> None:
    points = torch.cat([cloud(0, 1, 10), 3 + cloud(1, 1, 10)], 1)
    posed = points.unflatten(1, (2, 1, 10))
    logits = torch.zeros(1, 20, 2).double()
    logits[..., 0] = 0.1  # the first slot has won all, the second fits half of them
    logits.requires_grad_()
    losses.slot_distances(posed, points, torch.softmax(logits, -1)).sum().backward()
    gradient = logits.grad
    assert gradient is not None
    assert (gradient[0, 10:, 0] > 0).all()
    assert (gradient[0, 10:, 1] < 0).all()
    assert (gradient[0, :10, 0] < 0).all()


def test_whole_leaves_out_slots_without_points() -> None:
    posed, points = cloud(0, 2, 3, 6), cloud(1, 2, 12)
    present = torch.tensor([[False, True, True], [True, False, False]])
    posed.requires_grad_()
    found = losses.whole(posed, points, present)
    expected = [two_way(points[b], posed.detach()[b, present[b]].flatten(0, 1)) for b in range(2)]
    assert float(found.detach()) == pytest.approx(np.mean(expected), rel=1e-6)
    found.backward()
    gradient = posed.grad
    assert gradient is not None
    assert (gradient[~present] == 0).all()
    everything = losses.whole(posed.detach(), points, torch.ones(2, 3, dtype=torch.bool))
    expected = [two_way(points[b], posed.detach()[b].flatten(0, 1)) for b in range(2)]
    assert float(everything) == pytest.approx(np.mean(expected), rel=1e-6)


def test_pivots_and_their_shifts_are_near_both_parts() -> None:
    pivot, axis, pairs = cloud(0, 2, 2), unit_vectors(1, 2), cloud(2, 2, 2, 2, 5)
    steps = torch.tensor([0.05, 0.2]).double()
    expected = 0.0
    for b in range(2):
        for j in range(2):
            for side in range(2):
                for step in (0.0, 0.05, 0.2):
                    point = (pivot[b, j] - step * axis[b]).numpy()
                    near = nearest_squares(point[None], pairs[b, j, side].numpy())[0]
                    expected += 4 / 2 * near / 2
    found = losses.pivots_near_parts(pivot, axis, pairs, steps)
    assert float(found) == pytest.approx(expected, rel=1e-6)
    pivot.requires_grad_()
    pairs.requires_grad_()
    losses.pivots_near_parts(pivot, axis, pairs, steps).backward()
    assert pairs.grad is None
    assert pivot.grad is not None
