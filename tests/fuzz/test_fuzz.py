# SPDX-License-Identifier: MIT
"""Damaged files of every format, the same each time; `make fuzz` tries others for an hour."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.fuzz import play
from tests.fuzz.formats import FORMATS
from tests.fuzz.found import FOUND
from tests.fuzz.play import Game

LENIENT = ("made marker", "MTL", "PNG", "finished", "semantics.txt", "mobility_v2.json")
"""What is wrong in these is left out, and said, or answered with no."""


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path):
    game = Game(name, tmp_path / "game")
    verdicts: Counter[str] = Counter()
    bad = {}
    for number in range(0, FORMATS[name].cases, 2):  # all of them take too long for every run
        finding = game.play(number)
        verdicts[finding.verdict] += 1
        if finding.verdict not in ("read", "refused"):
            bad[number] = (finding.verdict, finding.words[:300])
    assert not bad
    assert verdicts["refused"] or name in LENIENT


@pytest.mark.parametrize("number", range(len(FOUND)))
def test_what_was_found_stays_refused(number: int, tmp_path: Path):
    name, change = FOUND[number]
    game = Game(name, tmp_path / "game")
    finding = game.attempt(change(game.good[game.file]))
    assert finding.verdict == "refused", finding.words


@pytest.mark.parametrize(("spare", "verdict"), [(64 << 20, "read"), (-1, "memory")])
def test_only_what_a_file_itself_takes_is_held_against_it(
    spare: int, verdict: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # What ran in this process before has held more than this already.
    monkeypatch.setattr(play, "BYTES", spare)
    assert play.peak() > spare
    game = Game("STL", tmp_path / "game")
    assert game.attempt(game.good[game.file]).verdict == verdict
