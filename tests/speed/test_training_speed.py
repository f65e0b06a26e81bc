# SPDX-License-Identifier: MIT
"""Samples per second of both stages, and how that compares with a literal step (`make bench`)."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

from scapo.categories import CATEGORIES
from scapo.method import Step
from scapo.model import ARTICULATE, CANONICALISE, Scapo, ScapoConfig, cpu_config
from scapo.points import normalise
from scapo.types import Labels, Observation

POINTS = 1024


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
        where = Step(stage=stage, progress=0.1, generator=noise)
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


@pytest.mark.parametrize("stage", [CANONICALISE, ARTICULATE])
def test_cpu_preset(benchmark: BenchmarkFixture, stage: str) -> None:
    config = cpu_config()
    step = training_step(config, stage, config.batch)
    benchmark.pedantic(step, rounds=5, warmup_rounds=1)
    benchmark.extra_info["samples_per_cpu_second"] = config.batch / seconds(step, 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    benchmark.extra_info["peak_MiB"] = round(peak)


def seconds(function: Callable[[], None], rounds: int) -> float:
    """Least CPU time of a few calls after one that warms up."""
    function()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def test_a_step_is_five_times_faster_than_the_literal_one(benchmark: BenchmarkFixture) -> None:
    """Per sample, all of stage 1 (three encodings) against encoder, decoder and Chamfer alone."""
    lean = seconds(training_step(cpu_config(), CANONICALISE, 32), 3) / 32
    literal = seconds(literal_step(2), 2) / 2
    benchmark.extra_info["times_faster"] = literal / lean
    benchmark.pedantic(lambda: None, rounds=1)
    assert literal > 5 * lean
