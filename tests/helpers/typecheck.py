# SPDX-License-Identifier: MIT
"""The type checker of the test run: calls of our packages, shapes included.

Of each function the first `CALLS` calls in a test are checked: those of a loop that follow have the
same shapes, and checking takes ten times what a small function does. A function's checks are built
at its first call, since most of those that a process imports are never called there.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import Lock
from typing import Any

import torch
from beartype import BeartypeConf, beartype

CALLS = 2
CURRENT = "PYTEST_CURRENT_TEST"
"""Set by pytest: the test, and whether it is its setup, its call or its teardown."""
_building = Lock()
"""Held while checks are built: beartype has locks that wait for themselves."""
_strict = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float, as for pyright


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, which raises where arguments or result are none of those declared.

    Args:
        function: Made by jaxtyping, with the annotations of one of ours: it does nothing, and what
            it returns is not used.
    """
    strict, test, calls = None, None, 0

    def check(*args: Any, **kwargs: Any) -> Any:
        nonlocal strict, test, calls
        if torch.compiler.is_compiling():
            return None  # what is traced must not count
        if (now := os.environ.get(CURRENT)) != test:
            test, calls = now, 0
        calls += 1
        if calls > CALLS:
            return None
        if strict is None:
            if not _building.acquire(blocking=False):
                return None  # a handler of signals, called while another's checks are built
            try:
                strict = _strict(function)
            finally:
                _building.release()
        return strict(*args, **kwargs)

    return check
