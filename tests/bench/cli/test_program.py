# SPDX-License-Identifier: MIT
"""Ctrl-C while `scapo-bench` or the demo starts: status 130 and one line, wherever it is then."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.cli.program import run
from tests.helpers.struck import check_struck


@pytest.mark.parametrize("struck", ["scapo.interrupt", "tyro", "bench.cli.verbs"])
def test_an_interrupt_in_an_import(repository: Path, struck: str) -> None:
    check_struck("bench", struck, repository)


@pytest.mark.parametrize("struck", ["tyro", "torch"])
def test_an_interrupt_in_an_import_of_the_demo(repository: Path, struck: str) -> None:
    check_struck("bench.demo", struck, repository)


@pytest.mark.parametrize(
    ("words", "kind", "meant"),
    [(["trian"], "verb", "train"), (["train", "registerd", "--seed", "1"], "method", "registered")],
)
def test_a_verb_or_method_that_is_none_is_told_the_one_that_looks_like_it(
    words: list[str], kind: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(words)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"scapo-bench: {kind} ")
    assert said.endswith(f"did you mean '{meant}'?\n")


@pytest.mark.parametrize("words", [["predict", "registerd"], ["train", "--help"], ["--help"]])
def test_other_words_are_left_to_the_parser(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A run may have any name, and flags may come first."""
    with pytest.raises(SystemExit):
        run(words)
    shown = capsys.readouterr()
    assert "did you mean" not in shown.out + shown.err
