# SPDX-License-Identifier: MIT
"""The plan: what it asks for, its digest, and what it is held against."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections import Counter
from pathlib import Path

import pytest

from bench.grid import plan as plans
from bench.grid.plan import Plan, chosen, code_digest, freeze, make_plan
from bench.grid.presets import PRESETS, REAL, flags_of, training_seconds
from bench.methods import METHODS
from bench.tables.spec import TABLE_1_CATEGORIES, TABLE_2_CATEGORIES
from scapo.store import StoreError
from scapo.store.files import sha256_file
from scapo.text import UsageError
from tests.helpers.grids import make_splits, plan_of
from tests.helpers.made import make_data


@pytest.fixture(scope="module")
def cpu(tmp_path_factory) -> Plan:
    return make_plan("cpu", tmp_path_factory.mktemp("nothing"))


def test_the_grid_has_every_method_of_every_table(cpu: Plan):
    for part, categories in (("clean", TABLE_1_CATEGORIES), ("sensor", TABLE_2_CATEGORIES)):
        found = Counter((c.category, c.label) for c in cpu.chains if c.part == part)
        for category in categories:
            assert {label: found[category, label] for label in ("scapo", "registered")} == {
                "scapo": 3, "registered": 3
            }  # fmt: skip
            assert found[category, "gcn3d"] == found[category, "pointnet2"] == 1
    ablated = {c.label for c in cpu.chains if c.label.startswith("scapo-wo-")}
    assert len(ablated) == 4
    weights = {cpu.configs[label]["config"]["loss"]["dir_align"] for label in ablated}
    assert weights == {cpu.configs["scapo-full"]["config"]["loss"]["dir_align"]} == {0.1}
    assert [cpu.configs[label]["config"]["loss"]["without"] for label in sorted(ablated)] == [
        ["dir_align"], ["joint_boundary"], ["joint_prox"], ["shape_var"]
    ]  # fmt: skip
    assert cpu.configs["scapo-warm-sj"]["config"]["supervision"] == [
        "segmentation", "joint", "instance"
    ]  # fmt: skip


def test_a_warm_start_begins_at_a_released_model(tmp_path: Path, monkeypatch):
    models = {name: tmp_path / name.replace("/", "-") for name in ("oven", "laptop/sensor")}
    for name, path in models.items():
        path.write_text(name)
    monkeypatch.setattr("bench.grid.plan.weights", lambda: models)
    plan = make_plan("cpu", tmp_path)
    begun = [c for c in plan.chains if c.label.startswith(("scapo-w", "scapo-full"))]
    assert {c.name.partition("/")[0] for c in begun} == {"clean", "complete", "sensor"}
    for chain in begun:
        train = chain.steps[0]
        name = "oven" if chain.category == "oven" else "laptop/sensor"
        assert train.command[:2] == ("train", "scapo")
        assert train.command[-2:] == ("--start", name)
        assert train.model == sha256_file(models[name])
    assert plan.configs["scapo-warm"]["config"]["part_start"] == "run"
    assert plan.configs["scapo-warm"]["start"] == ["{category}/{part}", "{category}"]
    assert plan.configs["scapo-warm-complete"]["config"]["told_of"] == "surfaces"


def test_every_output_is_made_once_and_every_need_is_met_before(cpu: Plan):
    outputs = Counter(step.output for chain in cpu.chains for step in chain.steps)
    assert max(outputs.values()) == 1
    for chain in cpu.chains:
        before: set[str] = set()
        for step in chain.steps:
            assert set(step.needs) <= before, (chain.name, step.name)
            before.add(step.name)


def test_only_trainings_without_poses_are_calibrated(cpu: Plan):
    for chain in cpu.chains:
        scored = next(step for step in chain.steps if step.kind == "evaluate")
        method, trained = cpu.configs[chain.label]["method"], chain.steps[0].kind == "train"
        without = trained and "pose" not in METHODS[method].supervision
        assert ("--calibration" in scored.command) == without, chain.name


def test_a_released_model_is_asked_by_its_name(tmp_path: Path, monkeypatch):
    models = {name: tmp_path / name.replace("/", "-") for name in ("oven", "laptop/sensor")}
    for name, path in models.items():
        path.write_text(name)
    monkeypatch.setattr("bench.grid.plan.weights", lambda: models)
    first = [c for c in make_plan("cpu", tmp_path).chains if c.label == "released"]
    views, whole = ("fast", "quick", "refine"), ("whole",)
    asked_for = {
        "clean/oven/released/seed1": ("oven", views),
        "complete/oven/released/seed1": ("oven", whole),
        "sensor/laptop/released/seed1": ("laptop/sensor", views),
    }
    assert [c.name for c in first] == list(asked_for)
    for chain, (name, modes) in zip(first, asked_for.values(), strict=True):
        asked = [step for step in chain.steps if step.kind == "predict"]
        assert {step.name for step in asked} == {
            f"predict-{mode}-{split}" for mode in modes for split in ("test", "test-ood")
        }  # fmt: skip
        assert all(step.command[1] == name and not step.needs for step in asked)
        assert all(step.command[-2:] == ("--row", "released") for step in asked)
        drawn = next(step for step in chain.steps if step.kind == "pictures")
        assert drawn.command[1] == name
    models["oven"].write_text("another")
    again = [c for c in make_plan("cpu", tmp_path).chains if c.label == "released"]
    assert again[0] != first[0]  # another model is another plan
    assert again[2] == first[2]


def test_the_warm_start_that_comes_with_the_package_is_a_row_of_its_own(tmp_path, monkeypatch):
    model = tmp_path / "oven-scapo"
    model.write_text("weights")
    monkeypatch.setattr("bench.grid.plan.weights", lambda: {"oven/scapo": model})
    found = [c for c in make_plan("cpu", tmp_path).chains if c.label == "released-warm"]
    assert [c.name for c in found] == ["clean/oven/released-warm/seed1"]
    assert found[0].steps[0].command[:2] == ("predict", "oven/scapo")
    assert found[0].steps[0].command[-2:] == ("--row", "released-warm")


def test_a_budget_bounds_the_epochs():
    for entry in PRESETS["cpu"].entries:
        flags = flags_of(entry, "cpu", 20.0, 5000)
        seconds = training_seconds(entry, flags, 5000)
        least = sum(5000 / rate for rate in entry.rates)  # one epoch of each stage
        assert seconds is not None
        if entry.rates:  # template registration has no such epochs, and takes what it takes
            assert seconds <= max(20 * 60, least), entry.label
        else:
            assert seconds == entry.training


def test_real_objects_are_shown_to_one_model_of_each_method(tmp_path: Path):
    make_splits(tmp_path)
    make_data(tmp_path / "data" / "real", "oven", count=3, train=1)
    make_data(tmp_path / "data" / "real", "laptop", count=3, train=1)
    plan = make_plan("cpu", tmp_path / "data")
    shown = Counter((c.category, c.label, c.seed, s.name) for c in plan.chains for s in c.steps
                    if "/real/" in s.output and s.kind == "evaluate")  # fmt: skip
    assert {category for category, *_ in shown} == {"oven", "laptop"}
    assert set(shown.values()) == {1}
    assert REAL["laptop"] == "clean"
    assert REAL["drawer"] == "sensor"


def test_chosen(tmp_path: Path):
    make_splits(tmp_path)
    chains = plan_of(tmp_path, 1, 2).chains
    assert len(chosen(chains, ())) == 3
    assert [c.name for c in chosen(chains, ("scapo/seed2",))] == ["clean/oven/scapo/seed2"]
    assert len(chosen(chains, ("sca*", "icp"))) == 3
    with pytest.raises(UsageError, match=r"only: expected parts \(clean\).*found 'scapo/laptop'"):
        chosen(chains, ("scapo/laptop",))


def test_a_frozen_plan_is_kept_and_refuses_another(tmp_path: Path, monkeypatch):
    make_splits(tmp_path)
    plan, path = plan_of(tmp_path), tmp_path / "plan.json"
    assert freeze(path, plan)
    before = path.read_bytes()
    assert not freeze(path, dataclasses.replace(plan, commit="a later one"))  # adds the plan alone
    assert path.read_bytes() == before
    with pytest.raises(StoreError, match=r"differs in chains; .*--replan"):
        freeze(path, plan_of(tmp_path, 1, 2))
    monkeypatch.setattr(plans, "code_digest", lambda: "other code")
    with pytest.raises(StoreError, match="differs in code"):
        freeze(path, plan_of(tmp_path))
    assert freeze(path, plan_of(tmp_path), anew=True)


def test_data_that_were_not_there_may_come_but_not_change(tmp_path: Path):
    empty, path = plan_of(tmp_path), tmp_path / "plan.json"
    assert set(empty.data.values()) == {None}
    freeze(path, empty)
    make_splits(tmp_path)
    assert not freeze(path, plan_of(tmp_path))
    freeze(path, plan_of(tmp_path), anew=True)
    make_data(tmp_path / "data" / "clean", "oven", count=5, train=6)
    with pytest.raises(StoreError, match="differs in clean/oven/test"):
        freeze(path, plan_of(tmp_path))
    shutil.rmtree(tmp_path / "data")  # another machine, where they are still to be made
    assert not freeze(path, plan_of(tmp_path))


@pytest.mark.parametrize("change", [{"budget_minutes": 99}, {"digest": "0" * 64}, {"format": "x"}])
def test_a_plan_that_was_changed_by_hand_is_refused(tmp_path: Path, change):
    make_splits(tmp_path)
    path = tmp_path / "plan.json"
    freeze(path, plan_of(tmp_path))
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(StoreError, match="expected a plan"):
        freeze(path, plan_of(tmp_path))


def test_the_digest_of_the_code_is_of_names_and_bytes(tmp_path: Path, monkeypatch):
    for name in ("bench", "scapo", "sim_assets"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.py").write_text("1")
    monkeypatch.setattr(plans, "PACKAGE", tmp_path / "scapo")
    first = code_digest()
    (tmp_path / "scapo" / "notes.txt").write_text("no code")
    assert code_digest() == first
    (tmp_path / "scapo" / "a.py").rename(tmp_path / "scapo" / "b.py")
    second = code_digest()
    (tmp_path / "scapo" / "b.py").write_text("2")
    assert len({first, second, code_digest()}) == 3
