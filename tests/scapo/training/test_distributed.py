# SPDX-License-Identifier: MIT
"""Two real processes joined by gloo: the curve of one, the state of both, resume, and NaN."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector

from bench.__main__ import main
from bench.runs import train as training
from scapo.method import AbstractMethod
from scapo.store.checkpoint import TRAINING, WEIGHTS, read_checkpoint
from scapo.store.files import read
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.training.distributed import BAD_LOSS, FINE, Ranks, own_device, present, sum_gradients
from tests.conftest import REPOSITORY
from tests.helpers import made
from tests.helpers.small import FLAGS
from tests.helpers.tiny import tiny_data
from tests.helpers.two_ranks import CONFIG, Line, still


def torchrun(*words: str) -> subprocess.CompletedProcess[str]:
    """Two processes."""
    helpers = REPOSITORY / "tests/helpers"
    path = os.pathsep.join([str(helpers), str(REPOSITORY)])
    # By address: where a machine without a network cannot resolve its own name
    here = ["--standalone", "--local-addr=127.0.0.1", "--nproc-per-node=2"]
    command = [sys.executable, "-m", "torch.distributed.run", *here]
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [*command, *words],
        env=environment,
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
        timeout=400,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("ranks")
    done = torchrun(str(REPOSITORY / "tests/helpers/two_ranks.py"), str(out))
    assert done.returncode == 0, done.stderr[-3000:]
    return out


@pytest.fixture(scope="module")
def said(folder: Path) -> list[dict[str, Any]]:
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in (0, 1)]


def curve(run: Path) -> np.ndarray:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return np.array([[line["step"], line["loss"], line["gradient"]] for line in lines])


def test_exchanges(said: list[dict[str, Any]]) -> None:
    for rank, answers in enumerate(answer["collectives"] for answer in said):
        assert answers["said"] == [FINE, FINE]
        assert answers["first"] == [[0.75, 1.5]]
        assert answers["second"] == [[0.75 * 1 + 0.25 * 2]]
        assert answers["none"]
        assert answers["mean"] == [0.5]
        assert answers["kept"]
        assert answers["bytes"] == 3
        assert answers["every"] == [[0], [1]]
        assert answers["share"] == ([0, 1, 2, 3], [4, 5, 6])[rank]


def test_two_ranks_train_as_one(folder: Path, tmp_path: Path) -> None:
    """Without noise and batch statistics the same numbers, shares of unequal size included."""
    fit.fit(Line(), tiny_data(), tmp_path, CONFIG)
    np.testing.assert_allclose(curve(folder / "line"), curve(tmp_path), rtol=2e-5)
    alone, _ = read_checkpoint(tmp_path)
    together, header = read_checkpoint(folder / "line")
    assert header["training"]["ranks"] == 2
    for name, value in alone.items():
        np.testing.assert_allclose(together[name], value, rtol=1e-4, err_msg=name)


def test_scapo_without_noise_has_closely_the_same_curve(folder: Path, tmp_path: Path) -> None:
    """Batch norm sees half a batch on each rank, which is all the difference."""
    fit.fit(still(), tiny_data(), tmp_path, CONFIG)
    one, two = curve(tmp_path)[:, 1], curve(folder / "still")[:, 1]
    assert one[-1] < 0.85 * one[0]
    np.testing.assert_allclose(two, one, rtol=0.15)


def test_all_ranks_end_with_the_same_state(said: list[dict[str, Any]]) -> None:
    """What the first rank's start drew at random included."""
    assert said[0]["line"] == said[1]["line"]
    assert said[0]["still"] == said[1]["still"]


def test_a_stopped_run_of_two_ranks_continues_bit_for_bit(folder: Path) -> None:
    for name in (WEIGHTS, "metrics.jsonl"):
        assert (folder / "resumed" / name).read_bytes() == (folder / "line" / name).read_bytes()
    arrays, _ = read(folder / "line" / TRAINING)
    again, _ = read(folder / "resumed" / TRAINING)
    assert {"generator/noise", "generator/noise/1"} <= arrays.keys()
    assert all((arrays[name] == again[name]).all() for name in arrays)


def test_nan_on_one_rank_stops_all_with_its_batch(folder: Path, said: list[dict[str, Any]]) -> None:
    assert "found rank 1 with another" in said[0]["nan"]
    assert "expected a finite loss in stage 'one' at step 2, found square, far" in said[1]["nan"]
    arrays, _ = read(folder / "nan" / "bad-batch.safetensors")
    points = tiny_data().observation.points.numpy()
    assert len(arrays["index"]) == 3
    assert (points[arrays["index"]] == arrays["points"]).all()


def test_another_number_of_ranks_does_not_resume(folder: Path) -> None:
    with pytest.raises(StoreError, match=r'training: expected .*"ranks":1.* to resume, found'):
        fit.fit(Line(), tiny_data(), folder / "line", CONFIG, resume=True)


def test_the_second_process_of_a_command_trains_and_says_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """This process in its place, the first left out; what that one writes: `test_train`."""
    second, moved = Ranks(rank=1), list[bool]()

    def watched(method: AbstractMethod, *args: Any, **options: Any) -> None:
        before = parameters_to_vector(method.parameters())
        trained(method, *args, **options)
        moved.append(not torch.equal(parameters_to_vector(method.parameters()), before))

    trained = fit.fit
    monkeypatch.setattr(fit, "fit", watched)
    monkeypatch.setattr(fit, "present", lambda: second)
    monkeypatch.setattr(Ranks, "share", lambda _, index: index)
    monkeypatch.setattr(training, "joined", lambda device: nullcontext(second))
    made.make_data(tmp_path / "data", train=16)
    words = ["train", "scapo", "--category", "laptop", "--device", "cpu"]
    words += FLAGS["scapo"]
    main([*words, "--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")])
    assert capsys.readouterr() == ("", "")
    assert moved == [True]
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_command_as_torchrun_starts_it(tmp_path: Path) -> None:
    """One run, one report, one set of lines, whatever the number of processes."""
    made.make_data(tmp_path / "data", train=16)
    words = ["-m", "bench", "train", "scapo", "--category", "laptop", "--device", "cpu"]
    words += FLAGS["scapo"]
    words += ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "run")]
    done = torchrun(*words)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count("Run:") == 1
    _, header = read_checkpoint(tmp_path / "run")
    assert (header["training"]["ranks"], header["finished"]) == (2, True)
    assert (tmp_path / "run" / "report.html").is_file()
    again = torchrun(*words)
    assert again.returncode != 0
    assert "expected no run there, found one; --resume continues it" in again.stderr


def test_one_process_is_one_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    assert present() == Ranks()
    values = torch.ones(2)
    assert Ranks().total(values) is values
    assert torch.equal(Ranks().share(values), values)
    assert Ranks().from_first(b"x", "cpu") == b"x"
    assert sum_gradients(torch.nn.Linear(1, 1), 1.0, False, Ranks()) == [BAD_LOSS]
    assert own_device("cuda") == "cuda"
    for name, value in (("RANK", "3"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("MASTER_ADDR", "localhost")
    assert own_device("cuda") == "cuda:1"
    assert own_device("cpu") == "cpu"
