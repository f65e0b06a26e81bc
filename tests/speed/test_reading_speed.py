# SPDX-License-Identifier: MIT
"""Batches and megabytes per second of the torch Dataset, shuffled, in one process: `make bench`.

A GPU trainer that takes batches of 64 clouds of 1,024 points in 10 ms reads 100 batches or 6,400
clouds per second; the reader must do that with one process to spare.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch.utils.data import DataLoader

from scapo.store import dataset
from tests.helpers.made import sample_arrays, write_split

SAMPLES, POINTS, BATCH = 2000, 1024, 64
LEAST = 100.0
"""Batches per second of processor time."""


@pytest.mark.parametrize("workers", [0, 1], ids=["here", "one worker"])
def test_shuffled_batches(workers: int, tmp_path: Path, benchmark: BenchmarkFixture) -> None:
    write_split(
        tmp_path, "laptop", "train", sample_arrays("laptop", SAMPLES, POINTS), shard_size=50
    )
    data = dataset(tmp_path, "laptop", "train")
    loader = DataLoader(
        data,
        batch_size=BATCH,
        shuffle=True,
        num_workers=workers,
        generator=torch.Generator().manual_seed(0),
        persistent_workers=workers > 0,
    )
    used: list[float] = []
    waited: list[float] = []

    def once() -> int:
        started, clock = time.process_time(), time.perf_counter()
        size = sum(x.numel() * x.element_size() for batch in loader for x in batch.values())
        used.append(time.process_time() - started)
        waited.append(time.perf_counter() - clock)
        return size

    size = benchmark.pedantic(once, rounds=3, warmup_rounds=1)
    wall = min(waited)
    count = len(loader)
    print(  # noqa: T201
        f"\n{count / wall:.0f} batches/s, {SAMPLES / wall:.0f} clouds/s, {size / wall / 1e6:.0f} "
        f"MB/s by the clock; {count / min(used):.0f} batches/s of this process's time"
    )
    if not workers:
        assert count / min(used) > LEAST
