# SPDX-License-Identifier: MIT
"""The training loop: it repeats, it continues bit for bit after a kill, it stops at NaN."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from scapo.method import Stage, Step
from scapo.store.checkpoint import TRAINING, WEIGHTS, read_checkpoint
from scapo.store.files import read
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.training.optimiser import learning_rate
from scapo.training.run_folder import TIMING
from scapo.types import Labels, Observation
from tests.conftest import REPOSITORY
from tests.helpers.tiny import TINY, tiny, tiny_data
from tests.helpers.two_ranks import BATCH, CONFIG, Line, StoppedError, stop_after


def run(folder: Path, *, resume: bool = False, config: fit.FitConfig = CONFIG) -> None:
    fit.fit(tiny(), tiny_data(), folder, config, resume=resume)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole")
    run(folder)
    return folder


def same(a: Path, b: Path) -> None:
    """Weights, training state and curve, byte for byte."""
    assert (a / WEIGHTS).read_bytes() == (b / WEIGHTS).read_bytes()
    assert (a / "metrics.jsonl").read_bytes() == (b / "metrics.jsonl").read_bytes()
    one, other = read(a / TRAINING)[0], read(b / TRAINING)[0]
    assert one.keys() == other.keys()
    assert all((one[name] == other[name]).all() for name in one)


def test_the_same_seed_gives_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    run(tmp_path)
    same(whole, tmp_path)


def test_another_seed_gives_another_run(whole: Path, tmp_path: Path) -> None:
    run(tmp_path, config=replace(CONFIG, seed=2))
    assert (whole / WEIGHTS).read_bytes() != (tmp_path / WEIGHTS).read_bytes()


@pytest.mark.parametrize("stop", [2, 4, 7, 10])
def test_a_run_stopped_anywhere_continues_bit_for_bit(
    whole: Path, tmp_path: Path, stop: int
) -> None:
    with pytest.raises(StoppedError):
        fit.fit(tiny(), tiny_data(), tmp_path, CONFIG, listener=stop_after(stop))
    run(tmp_path, resume=True)
    same(whole, tmp_path)


class Few(Line):
    """Learns from some of its clouds, and notes which it is shown."""

    def __init__(self, learned: list[int]) -> None:
        super().__init__()
        self.learned, self.shown = learned, list[int]()

    def rows(self, stage: Stage, total: int) -> Tensor:
        return super().rows(stage, total)[self.learned]

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        self.shown += step.index.tolist()
        return super().losses(observation, labels, step)


def test_an_epoch_is_as_long_where_a_method_learns_from_fewer_clouds(tmp_path: Path) -> None:
    method = Few([1, 2, 5, 6])
    fit.fit(method, tiny_data(10), tmp_path, CONFIG)
    samples = 10 // BATCH * BATCH
    assert len(method.shown) == 4 * samples  # two stages of two epochs
    for epoch in zip(*[iter(method.shown)] * samples, strict=True):
        first, second = Counter(epoch[:4]), Counter(epoch[4:8])
        assert first == Counter([1, 2, 5, 6])
        assert not second - first


def test_a_method_that_learns_from_no_cloud_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected one cloud or more to learn from, found none"):
        fit.fit(Few([]), tiny_data(10), tmp_path, CONFIG)


SCRIPT = """
import sys, time
from pathlib import Path
from scapo.training import fit
from tests.helpers.tiny import tiny, tiny_data
from tests.helpers.two_ranks import CONFIG
folder = Path(sys.argv[1])
steps = 0
def listener(progress):
    global steps
    steps += 1
    if steps == 8:
        (folder / "ready").touch()
        time.sleep(600)
fit.fit(tiny(), tiny_data(), folder, CONFIG, listener=listener)
"""


def test_a_killed_run_continues_bit_for_bit(whole: Path, tmp_path: Path) -> None:
    helpers = REPOSITORY / "tests/helpers"
    path = os.pathsep.join([str(helpers), str(REPOSITORY)])
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path)], env={**os.environ, "PYTHONPATH": path}
    )
    try:
        deadline = time.monotonic() + 120
        while not (tmp_path / "ready").exists() and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.1)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL
    run(tmp_path, resume=True)
    same(whole, tmp_path)


def test_what_a_killed_run_left_half_written_is_removed(whole: Path, tmp_path: Path) -> None:
    """Or each kill amid a save would leave a file as large as the run for good."""
    half, foreign = tmp_path / ".00112233445566ff.tmp", tmp_path / ".mine.tmp"
    for path in (half, foreign):
        path.write_bytes(b"half")
    run(tmp_path, resume=True)
    assert foreign.exists()
    assert not half.exists()
    same(whole, tmp_path)


def test_a_finished_run_is_left_as_it_is(whole: Path) -> None:
    before = (whole / TRAINING).read_bytes()
    run(whole, resume=True)
    assert (whole / TRAINING).read_bytes() == before


def test_a_run_in_the_way_is_refused(whole: Path) -> None:
    with pytest.raises(StoreError, match="expected no run there, found one"):
        run(whole)


def test_two_trainings_at_once_do_not_mix_in_a_folder(whole: Path, tmp_path: Path) -> None:
    """The other is refused before anything is saved; afterwards the folder is free."""

    def listener(progress: fit.Progress) -> None:
        del progress
        with pytest.raises(StoreError, match="no training goes on, found another at work there"):
            run(tmp_path, config=replace(CONFIG, seed=2))
        raise StoppedError

    with pytest.raises(StoppedError):
        fit.fit(tiny(), tiny_data(), tmp_path, CONFIG, listener=listener)
    run(tmp_path, resume=True)
    same(whole, tmp_path)


def test_another_configuration_does_not_resume(whole: Path) -> None:
    with pytest.raises(
        StoreError, match=r'config: expected \{"gamma":0\.5\} to resume, found \{"gamma":0\.01\};'
    ):
        fit.fit(tiny(config=replace(TINY, gamma=0.5)), tiny_data(), whole, CONFIG, resume=True)
    with pytest.raises(StoreError, match="data_digest: expected"):
        fit.fit(tiny(), replace(tiny_data(), digest="x"), whole, CONFIG, resume=True)


def test_the_run_folder_says_what_was_run(whole: Path) -> None:
    config = json.loads((whole / "config.json").read_text())
    _, header = read_checkpoint(whole)
    assert header["config"] == config["config"]
    assert (header["method"], header["category"], header["seed"]) == ("scapo", "laptop", 1)
    assert header["data_digest"] == "plates"
    assert header["normalisation"]["mean_radius"] == 0.25
    assert header["finished"] is True
    assert header["steps"] == 12
    assert list((whole / "tensorboard").iterdir())
    lines = [json.loads(line) for line in (whole / "metrics.jsonl").read_text().splitlines()]
    assert {line["stage"] for line in lines} == {"canonicalise", "articulate"}
    assert [line["step"] for line in lines] == sorted({line["step"] for line in lines})
    terms = [value for name, value in lines[0].items() if name.startswith("loss/")]
    assert sum(terms) == pytest.approx(lines[0]["loss"], rel=1e-5)
    timing = json.loads((whole / TIMING).read_text())
    assert timing["samples_per_second"].keys() == {"canonicalise", "articulate"}
    assert 5e7 < timing["memory"] < 1e11  # torch alone takes more than 50 MB


def test_every_trained_weight_moves(whole: Path) -> None:
    arrays, _ = read_checkpoint(whole)
    start = {name: value.detach().numpy() for name, value in tiny().named_parameters()}
    still = [name for name, value in start.items() if (arrays[name] == value).all()]
    assert still == []


def test_a_loss_that_is_not_finite_stops_and_saves_the_batch(tmp_path: Path) -> None:
    model = tiny()
    with torch.no_grad():
        model.encoder.pose.weight.fill_(float("nan"))
    with pytest.raises(fit.TrainingError, match=r"bad-batch.safetensors: expected a finite"):
        fit.fit(model, tiny_data(), tmp_path, CONFIG)
    arrays, header = read(tmp_path / "bad-batch.safetensors")
    assert arrays["points"].shape == (8, 96, 3)
    assert header["stage"] == "canonicalise"
    assert (tiny_data().observation.points.numpy()[arrays["index"]] == arrays["points"]).all()


def test_the_cosine_goes_from_lr_to_its_minimum() -> None:
    stage = Stage(name="s", epochs=1, lr=1e-3, min_lr=1e-6)
    assert learning_rate(stage, 0.0) == pytest.approx(1e-3)
    assert learning_rate(stage, 0.5) == pytest.approx((1e-3 + 1e-6) / 2)
    assert learning_rate(stage, 1.0) == pytest.approx(1e-6)


def test_frozen_groups_stay_until_they_begin(tmp_path: Path) -> None:
    moved: list[tuple[float, bool]] = []
    model = tiny()
    last = [model.encoder.pose.weight.detach().clone()]

    def listener(progress: fit.Progress) -> None:
        now = model.encoder.pose.weight.detach().clone()
        if progress.stage.name == "articulate":
            moved.append((progress.done, not torch.equal(now, last[0])))
        last[0] = now

    fit.fit(model, tiny_data(), tmp_path, CONFIG, listener=listener)
    assert [flag for done, flag in moved if done < 0.5] == [False] * 3
    assert [flag for done, flag in moved if done >= 0.5] == [True] * 3
