# SPDX-License-Identifier: MIT
"""Deviations are learned from rotations that whole motions make, and told from noise."""

from __future__ import annotations

import roma
import torch
import torch.nn.functional as F
from torch import Tensor

from scapo.registered.deviation_model import PartRotations, expected_deviations, learn_deviations
from scapo.registered.template import across_axis
from tests.helpers.strategies import generator

AXES = F.normalize(torch.tensor([[0.1, 0.0, 1.0], [0.0, -0.2, 1.0]]), dim=-1)
REST = torch.tensor([0.9, -0.8])
LOAD = torch.tensor([[0.1, 0.02], [-0.03, 0.09]])


def drawn(count: int, noise: float, seed: int = 3) -> tuple[PartRotations, Tensor, Tensor]:
    """Of two hinges that deviate together by LOAD times a number, with states and numbers."""
    g = generator(seed)
    state, amount = 1.4 * torch.rand(count, 2, generator=g) - 0.7, torch.randn(count, generator=g)
    turns = []
    for j, axis in enumerate(AXES):
        across = across_axis(axis)
        aside = roma.rotvec_to_rotmat(amount[:, None] * (LOAD[j] @ across))
        onward = roma.rotvec_to_rotmat(axis * (state[:, j : j + 1] - REST[j]))
        posed = aside @ onward @ aside.mT @ roma.rotvec_to_rotmat(axis * REST[j])
        straight = roma.rotvec_to_rotmat(axis * state[:, j : j + 1])
        turns.append(roma.rotmat_to_rotvec(straight.mT @ posed) @ across.T)
    turn = torch.stack(turns, 1) + noise * torch.randn(count, 2, 2, generator=g)
    return PartRotations(turn=turn, seen=torch.ones(count, 2, dtype=torch.bool)), state, amount


def rests() -> Tensor:
    """Of both hinges: near the true ones and on the other side."""
    return torch.stack([torch.linspace(-1.0, 1.0, 21), torch.linspace(-1.0, 1.0, 21)])


def test_rest_load_and_deviations_are_recovered() -> None:
    observed, state, amount = drawn(200, 0.01)
    model = learn_deviations(observed, state, rests())
    assert (model.rest - REST).abs().max() < 0.15
    sign = torch.sign(model.load @ LOAD.flatten())
    assert (sign * model.load - LOAD.flatten()).norm() < 0.2 * LOAD.norm()
    assert (model.noise.diagonal().sqrt() - 0.01).abs().max() < 0.005
    told = expected_deviations(model, observed, state)
    assert (told - amount[:, None, None] * LOAD).norm(dim=-1).mean() < 0.02


def test_a_load_in_a_span_is_told_by_noisier_rotations() -> None:
    span = F.normalize(LOAD.flatten(), dim=0)[:, None]
    off = {"any": 0.0, "span": 0.0}
    for seed in range(4):
        observed, state, _ = drawn(60, 0.15, seed)
        for name, within in (("any", None), ("span", span)):
            load = learn_deviations(observed, state, REST[:, None], within).load
            off[name] += float(1 - (load @ span).square() / load.square().sum())
    assert off["span"] < 1e-5
    assert off["any"] > 0.2  # a twentieth of the square lies elsewhere


def test_a_hinge_that_is_not_seen_deviates_with_the_other_and_its_rotation_does_not_count() -> None:
    observed, state, amount = drawn(200, 0.01)
    model = learn_deviations(observed, state, rests())
    other = observed.turn.clone()
    other[:, 1] = 9.0
    seen = torch.tensor([True, False]).expand(200, 2)
    told = expected_deviations(model, PartRotations(turn=other, seen=seen), state)
    assert (told - amount[:, None, None] * LOAD)[:, 1].norm(dim=-1).mean() < 0.02


def test_noise_alone_makes_no_deviation() -> None:
    g = generator(5)
    turn, state = 0.05 * torch.randn(200, 1, 2, generator=g), torch.rand(200, 1, generator=g)
    observed = PartRotations(turn=turn, seen=torch.ones(200, 1, dtype=torch.bool))
    model = learn_deviations(observed, state, torch.tensor([[1.0, 1.3]]))
    assert expected_deviations(model, observed, state).norm(dim=-1).max() < 0.04
    assert (model.noise.diagonal().sqrt() - 0.05).abs().max() < 0.01


def test_views_that_are_placed_wrongly_do_not_spoil_it() -> None:
    observed, state, amount = drawn(200, 0.01)
    spoiled = observed.turn.clone()
    spoiled[::8] = 0.4 * torch.randn(25, 2, 2, generator=generator(6))
    model = learn_deviations(PartRotations(turn=spoiled, seen=observed.seen), state, rests())
    told = expected_deviations(model, observed, state) - amount[:, None, None] * LOAD
    assert told.norm(dim=-1).mean() < 0.03
