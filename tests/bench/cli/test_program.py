# SPDX-License-Identifier: MIT
"""Ctrl-C while `scapo-bench` or the demo starts: status 130 and one line, wherever it is then."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.struck import check_struck


@pytest.mark.parametrize("struck", ["scapo.interrupt", "tyro", "bench.cli.verbs"])
def test_an_interrupt_in_an_import(repository: Path, struck: str) -> None:
    check_struck("bench", struck, repository)


@pytest.mark.parametrize("struck", ["tyro", "torch"])
def test_an_interrupt_in_an_import_of_the_demo(repository: Path, struck: str) -> None:
    check_struck("bench.demo", struck, repository)
