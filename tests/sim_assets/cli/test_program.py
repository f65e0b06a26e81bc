# SPDX-License-Identifier: MIT
"""Ctrl-C while `scapo-data` starts: exit status 130 and one line, wherever it is by then."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.struck import check_struck


@pytest.mark.parametrize("struck", ["scapo.interrupt", "tyro", "scapo.categories"])
def test_an_interrupt_in_an_import(repository: Path, struck: str) -> None:
    check_struck("sim_assets", struck, repository)
