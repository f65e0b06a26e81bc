# SPDX-License-Identifier: MIT
"""Stages train as their optimiser and schedule say, against PyTorch's own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import Tensor, nn

from scapo.method import Adam, HalfCosine, ParameterGroup, Sgd, Stage, Step, StepDecay
from scapo.store.checkpoint import TRAINING, WEIGHTS
from scapo.store.files import read
from scapo.training import fit
from scapo.training.optimiser import learning_rate, make_optimiser, schedule
from scapo.training.precision import Arithmetic
from scapo.types import Labels, Observation
from tests.helpers.tiny import tiny_data
from tests.helpers.two_ranks import CONFIG, Line, StoppedError, stop_after

STAGE = Stage(name="s", epochs=7, lr=0.1, min_lr=1e-3, batch=4)


def test_steps_of_the_rate_are_those_of_torch() -> None:
    stage = replace(STAGE, schedule=StepDecay(every=3, factor=0.1))
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.1)
    reference = torch.optim.lr_scheduler.StepLR(optimizer, step_size=3, gamma=0.1)
    steps = 11
    for epoch in range(stage.epochs):
        for number in range(steps):
            rate = learning_rate(stage, (epoch * steps + number) / (stage.epochs * steps))
            assert rate == pytest.approx(max(reference.get_last_lr()[0], 1e-3))
        optimizer.step()
        reference.step()


def test_a_stage_without_words_is_adam_on_half_a_cosine() -> None:
    assert (STAGE.optimiser, STAGE.schedule) == (Adam(), HalfCosine())
    optimizer = make_optimiser(Line(), STAGE)
    assert isinstance(optimizer, torch.optim.Adam)
    assert schedule(STAGE, optimizer, 0.5) == pytest.approx((0.1 + 1e-3) / 2)


def test_each_group_has_its_own_rate_and_decay() -> None:
    method = Line()
    method.more = nn.Linear(1, 1)
    groups = (
        ParameterGroup(module="map", weight_decay=0.5),
        ParameterGroup(module="more", rate=0.1),
    )
    stage = replace(STAGE, parameters=groups, weight_decay=0.25, optimiser=Sgd(momentum=0.0))
    optimizer = make_optimiser(method, stage)
    schedule(stage, optimizer, 0.0)
    before = {name: value.detach().clone() for name, value in method.named_parameters()}
    for parameter in method.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    for name, value in method.named_parameters():
        rate, decay = (0.1, 0.5) if name.startswith("map") else (0.01, 0.25)
        expected = before[name] - rate * (1 + decay * before[name])
        torch.testing.assert_close(value.detach(), expected)


class Slid(Line):
    """Trained by stochastic gradient descent with a rate that falls in steps."""

    momentum: ClassVar[float] = 0.9

    def stages(self) -> tuple[Stage, ...]:
        return (
            replace(
                super().stages()[0],
                epochs=4,
                optimiser=Sgd(momentum=self.momentum, nesterov=self.momentum > 0),
                schedule=StepDecay(every=2, factor=0.1),
            ),
        )


class Steep(Slid):
    """Its gradient overflows float16 at the first scales."""

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        terms = super().losses(observation, labels, step)
        return {name: 1000 * value for name, value in terms.items()}


class InTurn(Line):
    """One parameter is trained after the other."""

    def stages(self) -> tuple[Stage, ...]:
        groups = [(ParameterGroup(module=name),) for name in ("map", "more")]
        stage = super().stages()[0]
        return tuple(replace(stage, name=one[0].module, parameters=one) for one in groups)

    def __init__(self) -> None:
        super().__init__()
        self.more = nn.Linear(1, 1)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        if step.stage == "map":
            return super().losses(observation, labels, step)
        return {"small": 1e-3 * self.more.weight.sum()}


def test_the_gradient_of_a_stage_has_nothing_of_the_stage_before(tmp_path: Path) -> None:
    fit.fit(InTurn(), tiny_data(), tmp_path, CONFIG)
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    second = [line["gradient"] for line in lines if line["stage"] == "more"]
    assert second == pytest.approx([1e-3] * len(second))


class WithoutMomentum(Slid):
    momentum = 0.0


@pytest.mark.parametrize("kind", [Slid, WithoutMomentum])
def test_gradient_descent_continues_bit_for_bit(kind: type[Slid], tmp_path: Path) -> None:
    fit.fit(kind(), tiny_data(), tmp_path / "whole", CONFIG)
    with pytest.raises(StoppedError):
        fit.fit(kind(), tiny_data(), tmp_path / "cut", CONFIG, listener=stop_after(8))
    names = set(read(tmp_path / "cut" / TRAINING)[0])
    momentum = {"sgd/0/momentum_buffer", "sgd/1/momentum_buffer"}
    assert names & momentum == (momentum if kind is Slid else set())
    resumed = kind()
    fit.fit(resumed, tiny_data(), tmp_path / "cut", CONFIG, resume=True)
    whole = read(tmp_path / "whole" / TRAINING)[0]
    for name, value in resumed.state_dict().items():
        assert (whole[f"weights/{name}"] == value.numpy()).all()
    curves = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("whole", "cut")]
    assert curves[0] == curves[1]


def test_an_overflow_leaves_no_momentum() -> None:
    """Nor what happens to lie in the memory of one."""
    method = Slid()
    optimizer = make_optimiser(method, method.stages()[0])
    schedule(method.stages()[0], optimizer, 0.0)
    scaler = torch.amp.GradScaler("cpu")
    before = method.map.weight.detach().clone()
    for value in (torch.inf, 1.0):
        scaler.scale(torch.ones(()))
        for parameter in method.parameters():
            parameter.grad = torch.full_like(parameter, value) * scaler.get_scale()
        scaler.unscale_(optimizer)
        scaler.step(optimizer)
        scaler.update()
        momentum = optimizer.state[method.map.weight].get("momentum_buffer")
        assert (momentum is None) == (value == torch.inf)
    torch.testing.assert_close(method.map.weight.detach(), before - 0.03 * 1.9)


def test_gradient_descent_in_float16_continues_bit_for_bit(tmp_path: Path) -> None:
    config = replace(CONFIG, arithmetic=Arithmetic(precision="float16"))
    fit.fit(Steep(), tiny_data(), tmp_path / "whole", config)
    with pytest.raises(StoppedError):
        fit.fit(Steep(), tiny_data(), tmp_path / "cut", config, listener=stop_after(5))
    fit.fit(Steep(), tiny_data(), tmp_path / "cut", config, resume=True)
    for name in (WEIGHTS, "metrics.jsonl"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
