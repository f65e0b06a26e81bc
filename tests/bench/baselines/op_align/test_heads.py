# SPDX-License-Identifier: MIT
"""OP-Align's heads: hypotheses near their anchors, a code that does not turn, shared statistics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from bench.baselines.op_align.heads import (
    Decoder,
    DecoderConfig,
    HypothesisConfig,
    HypothesisHead,
    PointNetConfig,
    PointNetwork,
)
from bench.baselines.op_align.method import OpAlign, cpu_config
from scapo.categories import CATEGORIES
from scapo.first_weights import initialise
from tests.helpers.strategies import generator, is_rotation, normal

ANCHORS = torch.from_numpy(Rotation.create_group("I").as_matrix()).float()
SMALL = HypothesisConfig(pooled=8, width=16, hidden=8, code=6)


def head(config: HypothesisConfig = SMALL) -> HypothesisHead:
    made = HypothesisHead(config, 12, ANCHORS)
    initialise(made, generator(0))
    with torch.no_grad():
        made.turn.weight.mul_(30)
        made.shift.weight.copy_(normal(4, 3, 8))
    return made.eval()


@pytest.mark.parametrize("reach", [math.pi / 10, math.pi / 4])
@torch.no_grad()
def test_hypotheses_stay_within_the_range_of_their_anchors(reach: float) -> None:
    said = head(replace(SMALL, residual_range=reach))(normal(0, 3, 60, 12).float())
    assert is_rotation(said.rotation).all()
    turn = (ANCHORS.mT @ said.rotation).double().numpy()
    angle = Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude()
    assert angle.max() <= reach + 1e-5
    assert angle.max() > reach / 2
    assert_close(said.attention.sum(-1), torch.ones(3))


def test_the_published_range_leaves_gaps_and_the_lean_one_none() -> None:
    some = Rotation.random(4000, rng=np.random.default_rng(0))
    group = Rotation.create_group("I")
    off = np.min([(one.inv() * some).magnitude() for one in group], 0)
    assert np.degrees(off.mean()) == pytest.approx(29.6, abs=0.3)
    assert HypothesisConfig().residual_range == pytest.approx(math.pi / 10)
    assert (off > HypothesisConfig().residual_range).mean() > 0.8
    assert off.max() < cpu_config().hypotheses.residual_range


@torch.no_grad()
def test_shapes_and_translations_start_where_gradients_reach_them() -> None:
    made = OpAlign(cpu_config(), CATEGORIES["laptop"], generator(0)).train()
    said = made.head(normal(0, 16, 60, made.backbone.outputs).float())
    assert not said.translation.any()
    assert not made.decoder(said.code).offset.any()


@torch.no_grad()
def test_another_order_of_the_rotations_orders_the_residuals_and_leaves_the_code() -> None:
    made, x = head(), normal(1, 2, 60, 12).float()
    order = torch.randperm(60, generator=generator(2))
    one, other = made(x), made(x[:, order])
    assert_close(other.code, one.code)
    assert_close(other.translation, one.translation[:, order])
    assert_close(
        ANCHORS.mT @ other.rotation, (ANCHORS.mT @ one.rotation)[:, order], atol=1e-5, rtol=0
    )


def test_the_decoder_moves_a_shared_base() -> None:
    decoder = Decoder(DecoderConfig(width=8, points=20), 6, color=False)
    initialise(decoder, generator(0))
    with torch.no_grad():
        decoder.offset[-1].weight.copy_(normal(1, 60, 8))  # pyright: ignore[reportCallIssue]
    assert float(decoder.base.detach().abs().max()) <= math.sqrt(6 / 23)
    shape = decoder.eval()(normal(0, 3, 6).float())
    assert float(shape.offset.detach().abs().max()) > 0.1
    assert_close(shape.points - shape.offset, decoder.base.expand(3, -1, -1))
    assert shape.color is None
    tinted = Decoder(DecoderConfig(width=8, points=20), 6, color=True)
    assert tinted(normal(0, 3, 6).float()).color.shape == (3, 20, 3)


def network(category: str = "eyeglasses") -> PointNetwork:
    config = PointNetConfig(
        width=8, blocks=3, segmentation=(8,), joint=(8, 8), revolute_range=2.0, prismatic_range=0.5
    )
    made = PointNetwork(config, CATEGORIES[category])
    initialise(made, generator(0))
    return made


@torch.no_grad()
def test_the_point_network_does_not_depend_on_the_order_of_points() -> None:
    made = network().eval()
    first, second = normal(0, 2, 30, 3).float(), normal(1, 2, 20, 3).float()
    order = torch.randperm(30, generator=generator(3))
    one, more = made(first, second)
    other, same = made(first[:, order], second)
    assert_close(other.weights, one.weights[:, order])
    assert_close(other.joints.pivot, one.joints.pivot)
    assert_close(same.weights, more.weights)
    assert_close(one.weights.sum(-1), torch.ones(2, 30))
    assert one.joints.pivot.shape == (2, 2, 3)
    assert_close(one.joints.axis.norm(dim=-1), torch.ones(2, 2))


@torch.no_grad()
def test_each_shape_is_pooled_by_itself() -> None:
    made = network().eval()
    first, second, third = (normal(seed, 2, 30, 3).float() for seed in range(3))
    one, _ = made(first, second)
    again, _ = made(first, third)
    assert_close(again.weights, one.weights)
    alone, _ = made(first[:1], third[:1])
    assert_close(alone.weights[0], one.weights[0])


@torch.no_grad()
def test_both_shapes_make_the_statistics_of_a_batch() -> None:
    made = network().train()
    first, second = normal(0, 2, 30, 3).float(), 3 + normal(1, 2, 20, 3).float()
    seen: list[torch.Tensor] = []
    norm = made.blocks[0].norm
    assert isinstance(norm, torch.nn.BatchNorm1d)
    norm.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    made(first, second)
    assert seen[0].shape[0] == 2 * 30 + 2 * 20
    assert_close(norm.running_mean, 0.1 * seen[0].mean(0))


@pytest.mark.parametrize(("category", "width"), [("oven", 2.0), ("drawer", 0.5)])
@torch.no_grad()
def test_states_lie_within_half_the_range_of_their_kind(category: str, width: float) -> None:
    made = network(category).eval()
    last = made.joint[-1]
    assert isinstance(last, torch.nn.Linear)
    assert last.bias is not None
    last.bias[6:] = torch.tensor([40.0, -40.0])
    said, _ = made(normal(0, 1, 9, 3).float(), normal(1, 1, 9, 3).float())
    np.testing.assert_allclose(said.joints.state[0, 0].numpy(), [width / 2, -width / 2], rtol=1e-5)
