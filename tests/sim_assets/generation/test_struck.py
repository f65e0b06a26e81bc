# SPDX-License-Identifier: MIT
"""Single workers are killed or stopped in every phase while SAPIEN renders: the same bytes.

`python -m tests.sim_assets.generation.test_struck 20` does so for as many rounds and counts them.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from scapo.parallel import pool as pools
from scapo.parallel.pool import Pool
from sim_assets.generation.assets import Asset
from sim_assets.generation.generate import Made, Running, generate
from sim_assets.generation.request import make_request, versions
from sim_assets.generation.shard import ShardJob
from sim_assets.options import DataOptions

OPTIONS = DataOptions(count=192, instances=3, points=64, image_size=96, backend="sapien")
PHASES = ("start", "describe", "render")
TIMEOUT = 20.0
"""Seconds after which a stopped worker counts as hung."""


def make(folder: Path, pool: Pool[Any, Any]) -> Made:
    request, assets = make_request("laptop", OPTIONS)
    found = versions(request.settings.backend)
    return generate(request, assets, folder, found, Running(), pool)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def phase_of(worker: Any) -> str:
    if worker.attempt is None:
        return ""
    if not worker.begun:
        return "start"
    if isinstance(worker.attempt.job, ShardJob):
        return "render"
    return "describe" if isinstance(worker.attempt.job, Asset) else ""


def strike(pool: Pool[Any, Any], phase: str, how: signal.Signals, rng: random.Random) -> bool:
    """Wait for a worker in the phase, and a little longer; whether one was struck in it."""
    until = time.monotonic() + 120
    while time.monotonic() < until:
        there = [worker for worker in list(pool._workers) if phase_of(worker) == phase]
        if there:
            victim = rng.choice(there)
            time.sleep(rng.uniform(0, {"start": 1.0, "describe": 0.02, "render": 0.4}[phase]))
            if phase_of(victim) == phase and victim.process.is_alive():
                os.kill(victim.process.pid, how)
                return True
        time.sleep(0.001)
    return False


def play(folder: Path, rounds: int) -> Counter[str]:
    """How many strikes landed, by phase and signal; every round must end with the same bytes."""
    with Pool[Any, Any](2) as pool:
        whole = content(make(folder / "whole", pool).folder)
    landed: Counter[str] = Counter()
    kinds = list(product((signal.SIGKILL, signal.SIGSTOP), PHASES))
    for number in range(rounds):
        how, phase = kinds[number % len(kinds)]
        rng = random.Random(number)
        with Pool[Any, Any](2, timeout=TIMEOUT) as pool:
            hits: list[bool] = []
            killer = threading.Thread(
                target=lambda pool=pool, hits=hits, phase=phase, how=how, rng=rng: hits.append(
                    strike(pool, phase, how, rng)
                )
            )
            killer.start()
            made = make(folder / str(number), pool)
            killer.join()
        assert made.failed == {}
        assert content(made.folder) == whole, (number, phase, how)
        landed[f"{how.name} {phase}"] += hits[0]
    return landed


@pytest.mark.slow
@pytest.mark.render
def test_a_worker_struck_in_any_phase_changes_no_byte(tmp_path, monkeypatch):
    monkeypatch.setattr(pools, "START", TIMEOUT)
    landed = play(tmp_path, 4)
    assert landed.total() >= 3, landed


if __name__ == "__main__":
    pools.START = TIMEOUT
    with tempfile.TemporaryDirectory() as place:
        begun = time.monotonic()
        print(play(Path(place), int(sys.argv[1])), f"{time.monotonic() - begun:.0f} s")  # noqa: T201
