# SPDX-License-Identifier: MIT
"""Training speed of preset `cpu` at N = 1024, and what limits it (`make bench`).

Per stage, in fresh processes of one thread, one for each core, as `torchrun` starts them (threads
of one process gain nothing: the tensors are small): samples per second by the clock and per second
of CPU time (which other programs on the machine hardly change), peak memory of each, the operators
that take most time, and how often it is faster per sample than a literal step. The exchange of
gradients is not in it.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from scapo.categories import CATEGORIES
from scapo.geometry.points import normalise
from scapo.method import Step
from scapo.paper.config import ScapoConfig, cpu_config
from scapo.paper.method import ARTICULATE, CANONICALISE, Scapo
from scapo.types import Labels, Observation

POINTS = 1024
TARGET = 5.0
"""How many times faster than the literal step, per sample."""
SAMPLES = 5000
"""Of one category of the benchmark's training split."""


def clouds(count: int) -> Tensor:
    """Random clouds of the benchmark's size."""
    generator = torch.Generator().manual_seed(0)
    return 0.2 * torch.randn(count, POINTS, 3, generator=generator)


def training_step(config: ScapoConfig, stage: str, batch: int) -> Callable[[], None]:
    """One forward and backward pass with Adam's update."""
    model = Scapo(config, CATEGORIES["laptop"], torch.Generator().manual_seed(0)).train()
    if stage == ARTICULATE:
        model.encoder.requires_grad_(False)
        model.decoder.requires_grad_(False)
    optimizer = torch.optim.Adam(model.parameters(), fused=True)
    observation, noise = Observation(points=clouds(batch)), torch.Generator().manual_seed(1)

    def step() -> None:
        where = Step(stage=stage, progress=0.1, generator=noise, index=torch.arange(1), total=1)
        total = torch.stack(list(model.losses(observation, Labels(), where).values())).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()

    return step


def literal_step(batch: int) -> Callable[[], None]:
    """VNT as published, with the Chamfer distance taken from the whole matrix under autograd."""
    model = Scapo(ScapoConfig(), CATEGORIES["laptop"], torch.Generator().manual_seed(0)).train()
    points, _ = normalise(clouds(batch))

    def step() -> None:
        encoding = model.encoder(points)
        shape, _ = model.decoder(encoding.code)
        square = torch.cdist(encoding.place(shape), points).square()
        total = square.amin(1).mean() + square.amin(2).mean()
        total.backward()

    return step


@dataclass(frozen=True, slots=True, kw_only=True)
class Speed:
    """Of one kind of step."""

    per_second: float
    """Samples, by the clock, of all processes."""
    per_cpu_second: float
    peak: float
    """Memory of one process beyond that of the imported libraries, MiB."""
    operators: tuple[tuple[str, float], ...]
    """Share of the CPU time of the operators that take most."""


def high_water() -> float:
    """Largest resident size of this process so far, MiB; 0 where there is no /proc."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return sum(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


def measure(stage: str, rounds: int) -> Speed:
    """Median time of a few steps after one that warms up; stage "" is the literal step."""
    torch.set_num_threads(1)
    before = high_water()
    batch = cpu_config().batch if stage else 2
    step = training_step(cpu_config(), stage, batch) if stage else literal_step(batch)
    step()
    walls, cpus = [], []
    for _ in range(rounds):
        wall, cpu = time.perf_counter(), time.process_time()
        step()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return Speed(
        per_second=batch / median(walls),
        per_cpu_second=batch / median(cpus),
        peak=high_water() - before,
        operators=limits(step),
    )


def limits(step: Callable[[], None], count: int = 8) -> tuple[tuple[str, float], ...]:
    """The operators with the largest own time in one step."""
    with profile(activities=[ProfilerActivity.CPU]) as record:
        step()
    rows = [row for row in record.key_averages() if not row.key.startswith("autograd::")]
    total = sum(row.self_cpu_time_total for row in rows)
    rows.sort(key=lambda row: -row.self_cpu_time_total)
    return tuple((row.key, row.self_cpu_time_total / total) for row in rows[:count])


def apart(stage: str, processes: int, rounds: int) -> Speed:
    """`measure` in fresh processes side by side, whose memory is that of this stage alone."""
    spawn = multiprocessing.get_context("spawn")
    with pytest.MonkeyPatch.context() as patch, ProcessPoolExecutor(processes, spawn) as pool:
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            patch.setenv(name, "1")
        found = list(pool.map(measure, [stage] * processes, [rounds] * processes))
    return replace(
        found[0],
        per_second=sum(speed.per_second for speed in found),
        per_cpu_second=sum(speed.per_cpu_second for speed in found) / processes,
    )


@pytest.mark.timeout(3600)
def test_training_of_the_cpu_preset(
    benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    cores, config = os.cpu_count() or 1, cpu_config()
    literal = apart("", cores, 3)
    found = {stage: apart(stage, cores, 20) for stage in (CANONICALISE, ARTICULATE)}
    epochs = dict(zip(found, config.epochs, strict=True))
    seconds = sum(epochs[stage] * SAMPLES / speed.per_second for stage, speed in found.items())
    lines = [f"\npreset cpu, N = {POINTS}, batch {config.batch}, {cores} processes; load "
             f"{os.getloadavg()[0]:.1f}"]  # fmt: skip
    for stage, speed in found.items():
        ratio = speed.per_cpu_second / literal.per_cpu_second
        lines += [
            f"{stage}: {speed.per_second:.0f} samples/s, {speed.per_cpu_second:.0f} per CPU "
            f"second, {ratio:.1f} times the literal step, peak {speed.peak:.0f} MiB",
            "  " + ", ".join(f"{name.removeprefix('aten::')} {100 * share:.0f} %"
                             for name, share in speed.operators),
        ]  # fmt: skip
    lines += [
        f"literal step: {literal.per_second:.1f} samples/s, {literal.per_cpu_second:.1f} per CPU "
        f"second, peak {literal.peak:.0f} MiB",
        f"both stages of {SAMPLES:,} samples: {seconds / 60:.1f} minutes",
    ]
    with capsys.disabled():
        print("\n".join(lines))  # noqa: T201 - what `make bench` is for
    benchmark.extra_info["speed"] = lines
    benchmark.pedantic(training_step(config, CANONICALISE, config.batch), rounds=3)
    # Per sample, all of stage 1 (three encodings) against one encoding, decoder and Chamfer.
    assert min(s.per_cpu_second for s in found.values()) > TARGET * literal.per_cpu_second
