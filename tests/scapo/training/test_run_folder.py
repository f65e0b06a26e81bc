# SPDX-License-Identifier: MIT
"""Damaged or foreign files of a run are refused in one line, whatever of them is damaged."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from scapo.store.checkpoint import TRAINING, WEIGHTS
from scapo.store.files import Arrays, Header, read, write
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.training.run_folder import Position, RunFolder, State
from tests.helpers.tiny import tiny_data
from tests.helpers.two_ranks import CONFIG, Line, StoppedError, stop_after

REPLACED = (None, -1, 2**70, "x", [[]], {"a": {}})
"""What a damaged header may hold in place of a field."""


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped in its second stage."""
    folder = tmp_path_factory.mktemp("cut")
    with pytest.raises(StoppedError):
        fit.fit(Line(), tiny_data(), folder, CONFIG, listener=stop_after(10))
    return folder


@pytest.fixture
def run(cut: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(cut, tmp_path / "run"))


def resume(run: Path) -> None:
    fit.fit(Line(), tiny_data(), run, CONFIG, resume=True)


def change(path: Path, alter: Callable[[Arrays, Header], None]) -> None:
    arrays, header = read(path)
    alter(arrays, header)
    write(path, arrays, header)


def places(value: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every field of a header, nested ones included."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield (*path, name)
            yield from places(item, (*path, name))


def altered(header: Header, place: tuple[str, ...], value: object) -> Header:
    """A header with one field replaced; ... removes it."""
    out: Any = deepcopy(header)
    inner = out
    for name in place[:-1]:
        inner = inner[name]
    if value is ...:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    return out


def refusal(read_it: Callable[[Path], object], path: Path) -> str:
    """What a file is refused with, "" where it is not; a traceback fails the test."""
    try:
        read_it(path)
    except StoreError as error:
        return str(error)
    return ""


def load_state(run: Path) -> None:
    """What resuming reads, without training on."""
    method = Line()
    about = {
        "seed": CONFIG.seed,
        "data_digest": "plates",
        "training": read(run.parent / "good")[1]["header"]["training"],
    }
    state = State(position=Position(), order=torch.Generator(), noise=torch.Generator())
    RunFolder(run, method, about, "cpu").load(state)


@pytest.mark.parametrize("name", [TRAINING, WEIGHTS])
def test_any_field_of_a_header_may_be_missing_or_of_another_type(run: Path, name: str) -> None:
    shutil.copy(run / TRAINING, run.parent / "good")
    arrays, header = read(run / name)
    refused = 0
    for number, place in enumerate(places(header)):
        for value in (..., REPLACED[number % len(REPLACED)]):
            write(run / name, arrays, altered(header, place, value))
            said = refusal(load_state, run)
            assert not said or (said.startswith(str(run)) and "\n" not in said)
            refused += said != ""
    assert refused > 30


def test_a_position_outside_the_stages_is_refused(run: Path) -> None:
    for name, value in (("stage", 7), ("stage", -1), ("epoch", -2), ("step", -1)):
        change(run / TRAINING, lambda _, h, n=name, v=value: h["position"].update({n: v}))
        with pytest.raises(StoreError, match="position: expected one in 2 stages"):
            resume(run)
        change(run / TRAINING, lambda _, h, n=name: h["position"].update({n: 1}))


def test_a_checkpoint_of_another_run_is_refused(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    fit.fit(Line(), tiny_data(), other, fit.FitConfig(seed=2, pictures_every=None))
    shutil.copy(other / WEIGHTS, run / WEIGHTS)
    with pytest.raises(StoreError, match=r"checkpoint.safetensors: expected the weights that bel"):
        resume(run)


def test_weights_changed_behind_the_back_of_the_state_are_refused(run: Path) -> None:
    change(run / WEIGHTS, lambda arrays, _: arrays.update({"map.bias": np.ones(1, np.float32)}))
    with pytest.raises(StoreError, match="found those of another run or moment"):
        resume(run)


def test_an_older_checkpoint_is_refused_and_a_newer_one_is_not(run: Path, cut: Path) -> None:
    whole = run.parent / "whole"
    fit.fit(Line(), tiny_data(), whole, CONFIG)
    shutil.copy(whole / WEIGHTS, run / WEIGHTS)  # as if killed between the two files
    resume(run)
    one, other = (read(folder / WEIGHTS)[0] for folder in (run, whole))
    assert all((one[name] == other[name]).all() for name in one)
    shutil.rmtree(run)
    shutil.copytree(whole, run)
    shutil.copy(cut / WEIGHTS, run / WEIGHTS)
    with pytest.raises(StoreError, match=r"belong to training.safetensors \(step 12\), found"):
        resume(run)


def test_runs_of_before_moments_were_told_go_on(run: Path) -> None:
    for name in (TRAINING, WEIGHTS):
        change(run / name, lambda _, header: header.get("header", header).pop("moment"))
    resume(run)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weights/map.weight", np.full((1, 3), np.nan, np.float32)),
        ("weights/map.bias", np.full(1, np.inf, np.float32)),
        ("weights/map.bias", np.zeros(2, np.float32)),
        ("adam/0/exp_avg", np.zeros((2, 2), np.float32)),
        ("adam/9/exp_avg", np.zeros(1, np.float32)),
        ("adam/x/exp_avg", np.zeros(1, np.float32)),
        ("generator/order", np.zeros(3, np.uint8)),
        ("generator/noise", np.zeros(3, np.float32)),
        ("generator/noise", None),
    ],
)
def test_tensors_that_cannot_be_are_refused(run: Path, name: str, value: np.ndarray | None) -> None:
    def alter(arrays: Arrays, header: Header) -> None:
        del header
        if value is None:
            del arrays[name]
        else:
            arrays[name] = value

    change(run / TRAINING, alter)
    with pytest.raises(StoreError) as caught:
        resume(run)
    assert str(run) in str(caught.value)


def test_lines_of_the_log_that_are_none_are_dropped(run: Path) -> None:
    path = run / "metrics.jsonl"
    before = path.read_bytes()
    path.write_bytes(
        before + b'3\n[]\n{"step": "x"}\n{}\nnull\n{"step": 1e999}\n\xff\n' + b"[" * 9999
    )
    with pytest.raises(StoppedError):
        fit.fit(Line(), tiny_data(), run, CONFIG, resume=True, listener=stop_after(1))
    assert path.read_bytes() == before
