# SPDX-License-Identifier: MIT
"""Bounds of memory and time within which one asset is read, whatever its files say.

What the files say of themselves is checked where it is read; these bounds hold for what nobody
thought of: a loader that squares the number of materials, an array of which only the size is given.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import numpy as np

from sim_assets.formats.pickled import UnpickleError
from sim_assets.models.validate import AssetError, refuse

try:
    import resource
except ImportError:  # Windows
    resource = None

READ_MEMORY = 3 << 29
"""Bytes that reading one asset may take beyond what the process has: with that below two gibibytes.
A million triangles take two thirds of them, in COLLADA the most."""
READ_SECONDS = 20.0
"""Processor seconds that reading one asset may take: not the clock's, so that a busy machine
refuses nothing that an idle one accepts. An STL of a million triangles takes a third of them."""
CLOCK_SECONDS = 30.0
"""Seconds by the clock after which a worker that reads an asset for the first time is ended. If it
had the processor for most of them the asset is refused; else the machine was slow, and the asset is
read again after the others, for as long as `--timeout` allows."""
TICK = 0.5
"""Processor seconds between looks at the clock."""
LOST = ("remove", "_remove", "__del__")
"""Functions that Python calls when an object goes, of `weakref` and destructors: what is raised in
them is lost, with a warning."""


class _TooLongError(BaseException):
    """Raised in the middle of reading; loaders that go on after an `Exception` do not catch it."""


_bounded = threading.local()


@contextmanager
def bounded(path: Path, memory: int = READ_MEMORY) -> Iterator[None]:
    """Refuse an asset that takes too much memory or time, or fails in a way of its own.

    Within another such context it does nothing. The time is bounded in a main thread only.

    Raises:
        AssetError: Naming the file; in place of any error but `UnpickleError`.
    """
    if getattr(_bounded, "active", False):
        yield
        return
    _bounded.active = True
    try:
        # Numbers that overflow are refused by their values, not by lines of warnings.
        with _timed() as is_late, limited_memory(memory), np.errstate(all="ignore"):
            try:
                yield
            except Exception:
                if is_late():
                    raise _TooLongError from None
                raise
        if is_late():  # a loader caught it and went on without what it was about to read
            raise _TooLongError
    except (AssetError, UnpickleError):
        raise
    except (Exception, _TooLongError) as error:
        raise refuse(path, *_words(path, error, memory)) from error
    finally:
        _bounded.active = False


def _words(path: Path, error: BaseException, memory: int) -> tuple[str, str]:
    """What was expected, and what was found."""
    if isinstance(error, _TooLongError):
        return f"to be read in {READ_SECONDS:g} s", "that it takes longer"
    if isinstance(error, MemoryError):
        hint = ", as a million triangles are" if path.suffix == ".urdf" else ""
        return f"to be read in {memory >> 20} MiB of memory{hint}", f"MemoryError {error}"
    if isinstance(error, RecursionError):
        return "contents of sane depth", "deeper ones"
    return "to be read", f"{type(error).__name__}: {error}"


@contextmanager
def _timed() -> Iterator[Callable[[], bool]]:
    """Raise `_TooLongError` in this thread, if it is the main one, once its time is up."""
    begun = time.thread_time()

    def is_late() -> bool:
        return time.thread_time() - begun > READ_SECONDS

    if threading.current_thread() is not threading.main_thread():
        yield is_late
        return

    def look(_: int, frame: FrameType | None) -> None:
        lost = frame is not None and frame.f_code.co_name in LOST  # the next tick is elsewhere
        if is_late() and not lost and getattr(_bounded, "active", False):
            raise _TooLongError

    before = signal.signal(signal.SIGPROF, look)
    signal.siginterrupt(signal.SIGPROF, False)  # calls of other threads go on
    signal.setitimer(signal.ITIMER_PROF, TICK, TICK)
    try:
        yield is_late
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def limited_memory(extra: int) -> Iterator[None]:
    """Let this process take `extra` bytes more than it has now; beyond it memory errors arise.

    Does nothing where the system has no such limit (Windows) or does not tell its size (macOS).
    """
    taken = _taken()
    if resource is None or taken is None:
        yield
        return
    before, hard = resource.getrlimit(resource.RLIMIT_AS)
    bounds = [bound for bound in (before, hard) if bound != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min([taken + extra, *bounds]), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, hard))


def _taken() -> int | None:
    """Bytes of address space that this process has."""
    with suppress(OSError, ValueError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        return pages * resource.getpagesize() if resource is not None else None
    return None
