# SPDX-License-Identifier: MIT
"""The interface of methods: nothing of it can be left out, and it is a torch module."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from scapo.categories import CATEGORIES
from scapo.method import AbstractMethod, Mode, ParameterGroup, Stage, Step
from scapo.types import Labels, Observation, Prediction

ABSTRACT = ["variant", "stages", "start", "losses", "predict"]


class Guess(AbstractMethod):
    """Learns one number per part, whatever the cloud."""

    name = "guess"

    def __init__(self) -> None:
        super().__init__()
        self.category = CATEGORIES["oven"]
        self.supervision = frozenset({"segmentation"})
        self.score = nn.Parameter(torch.zeros(2))

    @property
    def variant(self) -> str:
        return ""

    def stages(self) -> tuple[Stage, ...]:
        return (Stage(name="all", epochs=1, lr=0.1),)

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        del stage, observation, labels, generator

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        del observation, step
        assert labels.part is not None
        wanted = nn.functional.one_hot(labels.part, 2).double().mean((0, 1))
        return {"part": (self.score.softmax(0) - wanted).square().sum()}

    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        del mode
        shape = (*observation.points.shape[:-1], 2)
        return Prediction(part_weight=self.score.softmax(0).expand(shape))


def test_a_whole_method_works() -> None:
    method = Guess()
    part = torch.tensor([[0, 1, 1, 1]])
    observation = Observation(points=torch.zeros(1, 4, 3))
    step = Step(
        stage="all", progress=0.0, generator=torch.Generator(), index=torch.arange(1), total=1
    )
    labels = Labels(part=part).keep(method.supervision)
    optimiser = torch.optim.SGD(method.parameters(), lr=5.0)
    for _ in range(100):
        optimiser.zero_grad()
        sum(method.losses(observation, labels, step).values(), torch.zeros(())).backward()
        optimiser.step()
    found = method.predict(observation).part_weight[0, 0].detach()
    torch.testing.assert_close(found, torch.tensor([0.25, 0.75]), atol=1e-3, rtol=0)
    assert list(method.state_dict()) == ["score"]


@pytest.mark.parametrize("left_out", ABSTRACT)
def test_a_method_that_leaves_something_out_cannot_be_made(left_out: str) -> None:
    body: dict[str, Any] = {name: getattr(Guess, name) for name in ABSTRACT if name != left_out}
    partial = type("Partial", (AbstractMethod,), body)
    with pytest.raises(TypeError, match=left_out):
        partial()


def test_the_interface_itself_cannot_be_made() -> None:
    with pytest.raises(TypeError, match="abstract"):
        AbstractMethod()  # pyright: ignore[reportAbstractUsage]
    assert set(AbstractMethod.__abstractmethods__) == set(ABSTRACT)


def test_stages_and_steps_are_frozen() -> None:
    stage = Stage(name="all", epochs=2, lr=1e-3)
    assert stage.parameters == (ParameterGroup(module=""),)
    with pytest.raises(FrozenInstanceError):
        stage.lr = 1.0  # pyright: ignore[reportAttributeAccessIssue]
