# SPDX-License-Identifier: MIT
"""How a program ends that was interrupted. Only the standard library: it is imported first."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

INTERRUPTED = 130
"""Exit status of a program ended by Ctrl-C, as a shell reports it: 128 + SIGINT."""

UNHEARD = 141
"""Exit status of a program whose reader went away, as a shell reports it: 128 + SIGPIPE."""


@contextmanager
def quit_at_interrupt(program: str) -> Iterator[None]:
    """Within, an interrupt ends the process at once with one line.

    For a program's own imports: there is nothing to tidy up yet, and an interrupt that is raised
    in one may get lost in a callback or come out as another error. Where interrupts are ignored or
    somebody else's business, as in another thread than the main one, that stays.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def leave(*_: object) -> None:
        os.write(2, f"{program}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def interrupted_imports() -> Iterator[None]:
    """Within, the import of a module in C++ that is interrupted raises the interrupt.

    pybind11 makes an ImportError of it, as where matplotlib is imported for the first picture.
    """
    try:
        yield
    except ImportError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise


def exit_interrupted(line: str = "") -> NoReturn:
    """End the process as interrupted, after a line on stderr if there is one to be said.

    CPython notes an interrupt that leaves code given to `exec` as a string, which is how every
    dataclass and named tuple of an import is made, and under `python -m` ends by the signal itself
    whatever exit status is raised later (`exit_sigint` in its Modules/main.c). Code that is
    evaluated afterwards takes the note away.
    """
    if line:
        sys.stderr.write(f"{line}\n")
    eval("0")
    sys.exit(INTERRUPTED)


def exit_if_unheard() -> None:
    """End silently the process whose output nobody reads any more (`scapo-bench --help | head`).

    A pipe that broke elsewhere, as to a worker, is left to the caller. What is still buffered goes
    nowhere, or the interpreter would complain of it at its end.
    """
    stdout, poll = sys.stdout.fileno(), select.poll()
    poll.register(stdout, 0)  # errors are told of whatever is asked for
    if any(event & select.POLLERR for _, event in poll.poll(0)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stdout)
        sys.exit(UNHEARD)
