# SPDX-License-Identifier: MIT
"""The pieces of the convolutions, each against the plain way of writing it."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from scapo.equivariant.anchors import icosahedron, turned
from scapo.equivariant.layers import ChannelNorm, PointPool, Skip, Spread, correlate, leaky, rows
from scapo.equivariant.levels import neighbourhood
from tests.helpers.strategies import normal

INDEX = torch.tensor([2, 0, 1, 0, 1, 2])


def test_spread_copies_rows() -> None:
    x = normal(0, 2, 3, 4)
    assert torch.equal(Spread(INDEX, 3)(x), x[:, INDEX])


def test_spread_has_the_numerical_gradient() -> None:
    x = normal(1, 2, 3, 2).requires_grad_()
    assert torch.autograd.gradcheck(Spread(INDEX, 3), (x,))
    assert torch.autograd.gradgradcheck(Spread(INDEX, 3), (x,))


def test_rows_must_be_copied_equally_often() -> None:
    with pytest.raises(ValueError, match=r"expected equal uses of all rows, found \[2, 1\]"):
        Spread(torch.tensor([0, 1, 0]), 2)


def test_tables_are_no_part_of_a_checkpoint() -> None:
    assert not Spread(INDEX, 3).state_dict()


def test_rows_are_those_of_their_own_cloud() -> None:
    values, index = normal(2, 3, 5, 4), torch.tensor([[[0, 4]], [[1, 1]], [[3, 0]]])
    wanted = torch.stack([values[b][index[b]] for b in range(3)])
    assert torch.equal(rows(values, index), wanted)


def test_correlations_by_loops() -> None:
    points, features = normal(3, 2, 12, 3), normal(4, 2, 12, 5, 3)
    near = neighbourhood(points, torch.tensor([[0, 7], [3, 1]]), 1.5, 4)
    found = correlate(features, near).unflatten(3, (5, 3))
    for b in range(2):
        for k in range(2):
            for p in range(13):
                total = sum(
                    (near.weight[b, k, p, place] * features[b, m]
                     for place, m in enumerate(near.index[b, k])), torch.zeros(5, 3)
                )  # fmt: skip
                assert_close(found[b, k, p], total)


def test_the_norm_is_batch_norm_of_channels() -> None:
    x = 3 + 2 * normal(5, 4, 6, 5, 3)
    out = ChannelNorm(3).double()(x)
    assert_close(out.mean((0, 1, 2)), torch.zeros(3, dtype=torch.float64), atol=1e-9, rtol=0)
    wanted = nn.BatchNorm1d(3).double()(x.view(-1, 3)).view_as(x)
    assert_close(out, wanted)


def test_the_skip_is_each_centres_own() -> None:
    points, features = normal(6, 1, 8, 3), normal(7, 1, 8, 2, 3)
    near = neighbourhood(points, torch.tensor([[5, 2]]), 1.0, 4)
    skip = Skip(3, 4).double().eval()
    assert_close(skip(features, near)[0, 1, 1], skip.norm(skip.linear(features[0, 2, 1])))


def test_a_skip_from_constant_features_is_the_same_in_training_and_after() -> None:
    points, ones = normal(6, 2, 8, 3), torch.ones(2, 8, 1, 1).double()
    near = neighbourhood(points, torch.tensor([[5, 2], [0, 1]]), 1.0, 4)
    skip = Skip(1, 4, norm=False).double()
    for _ in range(40):  # steps that running statistics would lag behind
        skip(ones, near)
        with torch.no_grad():
            skip.linear.weight.add_(0.1)
    assert torch.equal(skip.train()(ones, near), skip.eval()(ones, near))


@pytest.mark.parametrize("anchors", [60, 12])
def test_pooled_points_turn_with_the_cloud(anchors: int) -> None:
    pool = PointPool(3, 4, anchors).double()
    points, features = normal(8, 2, 9, 3), normal(9, 2, 9, anchors, 3)
    out = pool(features, points)
    assert out.shape == (2, anchors, 4)
    for g in (0, 1, 7, 33, 59):
        to = turned(g, anchors)
        other = torch.zeros_like(features)
        other[:, :, to] = features
        moved = points @ icosahedron().rotations[g].mT + 2
        assert_close(pool(other, moved)[:, to], out, atol=1e-6, rtol=1e-6)
    assert (out[:, 0] - out[:, 1]).abs().max() > 0.01


def test_leaky() -> None:
    x = torch.tensor([-2.0, 3.0])
    assert leaky(x, 0.0).tolist() == [0, 3]
    assert leaky(x, 0.5).tolist() == [-1, 3]
