# SPDX-License-Identifier: MIT
"""Steps that are done, kept, failed and killed; their commands are those of `fake_bench`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.grid import command
from bench.grid.execute import Estimate, Machines, execute
from bench.grid.plan import chosen
from scapo.parallel.pool import Pool
from tests.helpers.grids import CALLS, calls, make_splits, plan_of, run


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setitem(command.MODULES, "scapo-bench", "tests.helpers.fake_bench")
    monkeypatch.setenv("FAKE_BENCH", str(tmp_path / CALLS))
    make_splits(tmp_path)
    return tmp_path


def test_what_is_finished_is_not_done_again(folder: Path):
    plan = plan_of(folder)
    first = run(plan, folder)
    steps = [step for chain in plan.chains for step in chain.steps]
    assert {one.state for one in first} == {"made"}
    assert all((folder / "out" / step.output).is_file() for step in steps)
    assert len(calls(folder)) == len(steps)
    assert {one.state for one in run(plan, folder)} == {"kept"}
    assert len(calls(folder)) == len(steps)
    assert not Estimate(plan, folder / "out").left


def test_an_output_that_changed_is_made_again_with_all_that_came_of_it(folder: Path):
    plan = plan_of(folder)
    run(plan, folder, "scapo")
    predictions = next((folder / "out" / "predictions").rglob("*scapo*-test.safetensors"))
    predictions.write_text("by another hand")
    states = {one.step: one.state for one in run(plan, folder, "scapo")}
    assert states.pop("predict-fast-test") == "made"
    assert set(states.values()) == {"kept"}  # the same bytes again: what came of them is as it was
    checkpoint = next((folder / "out" / "runs").rglob("*scapo*/checkpoint.safetensors"))
    (checkpoint.parent / "half").unlink()
    checkpoint.unlink()
    assert run(plan, folder, "scapo")[0].state == "made"


def test_a_training_of_another_plan_is_begun_anew(folder: Path):
    run(plan_of(folder), folder, "scapo")
    run_folder = next((folder / "out" / "runs").rglob("*scapo*"))
    (run_folder / "of the first").write_text("")
    plan = plan_of(folder)
    config = {**plan.configs["scapo"], "config": {"epochs": 7}}
    object.__setattr__(plan, "configs", {**plan.configs, "scapo": config})
    of_scapo = [one for one in plan.chains if one.label == "scapo"]
    left = Estimate(plan, folder / "out").left
    assert {(one.name, step.name) for one in of_scapo for step in one.steps} <= left.keys()
    assert run(plan, folder, "scapo")[0].state == "made"
    assert not (run_folder / "of the first").exists()


def test_a_failure_costs_its_own_chain_and_names_the_last_line(folder: Path):
    ended = run(plan_of(folder, 1, 13), folder)
    failed = [one for one in ended if one.state == "failed"]
    assert [(one.chain, one.step) for one in failed] == [("clean/oven/scapo/seed13", "train")]
    assert "a seed that brings no luck" in failed[0].reason
    assert "train.txt" in failed[0].reason
    left = [one for one in ended if one.chain.endswith("seed13")][1:]
    assert {one.state for one in left} == {"not run"}
    assert left[0].reason == "needs train"
    others = {one.state for one in ended if not one.chain.endswith("seed13")}
    assert others == {"made"}


def test_data_that_are_gone_are_named(folder: Path):
    plan = plan_of(folder)
    manifest = folder / "data" / "clean" / "oven" / "train" / "manifest.json"
    manifest.unlink()
    ended = run(plan, folder, "scapo")
    assert ended[0].state == "failed"
    assert str(manifest) in ended[0].reason


def test_estimates_learn_from_what_ran(folder: Path):
    plan = plan_of(folder, 1, 2)
    estimate = Estimate(plan, folder / "out")
    chain = next(one for one in plan.chains if one.name.endswith("scapo/seed1"))
    other = next(one for one in plan.chains if one.name.endswith("scapo/seed2"))
    stated = estimate.of(other, other.steps[0])
    assert stated is not None
    before, unknown = estimate.total(plan.chains)
    assert unknown == 0
    estimate.over(chain, chain.steps[0], 3 * stated)
    assert estimate.of(other, other.steps[0]) == pytest.approx(3 * stated)
    # The first training is no longer left, the second takes three times what was said.
    assert estimate.total(plan.chains)[0] == pytest.approx(before - stated + 2 * stated)


SCRIPT = """
import sys
from pathlib import Path
from bench.grid import command
from tests.helpers.grids import plan_of, run
command.MODULES["scapo-bench"] = "tests.helpers.fake_bench"
folder = Path(sys.argv[1])
run(plan_of(folder), folder, "scapo")
"""


def test_a_run_that_is_killed_takes_its_command_along_and_goes_on(folder: Path, repository: Path):
    slow = folder / "calls.slow"
    slow.write_text("")
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder)], cwd=repository)
    half = folder / "out" / "runs" / "clean" / "oven-scapo-seed1" / "half"
    wait_for(half.exists)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    trainings = f"{sys.executable} -m tests.helpers.fake_bench train"
    wait_for(lambda: not running(trainings, str(folder)))
    slow.unlink()
    assert {one.state for one in run(plan_of(folder), folder, "scapo")} == {"made"}
    assert sum(line.startswith("train") for line in calls(folder)) == 2
    assert {one.state for one in run(plan_of(folder), folder, "scapo")} == {"kept"}


def running(*words: str) -> bool:
    """Whether a process has these words in its command."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            text = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if all(word in text for word in words):
            return True
    return False


def wait_for(holds, seconds: float = 120.0):
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.slow
def test_on_ray_the_outcomes_are_the_same(folder: Path, monkeypatch):
    """The engine is asked for with the GPUs of a chain; the pool itself is tested where it is."""
    asked = []

    def opened(engine, workers, *, gpus):
        asked.append((engine, workers, gpus))
        return Pool(0)

    monkeypatch.setattr("bench.grid.execute.open_pool", opened)
    plan = plan_of(folder)
    machines = Machines(engine="ray", gpus=0.5)
    done = dict(execute(plan, plan.chains, folder / "out", folder / "data", machines))
    assert asked == [("ray", None, 0.5)]
    assert {one.state for ended in done.values() for one in ended} == {"made"}


def test_workers_of_a_cluster_find_folders_that_were_named_from_here(
    folder: Path, repository: Path, monkeypatch
):
    class Elsewhere(Pool):
        def run(self, *asked, **named):
            monkeypatch.chdir(folder / "data")
            return super().run(*asked, **named)

    monkeypatch.setattr("bench.grid.execute.open_pool", lambda *_, **__: Elsewhere(0))
    monkeypatch.setenv("PYTHONPATH", str(repository))
    plan = plan_of(folder)
    monkeypatch.chdir(folder)
    chains = chosen(plan.chains, ["icp"])
    done = dict(execute(plan, chains, Path("out"), Path("data"), Machines(engine="ray")))
    assert {one.state for ended in done.values() for one in ended} == {"made"}
    assert all((folder / "out" / step.output).is_file() for step in chains[0].steps)
