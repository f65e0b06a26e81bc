# SPDX-License-Identifier: MIT
"""Weights, optimiser state and configurations survive the disk."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import nn

from scapo.alignment import Alignment
from scapo.paper.config import ScapoConfig
from scapo.store import checkpoint
from scapo.store.schema import StoreError
from tests.helpers.conventions import CLOUDS, convention
from tests.helpers.tiny import TINY, tiny


def test_weights_come_back(tmp_path: Path) -> None:
    model, other = tiny(0), tiny(1)
    header = checkpoint.checkpoint_header("scapo", TINY, "laptop", {"seed": 3})
    checkpoint.write_checkpoint(tmp_path / checkpoint.WEIGHTS, model, header)
    arrays, found = checkpoint.read_checkpoint(tmp_path)
    assert found["seed"] == 3
    assert found["versions"]["torch"] == torch.__version__
    checkpoint.load_arrays(other, arrays, tmp_path)
    assert all(
        torch.equal(a, b)
        for a, b in zip(model.state_dict().values(), other.state_dict().values(), strict=True)
    )


def test_a_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    arrays = checkpoint.to_arrays(nn.Linear(2, 2))
    with pytest.raises(StoreError, match=r"here: expected the method's tensors, found"):
        checkpoint.load_arrays(nn.Linear(3, 2), arrays, Path("here"))
    with pytest.raises(StoreError, match="expected a file"):
        checkpoint.read_checkpoint(tmp_path)


def test_adam_continues_as_if_nothing_had_been() -> None:
    def step(layer: nn.Linear, optimizer: torch.optim.Adam) -> None:
        optimizer.zero_grad()
        layer(torch.ones(1, 3)).square().sum().backward()
        optimizer.step()

    def fresh() -> tuple[nn.Linear, torch.optim.Adam]:
        layer = nn.Linear(3, 2)
        with torch.no_grad():
            layer.weight.fill_(0.5)
            layer.bias.fill_(0.1)
        return layer, torch.optim.Adam(layer.parameters(), lr=0.1, fused=True)

    one, optimizer = fresh()
    for _ in range(3):
        step(one, optimizer)
    other, resumed = fresh()
    other.load_state_dict(one.state_dict())
    checkpoint.load_optimiser(resumed, checkpoint.optimiser_arrays(optimizer), Path("here"))
    step(one, optimizer)
    step(other, resumed)
    assert torch.equal(one.weight, other.weight)


def test_configurations_come_back_from_json() -> None:
    config = replace(TINY, supervision=("segmentation",))
    assert (
        checkpoint.config_from(ScapoConfig, json.loads(json.dumps(asdict(config))), "x") == config
    )


@dataclass(frozen=True)
class Inner:
    RETIRED: ClassVar = ("once",)
    sizes: tuple[int, ...] = (1,)


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    name: str = "a"


def test_missing_fields_take_defaults_and_unknown_ones_are_refused() -> None:
    assert checkpoint.config_from(Outer, {"inner": {"sizes": [2, 3]}}, "x") == Outer(
        inner=Inner(sizes=(2, 3))
    )
    with pytest.raises(StoreError, match=r"x.inner: expected fields of Inner, found 'wrong'"):
        checkpoint.config_from(Outer, {"inner": {"wrong": 1, "once": 2}}, "x")
    was = checkpoint.config_from(Outer, {"inner": {"sizes": [2, 3], "once": 2}}, "x")
    assert was == Outer(inner=Inner(sizes=(2, 3)))  # as earlier versions wrote it
    with pytest.raises(StoreError, match="x: expected an object, found list"):
        checkpoint.config_from(Outer, [], "x")


def test_a_configuration_must_be_a_dataclass() -> None:
    with pytest.raises(TypeError, match="expected a dataclass, found dict"):
        checkpoint.checkpoint_header("m", {}, "laptop", {})


def test_an_alignment_is_stored_without_a_change_to_the_weights(tmp_path: Path) -> None:
    path = tmp_path / checkpoint.WEIGHTS
    header = checkpoint.checkpoint_header("scapo", TINY, "laptop", {"seed": 3})
    checkpoint.write_checkpoint(path, tiny(0), header)
    before, plain = checkpoint.read_checkpoint(path)
    assert checkpoint.check_header(plain, "x").alignment is None
    alignment = convention((1, 0), np.random.default_rng(0))
    checkpoint.with_alignment(path, alignment)
    after, header = checkpoint.read_checkpoint(path)
    assert checkpoint.check_header(header, "x").alignment == alignment
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert {**plain, **checkpoint.alignment_field(alignment)} == header


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": [0, 1, 2]}, "alignment: expected fields that fit, found own_T_part: expected 3"),
        ({"order": [0, 0]}, "alignment: expected fields that fit, found order: expected every"),
        ({"zero": ["a"]}, "zero"),
        ({"clouds": {}}, "expected field 'split', found none"),
    ],
)
def test_damaged_alignments_are_refused(change: dict[str, object], message: str) -> None:
    header = {"method": "scapo", "category": "laptop", "config": {}}
    field = checkpoint.alignment_field(Alignment.of_order((1, 0), CLOUDS))
    with pytest.raises(StoreError, match=message):
        checkpoint.check_header({**header, "alignment": {**field["alignment"], **change}}, "x")


def test_an_alignment_of_other_parts_is_refused() -> None:
    header = {"method": "scapo", "category": "laptop", "config": {}}
    field = checkpoint.alignment_field(Alignment.of_order((0, 2, 1), CLOUDS))
    with pytest.raises(StoreError, match="x: alignment: expected that of 2 parts, found 3"):
        checkpoint.check_header({**header, **field}, "x")
