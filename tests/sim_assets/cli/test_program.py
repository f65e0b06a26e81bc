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


def test_a_verb_that_is_none_is_told_the_one_that_looks_like_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(["generat", "oven"])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("scapo-data: verb 'generat': expected one of doctor, ")
    assert said.endswith("did you mean 'generate'?\n")
