# SPDX-License-Identifier: MIT
"""`run`: data, plan, steps and tables in one call; the whole smoke grid, and its quick twin."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from bench import __main__ as program
from bench.cli.console import clock, grid_table
from bench.cli.verbs import Run
from bench.grid import command, execute, run
from bench.grid.run import Grid
from bench.requests import GridRequest
from scapo.store import StoreError
from scapo.store.folders import alone
from sim_assets import __main__ as data_program
from tests.helpers.grids import CALLS, calls, make_splits, preset
from tests.helpers.made import sample_arrays, write_split


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setitem(command.MODULES, "scapo-bench", "tests.helpers.fake_bench")
    monkeypatch.setenv("FAKE_BENCH", str(tmp_path / CALLS))
    monkeypatch.setattr(run, "Grid", partial(Grid, presets={"smoke": preset(1, 13)}))
    return tmp_path


def words(folder: Path, **more) -> Run:
    return Run(preset="smoke", out=folder / "out", data=folder / "data", workers=0, **more)


def said(verb: Run) -> str:
    console = Console(file=io.StringIO(), width=200)
    try:
        verb.run(console)
    finally:
        assert isinstance(console.file, io.StringIO)
        text = console.file.getvalue()
        print(text)  # noqa: T201 - for capsys
    return text


def test_the_quick_twin_of_smoke(folder: Path, capsys):
    make_splits(folder)
    with pytest.raises(RuntimeError, match="found 1 that failed; the same command tries"):
        said(words(folder))
    text = capsys.readouterr().out
    assert "3 trainings, 15 of their 15 steps are left; these take about" in text
    assert "clean/oven/icp/seed1: 5 made" in text
    assert "clean/oven/scapo/seed13: 1 failed, 3 not run" in text
    assert "failed: clean/oven/scapo/seed13: " in text
    assert "a seed that brings no luck" in text
    assert calls(folder)[-1] == "tables tables"
    assert len(json.loads((folder / "out" / "plan.json").read_text())["chains"]) == 3
    assert "clean/oven/scapo/seed1: 6 kept" in said(words(folder, only=("scapo/seed1",)))


def test_scores_of_an_earlier_plan_are_in_no_table(folder: Path, monkeypatch):
    """Another seed, and other steps for a chain that is not asked for; scores put there stay."""
    make_splits(folder)
    monkeypatch.setattr(run, "Grid", partial(Grid, presets={"smoke": preset(1, 2)}))
    assert "earlier plan" not in said(words(folder))
    scores = folder / "out" / "scores" / "clean"
    reading = scores / "oven-scapo-seed2-fast-test.one-order.csv.gz"
    for path in (reading, scores / "restored.csv.gz"):
        path.write_text("")
    there = {path.name for path in scores.iterdir()}
    fewer = replace(preset(1), calibration=3)
    monkeypatch.setattr(run, "Grid", partial(Grid, presets={"smoke": fewer}))
    text = said(words(folder, replan=True, only=("icp",)))
    assert "2 scores of an earlier plan are in" in text
    left = {path.name for path in scores.iterdir()}
    assert left == {"oven-icp-seed1-fast-test.csv.gz", "restored.csv.gz"}
    aside = folder / "out" / "scores-of-earlier-plans" / "clean"
    assert {path.name for path in aside.iterdir()} == there - left
    said(words(folder, only=("scapo",)))
    assert (scores / "oven-scapo-seed1-fast-test.csv.gz").is_file()
    assert (aside / reading.name).is_file()


def test_objects_unlike_the_trainings_alone_have_tables(folder: Path, monkeypatch):
    make_splits(folder)
    write_split(folder / "data" / "clean", "oven", "test-ood", sample_arrays("oven", 4, 64))
    small = replace(preset(1), sizes={"train": (6, 2), "test-ood": (4, 2)})
    monkeypatch.setattr(run, "Grid", partial(Grid, presets={"smoke": small}))
    said(words(folder, only=("icp",), splits=("test-ood",)))
    assert calls(folder)[-1] == "tables tables"


def test_plan_only_writes_the_plan_alone(folder: Path):
    assert "15 of their 15 steps" in said(words(folder, plan_only=True))
    some = said(words(folder, plan_only=True, only=("icp",)))
    assert "1 trainings, 5 of their 5 steps are left" in some
    assert [path.name for path in (folder / "out").iterdir()] == ["plan.json"]
    assert calls(folder) == []


def test_missing_data_are_asked_for(folder: Path, monkeypatch):
    asked: list[list[str]] = []

    def made(program, words, log):
        asked.append([program, *words])
        make_splits(folder)

    monkeypatch.setattr(run, "run_command", made)
    grid = run.Grid(GridRequest(preset="smoke", out=folder / "out", data=folder / "data"))
    plan, _ = grid.plan(lambda line: None)
    assert [words[:3] for words in asked] == [["scapo-data", "generate", "oven"]] * 2
    assert asked[1][-8:] == ["--split", "test", "--count", "4", "--instances", "2", "--seed", "2"]
    assert None not in plan.data.values()
    asked.clear()
    request = GridRequest(preset="cpu", out=folder / "cpu", only=("sensor/laptop/icp",))
    with pytest.raises(ValueError, match="only: expected parts"):
        Grid(request).plan(lambda line: None)  # ICP is not run on sensor
    request = GridRequest(preset="cpu", out=folder / "cpu", only=("clean/gcn3d/oven",),
                          real=folder / "models")  # fmt: skip
    Grid(request).plan(lambda line: None)
    data = str(folder / "cpu" / "data")
    workers = asked[0][asked[0].index("--workers") + 1]
    start = ["scapo-data", "benchmark", "sim-art/2", "--out", data, "--workers", workers, "--only"]
    assert asked == [
        [*start, "real", "--real", str(folder / "models")],
        [*start, "clean/oven/train", "clean/oven/test", "clean/oven/test-ood"],
    ]


def test_a_run_has_a_folder_of_its_own_unless_told(folder: Path, monkeypatch):
    make_splits(folder)
    monkeypatch.chdir(folder)
    run.Grid(GridRequest(preset="smoke", data=folder / "data")).plan(lambda line: None)
    assert (folder / "results" / "runs" / "smoke" / "plan.json").is_file()
    assert run.Grid(GridRequest(preset="cpu")).data == Path("results/runs/cpu/data")


def test_one_run_at_a_time_in_a_folder(folder: Path):
    make_splits(folder)
    with (
        alone(folder / "out", "run"),
        pytest.raises(StoreError, match="no run goes on, found another at work there"),
    ):
        said(words(folder))
    assert "5 made" in said(words(folder, only=("icp",)))


def test_the_table_of_what_goes_on(folder: Path):
    make_splits(folder)
    grid = run.Grid(GridRequest(preset="smoke", out=folder / "out", data=folder / "data"))
    plan, chains = grid.plan(lambda line: None)
    status = grid.status(plan, chains)
    status.hear("clean/oven/icp/seed1", "train", False)
    console = Console(file=io.StringIO(), width=120)
    console.print(grid_table(status))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert "1 of 3 trainings at work" in text
    assert "clean/oven/icp/seed1" in text
    assert "none over" in text
    status.hear("clean/oven/icp/seed1", "train", True)
    assert status.running["clean/oven/icp/seed1"][0] == "train"
    assert clock(59.6) == "1 min 00 s"


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        (["--gpus", "1.5"], "--gpus: expected a share of one or a whole number, found 1.5"),
        (["--budget-minutes", "0"], "--budget-minutes: expected a finite number above 0"),
        (["--budget-minutes", "nan"], "--budget-minutes: expected a finite number above 0"),
        (["--splits", "vall", "--plan-only"], "--splits: expected some of val, test, test-ood"),
        (["--splits", "train", "--plan-only"], "--splits: expected some of val, test, test-ood"),
        (["--only", "nothing", "--plan-only"], "only: expected parts (clean)"),
    ],
)
def test_what_cannot_be_asked(flag: list[str], message: str, tmp_path: Path, capsys):
    with pytest.raises(SystemExit) as stop:
        program.main(["run", "smoke", "--out", str(tmp_path / "out"), *flag])
    assert stop.value.code == (2 if "--only" in flag else 1)  # what there is none of is no value
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("split", ["val", "test-ood"])
def test_smoke_can_be_scored_on_another_split(split: str, tmp_path: Path):
    """Its sizes are its own: one for each split that may be asked for."""
    program.main(["run", "smoke", "--out", str(tmp_path), "--splits", split, "--plan-only"])
    assert f"clean/oven/{split}" in (tmp_path / "plan.json").read_text()


def here(name: str, words: Sequence[str], log: Path, **options: object) -> float:
    """As `run_command`, in this process: ten starts would take longer than all else."""
    log.parent.mkdir(parents=True, exist_ok=True)
    try:
        (data_program if name == "scapo-data" else program).main(list(words))
    except SystemExit as end:
        if end.code:
            raise command.StepError(f"{name} {words[0]} ended {end.code}") from end
    return 0.0


@pytest.mark.slow
@pytest.mark.render
def test_a_method_of_smoke_from_nothing_to_its_row(tmp_path: Path, capsys, monkeypatch):
    for module in (run, execute):
        monkeypatch.setattr(module, "run_command", here)
    words = ["run", "smoke", "--out", str(tmp_path / "out"), "--only", "scapo", "--workers", "0"]
    program.main(words)
    table = (tmp_path / "out" / "tables" / "table1.csv").read_text()
    assert ",SCAPO (cpu),ours," in table
    assert ",Oracle pose,ours," in table
    assert (tmp_path / "out" / "tables" / "index.html").is_file()
    capsys.readouterr()
    program.main(words)
    assert "clean/oven/scapo/seed1: 6 kept" in capsys.readouterr().out


def test_what_is_interrupted_says_how_to_go_on(folder: Path, monkeypatch):
    make_splits(folder)

    def stopped(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "execute", lambda *args: map(stopped, [1]))
    with pytest.raises(KeyboardInterrupt, match="the same command goes on from here"):
        said(words(folder))
