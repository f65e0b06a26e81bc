# SPDX-License-Identifier: MIT
"""What is printed: one line for what files say, bars on a terminal only."""

from __future__ import annotations

import io

from rich.console import Console

from sim_assets.cli.console import RateColumn, progress_bar, say, say_each
from tests.helpers.odd_names import NAME


def test_what_files_say_is_printed_on_one_line_and_not_obeyed(capsys):
    console = Console(width=80)
    say(console, f"{NAME}: found", label="left out", style="red")
    say_each(console, {NAME: NAME}, label="repaired", style="yellow")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert all(line.isprintable() and len(line) < 3000 for line in lines)
    assert lines[0].startswith(r"left out a \x1b[2J[/x] [red]$\frac{$\x07yyy")


def test_progress_shows_on_a_terminal_only():
    for terminal in (True, False):
        stream = io.StringIO()
        console = Console(file=stream, force_terminal=terminal, width=100)
        with progress_bar(console) as show:
            show("samples", 0, 10)
            show("samples", 10, 10)
        assert ("10/10" in stream.getvalue()) is terminal
    assert RateColumn().max_refresh is None
