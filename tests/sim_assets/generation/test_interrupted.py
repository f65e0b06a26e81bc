# SPDX-License-Identifier: MIT
"""A full disk, a folder that cannot be written, Ctrl-C: one clear line, and a run to continue."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from scapo.store.checkpoint import TRAINING, WEIGHTS
from scapo.store.files import read, read_header
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.training.distributed import Ranks
from scapo.training.log import save_batch
from scapo.training.optimiser import Descent, NotFiniteError, make_optimiser
from scapo.training.precision import Arithmetic, scaler
from scapo.training.run_folder import kept
from scapo.types import Labels, Observation
from tests.helpers import made
from tests.helpers.small import FLAGS
from tests.helpers.tiny import tiny, tiny_data
from tests.helpers.two_ranks import CONFIG, Line


@contextmanager
def full_disk(free: int) -> Iterator[None]:
    """No file may grow beyond so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.is_file()}


def test_a_disk_full_from_the_start(tmp_path: Path) -> None:
    with full_disk(4096), pytest.raises(StoreError) as caught:
        fit.fit(tiny(), tiny_data(), tmp_path / "run", CONFIG)
    assert str(caught.value) == (
        f"{tmp_path / 'run/checkpoint.safetensors'}: expected to be written, found: File too "
        "large; nothing was saved yet"
    )
    assert names(tmp_path / "run") <= {"config.json", "metrics.jsonl"}  # nothing half-written


def test_a_disk_full_in_the_middle_leaves_a_run_to_continue(tmp_path: Path) -> None:
    fit.fit(Line(), tiny_data(), tmp_path / "whole", CONFIG)
    run, steps = tmp_path / "run", 0
    full = r"run/metrics\.jsonl: expected to be written, found: File too large; saved after step 3"

    def fill(progress: fit.Progress) -> None:
        nonlocal steps
        del progress
        steps += 1
        if steps == 4:  # the next file will not fit
            resource.setrlimit(resource.RLIMIT_FSIZE, (16, resource.RLIM_INFINITY))

    with (
        full_disk(resource.RLIM_INFINITY),
        pytest.raises(StoreError, match=full),
    ):
        fit.fit(Line(), tiny_data(), run, CONFIG, listener=fill)
    assert not [name for name in names(run) if name.endswith(".tmp")]
    fit.fit(Line(), tiny_data(), run, CONFIG, resume=True)
    for name in (WEIGHTS, "metrics.jsonl"):
        assert (run / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_file_in_the_way_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"file/run: expected to be written, found: Not a dir"):
        fit.fit(Line(), tiny_data(), tmp_path / "file" / "run", CONFIG)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere")
def test_a_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(StoreError, match="found: Permission denied; nothing was saved yet"):
        fit.fit(Line(), tiny_data(), tmp_path / "run", CONFIG)


def test_the_start_of_a_stage_is_not_done_twice(tmp_path: Path) -> None:
    """It may take minutes; a run stopped before the first epoch's end continues after it."""

    class Counted(Line):
        starts = 0

        def start(
            self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
        ) -> None:
            Counted.starts += 1
            super().start(stage, observation, labels, generator)

    def stop(progress: fit.Progress) -> None:
        raise KeyboardInterrupt(progress.stage.name)

    with pytest.raises(KeyboardInterrupt):
        fit.fit(Counted(), tiny_data(), tmp_path, CONFIG, listener=stop)
    assert kept(tmp_path) == "saved after step 0, resume continues from there"
    fit.fit(Counted(), tiny_data(), tmp_path, CONFIG, resume=True)
    assert Counted.starts == 2  # one per stage


def test_ctrl_c_is_one_line_and_the_run_goes_on(tmp_path: Path) -> None:
    made.make_data(tmp_path / "data", train=16)
    run = tmp_path / "run"
    command = [sys.executable, "-m", "bench", "train", "scapo", "--category", "laptop"]
    command += ["--data", str(tmp_path / "data"), "--out", str(run), "--device", "cpu"]
    command += [*FLAGS["scapo"], "--no-pictures", "--checkpoint-every", "0"]
    command[command.index("--epochs") + 1] = "2000"
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (run / TRAINING).exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert errors.count("\n") == 1
    assert f"{run}: interrupted; saved after step" in errors
    step = read_header(run / TRAINING)["position"]["step"]
    assert f"after step {step}, resume continues" in errors


def test_a_gradient_that_is_not_finite_is_told_from_a_loss(tmp_path: Path) -> None:
    method = Line()
    descent = Descent(
        method=method,
        clip=1.0,
        arithmetic=Arithmetic(),
        device="cpu",
        ranks=Ranks(),
        scaler=scaler("float32", "cpu"),
    )
    optimizer = make_optimiser(method, method.stages()[0])
    method.requires_grad_(True)
    before = method.map.weight.clone()

    def root() -> dict[str, Tensor]:
        return {"root": (method.map.weight - before).abs().sqrt().sum()}  # slope 0 * inf at 0

    with pytest.raises(NotFiniteError) as caught:
        descent.step(optimizer, root, 1.0)
    assert (caught.value.what, caught.value.rank) == ("gradient", 0)
    assert torch.equal(method.map.weight, before)

    def broken() -> dict[str, Tensor]:
        raise torch.linalg.LinAlgError("no SVD")  # pyright: ignore[reportPrivateImportUsage]

    with pytest.raises(NotFiniteError) as caught:
        descent.step(optimizer, broken, 1.0)
    assert caught.value.what == "loss"
    words = save_batch(tmp_path / "b", "s", torch.zeros(1, 2, 3), torch.tensor([4]), {})
    assert words == "a matrix without decomposition"
    assert read(tmp_path / "b")[0]["index"].tolist() == [4]


def test_another_precision_or_clip_does_not_resume(tmp_path: Path) -> None:
    fit.fit(Line(), tiny_data(), tmp_path, CONFIG)
    for other in (
        replace(CONFIG, arithmetic=Arithmetic(precision="bfloat16")),
        replace(CONFIG, clip=1.0),
    ):
        with pytest.raises(StoreError, match="training: expected"):
            fit.fit(Line(), tiny_data(), tmp_path, other, resume=True)
