# SPDX-License-Identifier: MIT
"""A program that is interrupted while it imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

# Interrupts its own process at the import of one module, then runs a program as `python -m` does.
STRUCK = """
import os, runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class Strike:
    def find_spec(self, name, *_):
        if name == {struck!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Strike())
sys.argv[1:] = ["--help"]
runpy.run_module({program!r}, run_name="__main__", alter_sys=True)
"""


def check_struck(program: str, struck: str, repository: Path) -> None:
    """An interrupt at the import of module `struck` ends the program 130 with one line."""
    ended = subprocess.run(
        [sys.executable, "-c", STRUCK.format(struck=struck, program=program)],
        cwd=repository,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 130, ended.stderr
    assert ended.stderr.count("\n") == 1, ended.stderr
    assert ended.stderr.endswith(": interrupted\n")
