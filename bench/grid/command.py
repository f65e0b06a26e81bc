# SPDX-License-Identifier: MIT
"""One command of this project in a process of its own, with its log."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from bench.grid import guard

Program = Literal["scapo-bench", "scapo-data"]
MODULES: dict[Program, str] = {"scapo-bench": "bench", "scapo-data": "sim_assets"}
"""The two programs see each other's files alone, so each is started, never imported."""
TICK = 2.0
"""Seconds between signs of life."""


class StepError(RuntimeError):
    """A command failed; the message names it, its log and the log's last line."""


def run_command(
    program: Program,
    words: Sequence[str],
    log: Path,
    *,
    processes: int = 1,
    alive: Callable[[], None] = lambda: None,
) -> float:
    """Run a command to its end; it does not outlive this process.

    Args:
        program: Which of the two.
        words: Verb and flags.
        log: File for all that it prints.
        processes: Above 1, as many processes of torchrun, one for each GPU.
        alive: Called every `TICK` seconds.

    Returns:
        The seconds it took.

    Raises:
        StepError: It ended with another status than 0.
    """
    torchrun = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    runner = torchrun if processes > 1 else []
    command = [sys.executable, *runner, "-m", MODULES[program], *words]
    log.parent.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    with (
        log.open("wb") as file,
        subprocess.Popen(
            [sys.executable, guard.__file__, *command],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            env={"OMP_NUM_THREADS": "1", **os.environ},
        ) as process,
    ):
        try:
            while (code := _waited(process)) is None:
                alive()
        finally:
            if process.stdin is not None:
                process.stdin.close()  # ends it, where this was left by an error
    if code != 0:
        raise StepError(f"{program} {words[0]} ended {code}: {last_line(log)} (log: {log})")
    return time.perf_counter() - started


def _waited(process: subprocess.Popen[bytes]) -> int | None:
    try:
        return process.wait(TICK)
    except subprocess.TimeoutExpired:
        return None


def last_line(log: Path) -> str:
    """The last line of a log that says anything, without the frame of a box."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    said = [line.strip(" │") for line in lines if any(map(str.isalnum, line))]
    return said[-1] if said else "no output"
