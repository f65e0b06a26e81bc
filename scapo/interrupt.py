# SPDX-License-Identifier: MIT
"""How a program ends that was interrupted."""

from __future__ import annotations

import sys
from typing import NoReturn

INTERRUPTED = 130
"""Exit status of a program ended by Ctrl-C, as a shell reports it: 128 + SIGINT."""


def exit_interrupted() -> NoReturn:
    """End the process as interrupted, after whatever was to be said of it.

    CPython notes an interrupt that leaves code given to `exec` as a string, which is how every
    dataclass and named tuple of an import is made, and under `python -m` ends by the signal itself
    whatever exit status is raised later (`exit_sigint` in its Modules/main.c). Code that is
    evaluated afterwards takes the note away.
    """
    eval("0")
    sys.exit(INTERRUPTED)
