# SPDX-License-Identifier: MIT
"""Every method of the table: what its line says, and the way from training to a table."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from bench.__main__ import main
from bench.methods import METHODS, all_methods, find, load
from bench.scoring.score_files import read_scores
from scapo.categories import CATEGORIES
from scapo.method import AbstractMethod
from scapo.records import take
from scapo.registered.config import RegisteredConfig, decided
from scapo.store.checkpoint import config_from
from scapo.store.files import read
from scapo.store.predictions import read_prediction_header
from scapo.training.optimiser import make_optimiser, schedule
from tests.helpers.small import FLAGS, hinged_data
from tests.helpers.strategies import generator
from tests.helpers.tiny import tiny_data

NEEDS = {"kiss-matcher": "kiss_matcher"}
"""Packages of methods that have an extra of their own."""
ALL = tuple(
    pytest.param(
        name,
        marks=pytest.mark.skipif(
            name in NEEDS and find_spec(NEEDS[name]) is None,
            reason=f"the package {NEEDS.get(name)} is not installed",
        ),
    )
    for name in METHODS
)


def made(name: str, category: str = "laptop", preset: str | None = None) -> AbstractMethod:
    entry = METHODS[name]
    return entry.build(entry.preset(preset), CATEGORIES[category], generator(0))


def test_titles_and_ranks_tell_methods_apart() -> None:
    assert len({entry.title for entry in METHODS.values()}) == len(METHODS)
    assert len({entry.rank for entry in METHODS.values()}) == len(METHODS)
    assert list(all_methods())[: len(METHODS)] == list(METHODS)
    assert find("icp") is METHODS["icp"]
    assert find("magic") is None


@pytest.mark.parametrize("category", ["eyeglasses", "drawer"])
@pytest.mark.parametrize("name", ALL)
def test_a_line_says_what_the_method_is(name: str, category: str) -> None:
    entry = METHODS[name]
    for preset in entry.presets:
        method = made(name, category, preset)
        assert method.name == name
        assert method.category.name == category
        assert method.supervision == frozenset(entry.supervision)
        assert method.least_points >= 1
        config = config_from(entry.kind, json.loads(json.dumps(asdict(method.config))), name)
        assert config == method.config
        asked = entry.preset(preset)
        if isinstance(asked, RegisteredConfig):  # what it leaves open goes by the category
            asked = decided(asked, CATEGORIES[category])
        assert config == asked


@pytest.mark.parametrize("name", ALL)
def test_the_first_weights_come_from_the_generator_alone(name: str) -> None:
    one, other = made(name).state_dict(), made(name).state_dict()
    assert all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.parametrize("name", ALL)
def test_stages_name_parameters_that_the_method_has(name: str) -> None:
    method = made(name)
    stages = method.stages()
    assert len({stage.name for stage in stages}) == len(stages)
    for stage in stages:
        optimizer = make_optimiser(method, stage)
        held = [one for group in optimizer.param_groups for one in group["params"]]
        assert held
        assert len({id(one) for one in held}) == len(held)
        assert schedule(stage, optimizer, 0.0) == stage.lr


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hinged_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def command(*words: object) -> None:
    main([str(word) for word in words])


def trained(name: str, data: Path, runs: Path) -> Path:
    """The run of a small training, made on first use."""
    out = runs / name
    if not out.exists():
        command("train", name, "--category", "laptop", "--data", data, "--out", out, "--device",
                "cpu", "--no-pictures", *FLAGS.get(name, []))  # fmt: skip
    return out


@pytest.mark.parametrize("name", ALL)
def test_from_training_to_a_table(name: str, data: Path, runs: Path, tmp_path: Path) -> None:
    run = trained(name, data, runs)
    for split in ("train", "test"):
        command("predict", run, "--data", data, "--split", split, "--out",
                tmp_path / f"{split}.safetensors", "--device", "cpu")  # fmt: skip
    header = read_prediction_header(tmp_path / "test.safetensors")
    assert header.method == name
    assert set(header.supervision) == set(METHODS[name].supervision)
    weight = read(tmp_path / "test.safetensors")[0]["part_weight"]
    assert (weight >= 0).all()
    assert abs(weight.sum(-1) - 1).max() < 1e-3
    command("evaluate", "--predictions", tmp_path / "test.safetensors", "--calibration",
            tmp_path / "train.safetensors", "--data", data, "--out",
            tmp_path / "scores" / f"laptop-{name}.csv.gz")  # fmt: skip
    command("tables", "--scores", tmp_path / "scores", "--out", tmp_path / "tables")
    (scores,) = read_scores(tmp_path / "scores" / f"laptop-{name}.csv.gz")
    assert scores.run.method == name
    table = (tmp_path / "tables" / "table1.md").read_text()
    title = re.escape(METHODS[name].title)
    told = rf"- {title}.*, laptop on .*, 5 samples; .*; device cpu, processor .+, batch \d+, "
    assert re.search(told + r"seconds per cloud \d[\d.e-]*; budget: ", table)
    (line, *_) = re.findall(rf"^\|.*\| {title}[^|]*\| ours .*$", table, re.MULTILINE)
    assert line.split("|")[7].strip() == ("✓" if METHODS[name].camera else "")


@pytest.mark.parametrize("name", ALL)
def test_answers_do_not_depend_on_what_else_is_in_the_batch(
    name: str, data: Path, runs: Path
) -> None:
    method, header = load(trained(name, data, runs))
    assert not method.training
    assert header["category"] == "laptop"
    observation = tiny_data(3, points=96).observation
    whole = method.predict(observation)
    one = method.predict(take(observation, torch.tensor([1])))
    torch.testing.assert_close(one.part_weight[0], whole.part_weight[1], atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ALL)
def test_colours_change_nothing_for_those_who_do_not_look(
    name: str, data: Path, runs: Path, tmp_path: Path
) -> None:
    run, other = trained(name, data, runs), hinged_data(tmp_path / "data", color=True)
    if name != "registered":  # its training alone takes half a minute
        again = trained(name, other, tmp_path)
        one, two = (
            read(run / "checkpoint.safetensors")[0],
            read(again / "checkpoint.safetensors")[0],
        )
        assert all((one[key] == two[key]).all() for key in one)
    for folder, out in ((data, "plain"), (other, "coloured")):
        command("predict", run, "--data", folder, "--out", tmp_path / f"{out}.safetensors",
                "--device", "cpu")  # fmt: skip
    plain, coloured = (read(tmp_path / f"{n}.safetensors")[0] for n in ("plain", "coloured"))
    assert all((plain[key] == coloured[key]).all() for key in plain)
