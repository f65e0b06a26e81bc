# SPDX-License-Identifier: MIT
"""PointNet++'s layers against plain loops, its size, and its groups."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from bench.baselines.body import Block
from bench.baselines.pointnet2 import (
    Groups,
    PointNet2Body,
    PointNet2Config,
    cpu_config,
    in_balls,
    interpolate,
    interpolation,
)
from scapo.first_weights import initialise
from scapo.geometry.points import farthest_points, gather
from tests.helpers.strategies import generator, normal


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_body_has_the_published_size() -> None:
    assert parameters(PointNet2Body(PointNet2Config())) == pytest.approx(1.74e6, rel=0.05)
    assert parameters(PointNet2Body(cpu_config())) < 0.5e6


def test_balls_against_loops() -> None:
    points = normal(0, 2, 40, 3).float()
    centres = points[:, ::4]
    radii, samples = (0.5, 1.0, 9.0), (4, 6, 50)
    found = in_balls(centres, points, radii, samples)
    sizes = set()
    for radius, count, index in zip(radii, samples, found, strict=True):
        assert index.shape == (2, 10, min(count, 40))
        for b in range(2):
            for s in range(10):
                inside = (points[b] - centres[b, s]).norm(dim=1) <= radius
                first = inside.nonzero()[:, 0][:count].tolist()
                sizes.add(len(first))
                padded = first + first[:1] * (min(count, 40) - len(first))
                assert index[b, s].tolist() == padded
    assert len(sizes) > 4  # crowded groups, and groups of one


@pytest.mark.parametrize("there", [1, 2, 30])
def test_interpolation_against_loops(there: int) -> None:
    here, points = normal(0, 2, 20, 3).float(), normal(1, 2, there, 3).float()
    values = normal(2, 2, there, 5).float()
    found = interpolate(values, *interpolation(here, points))
    for b in range(2):
        for n in range(20):
            square = (points[b] - here[b, n]).square().sum(1)
            near = square.sort().indices[:3]
            weight = 1 / (square[near] + 1e-9)
            expected = (weight[:, None] * values[b, near]).sum(0) / weight.sum()
            assert_close(found[b, n], expected, atol=1e-4, rtol=1e-3)
    there_itself = interpolate(values, *interpolation(points, points))
    assert_close(there_itself, values, atol=1e-4, rtol=0)


def test_groups_against_loops() -> None:
    """The first layer on points and centres apart is the layer on offsets and features."""
    groups = Groups(5, (7, 6))
    initialise(groups, generator(0))
    groups.double()
    points, features = normal(1, 2, 20, 3), normal(2, 2, 20, 5)
    centres = points[:, :4]
    (index,) = in_balls(centres.float(), points.float(), (1.5,), (6,))
    found = groups(points, features, centres, index)
    rows = [
        torch.cat([points[b, n] - centres[b, s], features[b, n]])
        for b in range(2) for s in range(4) for n in index[b, s].tolist()
    ]  # fmt: skip
    x = torch.stack(rows)
    for layer in groups.layers:
        assert isinstance(layer, Block)
        x = layer.linear(x)
        x = (x - x.mean(0)) / (x.var(0, unbiased=False) + 1e-5).sqrt()  # as batch norm starts
        assert torch.equal(layer.norm.weight, torch.ones(x.shape[1]).double())
        x = F.relu(x)
    assert_close(found, x.view(2, 4, 6, 6).amax(2))


def test_the_whole_body_against_its_parts() -> None:
    """Levels are joined as published: the way back meets the features of the way in."""
    body = PointNet2Body(cpu_config())
    initialise(body, generator(0))
    body.eval()
    points = normal(0, 2, 90, 3).float()
    found = body(points, None)
    assert found.points.shape == (2, 90, body.features)
    assert found.code.shape == (2, body.code)
    centres = gather(points, farthest_points(points, 64))
    near = torch.cat(
        [
            groups(points, points, centres, index)
            for groups, index in zip(
                body.near, in_balls(centres, points, (0.1, 0.2, 0.4), (8, 12, 16)), strict=True
            )
        ],
        -1,
    )
    middles = gather(centres, farthest_points(centres, 16))
    far = torch.cat(
        [
            groups(centres, near, middles, index)
            for groups, index in zip(
                body.far, in_balls(middles, centres, (0.4, 0.8), (8, 16)), strict=True
            )
        ],
        -1,
    )
    assert_close(found.code, body.whole(torch.cat([middles, far], -1)).amax(1))


@pytest.mark.parametrize("count", [1, 3, 30])
def test_clouds_smaller_than_the_network_are_taken(count: int) -> None:
    body = PointNet2Body(cpu_config()).eval()
    found = body(normal(0, 2, count, 3).float(), None)
    assert found.points.shape[:2] == (2, count)
    assert bool(torch.isfinite(found.points).all())


def test_a_cloud_in_another_order_has_the_same_code_where_groups_are_not_full() -> None:
    """But for the first centre and for crowded balls, which go by the order."""
    config = PointNet2Config(
        centres=(12, 12), near_samples=(12, 12, 12), far_samples=(12, 12),
        near_widths=((4, 8),) * 3, far_widths=((8, 8),) * 2, whole_widths=(16,),
        back_widths=((8,), (8,), (8,)),
    )  # fmt: skip
    body = PointNet2Body(config).eval()
    points = normal(0, 2, 12, 3).float()
    mixed = torch.randperm(12, generator=generator(1))
    one, two = body(points, None), body(points[:, mixed], None)
    assert_close(two.code, one.code)
    assert_close(two.points, one.points[:, mixed])
