# SPDX-License-Identifier: MIT
"""Ctrl-C while `scapo-bench` or the demo starts: status 130 and one line, wherever it is then."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.struck import check_struck


@pytest.mark.parametrize("struck", ["scapo.interrupt", "tyro", "bench.cli.verbs"])
def test_an_interrupt_in_an_import(repository: Path, struck: str) -> None:
    check_struck("bench", struck, repository)


@pytest.mark.parametrize("struck", ["tyro", "torch"])
def test_an_interrupt_in_an_import_of_the_demo(repository: Path, struck: str) -> None:
    check_struck("bench.demo", struck, repository)


@pytest.mark.parametrize("delay", [0.15, 0.3, 0.6, 1.0])
def test_an_interrupt_soon_after_the_start(tmp_path: Path, repository: Path, delay: float) -> None:
    """From outside, wherever it is by then; help of a method, which takes seconds to import."""
    running = subprocess.Popen(
        [sys.executable, "-m", "bench", "train", "icp", "--help"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(repository)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(delay)
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors.count("\n")) == (130, 1), errors
