# SPDX-License-Identifier: MIT
"""Small clusters apart from the object are left out; the object's own points and N stay."""

from __future__ import annotations

import torch
from strategies import generator

from scapo.stray_points import belongs, replaced, without_strays


def cloud(strays: int, seed: int = 0) -> torch.Tensor:
    """Two plates of 400 points each that do not touch, and strays on a far wall."""
    g = generator(seed)
    flat = torch.rand(800, 3, generator=g) * torch.tensor([0.3, 0.2, 0.0])
    flat[400:, 2] += 0.15
    wall = torch.rand(strays, 3, generator=g) * torch.tensor([0.1, 0.05, 0.0])
    return torch.cat([flat, wall + torch.tensor([0.1, 0.1, 0.8])])


def test_strays_are_told_from_parts_that_stand_apart():
    points = torch.stack([cloud(20), cloud(20, 1)])
    found = belongs(points)
    assert found[:, :800].float().mean() > 0.995
    assert not found[:, 800:].any()
    assert belongs(cloud(0)[None]).float().mean() > 0.995


def test_strays_are_replaced_by_points_of_the_object():
    points = cloud(20)[None]
    clean = without_strays(points)
    assert clean.shape == points.shape
    assert clean[0, :, 2].max() < 0.2
    mask = torch.tensor([[True, False, True, False, True]])
    five = torch.arange(5.0)[None, :, None].expand(1, 5, 3)
    assert replaced(five, mask)[0, :, 0].tolist() == [0, 0, 2, 2, 4]
