# SPDX-License-Identifier: MIT
"""Ctrl-C while `scapo-data` starts: exit status 130 and one line; verbs that are none."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_assets.cli.program import run
from tests.helpers.struck import check_struck


@pytest.mark.parametrize("struck", ["scapo.interrupt", "tyro", "scapo.categories"])
def test_an_interrupt_in_an_import(repository: Path, struck: str) -> None:
    check_struck("sim_assets", struck, repository)


def test_a_place_that_is_a_file_is_told_with_what_was_expected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as ended:
        run(["build", "oven", "--count", "1", "--out", str(tmp_path / "file")])
    assert ended.value.code == 1
    said = capsys.readouterr().err
    where, expected = tmp_path / "file/oven", "a place that can be read or written"
    assert said == f"scapo-data: {where}: expected {expected}, found: Not a directory\n"


def test_a_verb_that_is_none_is_told_the_one_that_looks_like_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(["generat", "oven"])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("scapo-data: verb 'generat': expected one of doctor, ")
    assert said.endswith("did you mean 'generate'?\n")


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (["benchmark", "sim-art/2", "--only", "--out", "x"], "--only"),
        (["generate", "oven", "--source=", "--out", "x"], "--source"),
        (["generate", "oven", "--out", ""], "--out"),
    ],
)
def test_a_flag_with_nothing_to_it_is_refused_before_any_work(
    words: list[str], flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"scapo-data: {flag}: expected a value, found none\n"
