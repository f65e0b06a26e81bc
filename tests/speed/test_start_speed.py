# SPDX-License-Identifier: MIT
"""How long the programs take to start: their help, and each verb up to its refusal of no input."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

HELP_SECONDS, START_SECONDS = 1.0, 2.5
NONE = "no-such-input"
PREDICTIONS = ["--predictions", NONE, "--data", NONE, "--out", "x.csv.gz"]
RUN = [NONE, "--data", NONE, "--out", "x"]
CASES = {
    "bench --help": (0, HELP_SECONDS),
    "bench --version": (0, HELP_SECONDS),
    "sim_assets --help": (0, HELP_SECONDS),
    "sim_assets --version": (0, HELP_SECONDS),
    f"bench train icp --category laptop --data {NONE} --out x": (1, START_SECONDS),
    f"bench predict {' '.join(RUN)}": (1, START_SECONDS),
    f"bench evaluate {' '.join(PREDICTIONS)}": (1, START_SECONDS),
    f"bench tables --scores {NONE}": (1, START_SECONDS),
    f"bench explain {' '.join(PREDICTIONS)}": (1, START_SECONDS),
    f"bench stability {' '.join(RUN)}": (1, START_SECONDS),
    f"bench pictures {' '.join(RUN)} --predictions {NONE}": (1, START_SECONDS),
    f"bench study {' '.join(RUN)}": (1, START_SECONDS),
    f"bench reference constant --category laptop --data {NONE} --out x": (1, START_SECONDS),
    "sim_assets build laptop --count 0 --out x": (1, START_SECONDS),
    f"sim_assets check {NONE}": (1, START_SECONDS),
    "sim_assets generate laptop --count 0 --out x": (1, START_SECONDS),
    f"sim_assets benchmark sim-art/1 --only {NONE} --out x": (1, START_SECONDS),
    f"sim_assets import hoi4d {NONE} --out x": (1, START_SECONDS),
    f"sim_assets info {NONE}": (1, START_SECONDS),
    f"sim_assets preview {NONE} --out x.png": (1, START_SECONDS),
    f"sim_assets view {NONE}": (1, START_SECONDS),
}
"""Command -> its exit code and the seconds it may take."""


@pytest.mark.parametrize("command", CASES)
def test_start(command, benchmark, tmp_path, repository):
    code, limit = CASES[command]
    environment = {**os.environ, "PYTHONPATH": str(repository), "OMP_NUM_THREADS": "1"}

    def start():
        done = subprocess.run([sys.executable, "-m", *command.split()], cwd=tmp_path,
                              env=environment, capture_output=True, check=False)  # fmt: skip
        assert done.returncode == code, done.stderr

    benchmark.pedantic(start, rounds=3, warmup_rounds=1)
    if benchmark.stats is not None:  # not where it is only checked that it runs
        assert benchmark.stats.stats.min <= limit
