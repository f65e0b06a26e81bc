# SPDX-License-Identifier: MIT
"""Commands with their logs, and what they become for several GPUs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bench.grid import command, guard
from bench.grid.command import StepError, last_line, run_command


def test_the_last_line_of_a_log_says_something(tmp_path: Path):
    log = tmp_path / "log.txt"
    log.write_text("first\n│ found 'x' │\n╰────╯\n\n")
    assert last_line(log) == "found 'x'"
    log.write_text("")
    assert last_line(log) == "no output"


def test_a_training_on_several_gpus_is_torchruns(tmp_path: Path, monkeypatch):
    seen = tmp_path / "seen"
    monkeypatch.setattr(guard, "__file__", str(tmp_path / "echo.py"))
    Path(guard.__file__).write_text(
        f"import sys\nopen({str(seen)!r}, 'w').write(str(sys.argv[1:]))"
    )
    run_command("scapo-bench", ["train"], tmp_path / "log.txt", processes=2)
    words = seen.read_text()
    assert "'torch.distributed.run', '--standalone', '--nproc-per-node=2', '-m', 'bench'" in words
    run_command("scapo-bench", ["train"], tmp_path / "log.txt")
    assert "torch" not in seen.read_text()


def test_alive_is_called_while_it_goes_on(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(command, "TICK", 0.02)
    heard: list[int] = []
    with pytest.raises(StepError, match=r"scapo-bench --nonsense ended 2: .*log\.txt"):
        run_command(
            "scapo-bench", ["--nonsense"], tmp_path / "log.txt", alive=lambda: heard.append(1)
        )
    assert heard


@pytest.mark.parametrize(
    ("code", "found"), [("raise SystemExit(3)", 3), ("import os; os.kill(os.getpid(), 9)", 137)]
)
def test_the_guard_ends_as_its_command_does(code: str, found: int):
    words = [sys.executable, guard.__file__, sys.executable, "-S", "-c", code]
    with subprocess.Popen(words, stdin=subprocess.PIPE) as process:
        assert process.wait() == found
