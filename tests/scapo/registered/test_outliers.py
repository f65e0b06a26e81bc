# SPDX-License-Identifier: MIT
"""Small clusters apart from the object are left out; the object's own points and N stay."""

from __future__ import annotations

import torch

from scapo.registered.outliers import inlier_mask, replaced
from tests.helpers.strategies import generator


def cloud(outliers: int, seed: int = 0) -> torch.Tensor:
    """Two plates of 400 points each that do not touch, and outliers on a far wall."""
    g = generator(seed)
    flat = torch.rand(800, 3, generator=g) * torch.tensor([0.3, 0.2, 0.0])
    flat[400:, 2] += 0.15
    wall = torch.rand(outliers, 3, generator=g) * torch.tensor([0.1, 0.05, 0.0])
    return torch.cat([flat, wall + torch.tensor([0.1, 0.1, 0.8])])


def test_outliers_are_told_from_parts_that_stand_apart():
    points = torch.stack([cloud(20), cloud(20, 1)])
    found = inlier_mask(points)
    assert found[:, :800].float().mean() > 0.995
    assert not found[:, 800:].any()
    assert inlier_mask(cloud(0)[None]).float().mean() > 0.995


def test_repeated_points_of_a_sparse_view_belong_together():
    g = generator(5)
    sparse = cloud(20, 2)[torch.randperm(820, generator=g)[:160]]
    filled = sparse[torch.randint(160, (1024,), generator=g)]
    found = inlier_mask(filled[None])[0]
    assert found[filled[:, 2] < 0.2].float().mean() > 0.98
    assert inlier_mask(torch.ones(1, 50, 3)).all()


def test_large_clouds_are_told_by_their_neighbours():
    g = generator(6)
    large = cloud(20, 3).repeat(10, 1)
    large = large + 0.0005 * torch.randn(large.shape, generator=g)
    found = inlier_mask(large[None])[0]
    assert found[large[:, 2] < 0.3].float().mean() > 0.995
    assert not found[large[:, 2] > 0.5].any()


def test_outliers_are_replaced_by_points_of_the_object():
    points = cloud(20)[None]
    clean = replaced(points, inlier_mask(points))
    assert clean.shape == points.shape
    assert clean[0, :, 2].max() < 0.2
    mask = torch.tensor([[True, False, True, False, True]])
    five = torch.arange(5.0)[None, :, None].expand(1, 5, 3)
    assert replaced(five, mask)[0, :, 0].tolist() == [0, 0, 2, 2, 4]
