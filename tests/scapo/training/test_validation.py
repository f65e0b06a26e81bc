# SPDX-License-Identifier: MIT
"""A stage with validation ends with its best state, on clouds that it was not trained on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from scapo.method import Stage, Step
from scapo.records import take
from scapo.store.checkpoint import TRAINING
from scapo.store.files import read, read_header
from scapo.store.samples import TrainingData
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.types import Labels, Observation
from tests.helpers.tiny import tiny_data
from tests.helpers.two_ranks import CONFIG, Line, StoppedError, stop_after


class Judged(Line):
    """Its losses on validation clouds go down and up again; it keeps what it was shown."""

    supervision = frozenset({"segmentation"})
    judged = (3.0, 1.0, 2.0, 4.0)

    def __init__(self) -> None:
        super().__init__()
        self.supervision = frozenset({"segmentation"})
        self.trained: set[float] = set()
        self.validated: list[Observation] = []
        self.weights: list[Tensor] = []
        self.drawn_then: list[float] = []

    def stages(self) -> tuple[Stage, ...]:
        one, two = super().stages()
        return replace(one, epochs=8, validate_every=2), two

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        self.trained |= set(observation.points[:, 0, 0].tolist())
        assert step.total == 24 - self.held_out
        return super().losses(observation, labels, step)

    held_out = 3

    def validation_loss(self, observation: Observation, labels: Labels, step: Step) -> Tensor:
        assert not self.training
        assert not torch.is_grad_enabled()
        assert labels.part is not None
        assert labels.joints is None
        if step.index[0] == 0:
            self.weights.append(self.map.weight.detach().clone())
            self.drawn_then.append(float(torch.rand(1, generator=step.generator)))
        self.validated.append(observation)
        return torch.tensor(self.judged[round(4 * step.progress) - 1])


def metrics(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_the_best_state_is_kept_and_the_clouds_are_others(tmp_path: Path) -> None:
    method = Judged()
    starts: list[Tensor] = []

    def listener(progress: fit.Progress) -> None:
        if progress.stage.name == "two" and not starts:
            starts.append(method.map.weight.detach().clone())

    fit.fit(method, tiny_data(), tmp_path, CONFIG, listener=listener)
    seen = {float(x) for one in method.validated for x in one.points[:, 0, 0]}
    assert len(seen) == 3
    assert not seen & method.trained
    rows = [row for row in metrics(tmp_path) if "validation" in row]
    assert [row["validation"] for row in rows] == list(Judged.judged)
    assert [row["step"] for row in rows] == [6, 12, 18, 24]
    assert len(set(method.drawn_then)) == 1  # the same random numbers each time
    assert read_header(tmp_path / "checkpoint.safetensors")["training"]["validation"] == "plates"
    # Stage two starts from the second of the four states, whose loss was the least.
    lr = 0.03  # the largest that Adam's first step moves a weight
    assert (starts[0] - method.weights[1]).abs().max() <= lr + 1e-6
    assert (starts[0] - method.weights[3]).abs().max() > lr + 1e-3


def test_a_pass_that_is_not_finite_is_no_best_and_no_end(tmp_path: Path) -> None:
    method = Judged()
    method.judged = (torch.nan, 3.0, torch.inf, 4.0)
    fit.fit(method, tiny_data(), tmp_path, CONFIG)
    rows = [row for row in metrics(tmp_path) if "validation" in row]
    assert [row["validation"] for row in rows] == [None, 3.0, None, 4.0]


@pytest.mark.parametrize("stop", [5, 9, 10, 20, 25])
def test_a_run_with_validation_continues_bit_for_bit(tmp_path: Path, stop: int) -> None:
    fit.fit(Judged(), tiny_data(), tmp_path / "whole", CONFIG)
    with pytest.raises(StoppedError):
        fit.fit(Judged(), tiny_data(), tmp_path / "cut", CONFIG, listener=stop_after(stop))
    fit.fit(Judged(), tiny_data(), tmp_path / "cut", CONFIG, resume=True)
    assert metrics(tmp_path / "whole") == metrics(tmp_path / "cut")
    one, other = (read(tmp_path / name / TRAINING)[0] for name in ("whole", "cut"))
    assert one.keys() == other.keys()
    assert all((one[name] == other[name]).all() for name in one)


def test_a_split_of_its_own_is_used_where_there_is_one(tmp_path: Path) -> None:
    data = tiny_data()
    own = replace(tiny_data(6), digest="other")
    method = Judged()
    method.held_out = 0
    fit.fit(method, replace(data, validation=own), tmp_path, CONFIG)
    assert {len(one.points) for one in method.validated} == {6}
    assert read_header(tmp_path / TRAINING)["header"]["training"]["validation"] == "other"
    with pytest.raises(StoreError, match=r"training: expected .*plates.* to resume, found .*other"):
        fit.fit(Judged(), data, tmp_path, CONFIG, resume=True)


def test_methods_without_validation_are_given_all_clouds(tmp_path: Path) -> None:
    one, other = Line(), Line()
    fit.fit(one, tiny_data(), tmp_path / "a", CONFIG)
    fit.fit(other, replace(tiny_data(), validation=tiny_data(2)), tmp_path / "b", CONFIG)
    assert torch.equal(one.map.weight, other.map.weight)
    assert "validation" not in read_header(tmp_path / "b" / TRAINING)["header"]["training"]


def test_the_default_loss_is_the_sum_of_the_terms() -> None:
    method, data = Line(), tiny_data(4)
    step = Step(
        stage="one", progress=0.0, generator=torch.Generator(), index=torch.arange(4), total=4
    )
    with torch.no_grad():
        terms = method.losses(data.observation, data.labels, step)
        found = method.validation_loss(data.observation, data.labels, step)
    assert float(found) == pytest.approx(sum(float(one) for one in terms.values()))


def test_objects_are_held_out_whole() -> None:
    data = tiny_data(24)
    instance = torch.arange(24) % 12 * 7
    split = replace(data, labels=replace(data.labels, instance=instance)).held_out()
    assert split.validation is not None
    left, held = split.labels.instance, split.validation.labels.instance
    assert left is not None
    assert held is not None
    assert set(held.tolist()) == {0, 70}
    assert not set(left.tolist()) & {0, 70}
    out = (instance % 70) == 0
    assert torch.equal(split.observation.points, data.observation.points[~out])
    assert torch.equal(split.validation.observation.points, data.observation.points[out])
    assert split.validation.labels.joints is not None
    one = TrainingData(
        observation=take(data.observation, torch.arange(3)),
        labels=Labels(instance=torch.zeros(3, dtype=torch.long)),
        digest="",
    )
    with pytest.raises(ValueError, match="expected an object to train on, and one to hold out"):
        one.held_out()
