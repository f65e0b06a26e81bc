# SPDX-License-Identifier: MIT
"""An interrupted program's exit status, wherever the interrupt came."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from scapo.interrupt import quit_at_interrupt

# As a module that is run by `python -m`; `exec` of a string is how dataclasses are made.
PROGRAM = """
from scapo.interrupt import exit_interrupted
try:
    {raised}
except KeyboardInterrupt:
    {ended}
"""


@pytest.mark.parametrize("raised", ["raise KeyboardInterrupt", "exec('raise KeyboardInterrupt')"])
def test_status_of_an_interrupted_module(tmp_path: Path, raised: str) -> None:
    words = PROGRAM.format(raised=raised, ended="exit_interrupted()")
    (tmp_path / "interrupted_module.py").write_text(words)
    ended = subprocess.run(
        [sys.executable, "-m", "interrupted_module"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (130, "")


def test_a_program_may_begin_in_another_thread() -> None:
    """Where signals are none of its business."""

    def begin() -> str:
        with quit_at_interrupt("program"):
            return "begun"

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(begin).result() == "begun"


@pytest.mark.parametrize("program", ["scapo-bench", "scapo-data"])
def test_a_reader_that_goes_away_is_no_error(program: str) -> None:
    """`scapo-bench --help | head -1`."""
    command = [Path(sys.executable).parent / program, "--help"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, text=True, stdout=pipe, stderr=pipe) as running:
        assert running.stdout
        assert running.stderr
        running.stdout.close()
        assert running.stderr.read() == ""
    assert running.returncode == 141
