# SPDX-License-Identifier: MIT
"""How long the programs take to start: their help, and each verb up to its refusal of no input.

Verbs that compute import torch, which takes one to three seconds by the machine and the hour: what
they may take is counted beside that.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

HELP_SECONDS, START_SECONDS = 1.0, 1.5
"""Of help; of all else, beside the import of torch."""
NONE = "no-such-input"
PREDICTIONS = ["--predictions", NONE, "--data", NONE, "--out", "x.csv.gz"]
RUN = [NONE, "--data", NONE, "--out", "x"]
CASES = {
    "bench --help": 0,
    "bench --version": 0,
    "sim_assets --help": 0,
    "sim_assets --version": 0,
    f"bench train icp --category laptop --data {NONE} --out x": 1,
    f"bench predict {' '.join(RUN)}": 1,
    f"bench evaluate {' '.join(PREDICTIONS)}": 1,
    f"bench tables --scores {NONE}": 1,
    f"bench explain {' '.join(PREDICTIONS)}": 1,
    f"bench stability {' '.join(RUN)}": 1,
    f"bench pictures {' '.join(RUN)} --predictions {NONE}": 1,
    f"bench study {' '.join(RUN)}": 1,
    f"bench reference constant --category laptop --data {NONE} --out x": 1,
    "sim_assets build laptop --count 0 --out x": 1,
    f"sim_assets check {NONE}": 1,
    "sim_assets generate laptop --count 0 --out x": 1,
    f"sim_assets benchmark sim-art/1 --only {NONE} --out x": 1,
    f"sim_assets import hoi4d {NONE} --out x": 1,
    f"sim_assets info {NONE}": 1,
    f"sim_assets preview {NONE} --out x.png": 1,
    f"sim_assets view {NONE}": 1,
}
"""Command -> its exit code."""


@pytest.fixture(scope="module")
def of_torch():
    """Seconds that importing torch takes here: the least of three times, after a first one."""

    def once():
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import torch"], check=True)
        return time.perf_counter() - began

    once()
    return min(once() for _ in range(3))


@pytest.mark.parametrize("command", CASES)
def test_start(command, benchmark, tmp_path, repository, of_torch):
    code = CASES[command]
    limit = HELP_SECONDS if code == 0 else of_torch + START_SECONDS
    environment = {**os.environ, "PYTHONPATH": str(repository), "OMP_NUM_THREADS": "1"}

    def start():
        done = subprocess.run([sys.executable, "-m", *command.split()], cwd=tmp_path,
                              env=environment, capture_output=True, check=False)  # fmt: skip
        assert done.returncode == code, done.stderr

    benchmark.pedantic(start, rounds=3, warmup_rounds=1)
    if benchmark.stats is not None:  # not where it is only checked that it runs
        assert benchmark.stats.stats.min <= limit
