# SPDX-License-Identifier: MIT
"""`scapo-data` as a user types it."""

from __future__ import annotations

import pytest

from sim_assets.__main__ import main


def run(*arguments: object) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code
