# SPDX-License-Identifier: MIT
"""Layers of vectors: they turn and move with their input, and start from their generator alone."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from torch import nn
from torch.testing import assert_close

from scapo.first_weights import initialise
from scapo.paper import vector_neurons as vn
from tests.helpers.strategies import generator, normal, rotations, seeds

quick = settings(max_examples=10, deadline=None)
CHANNELS = 5


def made(module: nn.Module, seed: int) -> nn.Module:
    """In double precision, with drawn weights and batch statistics of some data."""
    initialise(module, generator(seed))
    module.double()
    for k in range(20):
        module(normal(seed + k, 40, 3, CHANNELS))
    return module.eval()


@quick
@given(seed=seeds)
@pytest.mark.parametrize("form", ["scale", "length"])
@pytest.mark.parametrize("affine", [False, True])
def test_blocks_turn_with_their_input(form: vn.NormForm, affine: bool, seed: int) -> None:
    block = made(vn.VNBlock(CHANNELS, 7, affine=affine, norm=form), seed)
    x, turn = normal(seed, 6, 3, CHANNELS), rotations(seed + 1)
    assert_close(block(turn @ x), turn @ block(x), atol=1e-10, rtol=1e-10)


@quick
@given(seed=seeds)
@pytest.mark.parametrize("form", ["scale", "length"])
def test_affine_blocks_move_with_their_input(form: vn.NormForm, seed: int) -> None:
    block = made(vn.VNBlock(CHANNELS, 7, affine=True, norm=form), seed)
    linear = made(vn.VNLinear(CHANNELS, 2, affine=True), seed)
    x, shift = normal(seed, 6, 3, CHANNELS), normal(seed + 1, 1, 3, 1)
    assert_close(block(x + shift), block(x) + shift, atol=1e-10, rtol=1e-10)
    assert_close(linear(x + shift), linear(x) + shift, atol=1e-12, rtol=1e-12)


def test_plain_blocks_do_not_move_with_their_input() -> None:
    block = made(vn.VNBlock(CHANNELS, 7), 0)
    x = normal(0, 6, 3, CHANNELS)
    assert (block(x + 1) - block(x) - 1).abs().max() > 0.1


def test_rectify_removes_only_what_points_backwards() -> None:
    direction = torch.tensor([[0.0, 0.0], [0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
    x = torch.tensor([[1.0, 1.0], [0.0, 0.0], [-3.0, 3.0]], dtype=torch.float64)
    expected = torch.tensor([[1.0, 1.0], [0.0, 0.0], [0.0, 3.0]], dtype=torch.float64)
    assert_close(vn.rectify(x, direction), expected, atol=1e-5, rtol=0)


def test_the_scale_norm_makes_lengths_one() -> None:
    norm = vn.VNBatchNorm(3).double()
    x = 7 * normal(1, 500, 3, 3)
    rows = normal(2, 3, 3)
    out = [norm(x, rows) for _ in range(200)][-1]
    wanted = x @ rows.mT
    assert_close(out, wanted / wanted.square().sum(-2).mean(0).sqrt())
    assert_close(norm.eval()(x, rows), out, atol=1e-6, rtol=1e-6)


def test_the_length_norm_is_batch_norm_of_the_lengths() -> None:
    x = normal(2, 50, 3, 3)
    out = vn.VNBatchNorm(3, form="length").double()(x, torch.eye(3, dtype=torch.float64))
    length = x.norm(dim=-2)
    wanted = (length - length.mean(0)) / (length.var(0, unbiased=False) + 1e-5).sqrt()
    assert_close((out * x).sum(-2) / length, wanted, atol=1e-9, rtol=1e-9)


def test_initialise_repeats_and_leaves_the_global_state_alone() -> None:
    def weights(seed: int) -> torch.Tensor:
        with torch.random.fork_rng(devices=[]):
            module = nn.Sequential(vn.VNBlock(3, 4), nn.Linear(4, 2))
        before = torch.get_rng_state()
        initialise(module, generator(seed))
        assert torch.equal(before, torch.get_rng_state())
        return torch.cat([p.flatten() for p in module.parameters()])

    assert torch.equal(weights(3), weights(3))
    assert not torch.equal(weights(3), weights(4))


@pytest.mark.parametrize("form", ["point", "mean"])
def test_edges_turn_with_the_cloud(form: vn.EdgeForm) -> None:
    points, turn = normal(0, 2, 60, 3), rotations(1)
    edges = vn.edge_vectors(points, points[:, :9], 5, form)
    turned = vn.edge_vectors(points @ turn.mT, points[:, :9] @ turn.mT, 5, form)
    assert edges.shape == (2, 9, 5, 3, 3)
    assert_close(turned, turn @ edges, atol=1e-12, rtol=1e-12)


def test_edges_by_hand() -> None:
    points = torch.tensor([[[1.0, 0.0, 0.0], [1.0, 0.5, 0.0], [5.0, 5.0, 5.0]]])
    edge = vn.edge_vectors(points, points[:, :1], 2)[0, 0, 1]  # to the second point
    assert edge[:, 0].tolist() == [0.0, 0.5, 0.0]
    assert edge[:, 1].tolist() == [1.0, 0.0, 0.0]
    assert edge[:, 2].tolist() == [0.0, 0.0, -0.5]
    mean = vn.edge_vectors(points, points[:, :1], 2, "mean")[0, 0, 1]
    assert mean[:, 0].tolist() == [0.0, 0.25, 0.0]
    assert mean[:, 1].tolist() == [1.0, 0.25, 0.0]


def test_centres_do_not_depend_on_order_or_pose() -> None:
    points = normal(5, 2, 100, 3)
    order = torch.randperm(100, generator=generator(6))
    moved = points @ rotations(7).mT + 3
    first = vn.spread_centres(points, 10, 100)
    assert first.shape == (2, 10)
    assert len(set(first[0].tolist())) == 10
    assert torch.equal(first, vn.spread_centres(moved, 10, 100))
    assert torch.equal(first, order[vn.spread_centres(points[:, order], 10, 100)])
    far = (points - points.mean(1, keepdim=True)).norm(dim=-1).argmax(1)
    assert torch.equal(first[:, 0], far)


def test_centres_of_a_cloud_with_few_different_points() -> None:
    points = torch.zeros(1, 50, 3)
    points[0, 0, 0] = 1.0
    assert vn.spread_centres(points, 5, 50).shape == (1, 5)


def test_gradients_by_hand_are_the_numerical_ones() -> None:
    x, d = normal(1, 4, 3, 5).requires_grad_(), normal(2, 4, 3, 5).requires_grad_()
    assert torch.autograd.gradcheck(vn.rectify, (x, d))


@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("form", ["scale", "length"])
def test_a_block_in_training_is_its_formula(form: vn.NormForm, affine: bool) -> None:
    block = vn.VNBlock(CHANNELS, 7, affine=affine, norm=form)
    made(block, 3).train()
    x = normal(4, 50, 3, CHANNELS).requires_grad_()
    feature, direction = block.feature(x), block.direction(x)
    centre = feature.mean(-1, keepdim=True) if affine else 0
    about = feature - centre
    length = about.norm(dim=-2)
    norm = block.norm.norm
    if isinstance(norm, vn.VectorScale):
        scale = norm.gain / length.square().mean(0).sqrt()
    else:
        spread = (length - length.mean(0)) / (length.var(0, unbiased=False) + 1e-5).sqrt()
        scale = (spread * norm.weight + norm.bias) / length
    feature = about * scale[..., None, :] + centre
    origin = block.origin(x) if block.origin is not None else 0
    wanted = vn.rectify(feature - origin, direction - origin) + origin
    assert_close(block(x), wanted, atol=1e-9, rtol=1e-9)
    of = [x, *block.parameters()]
    found, expected = (torch.autograd.grad(out.square().sum(), of) for out in (block(x), wanted))
    assert_close(found, expected, atol=1e-7, rtol=1e-7)
