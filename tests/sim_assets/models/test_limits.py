# SPDX-License-Identifier: MIT
"""Models that ask for much memory or time, or are no files: one line each, and the others go on."""

from __future__ import annotations

import resource
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from scapo.parallel.pool import Pool
from sim_assets.models import limits
from sim_assets.models.limits import bounded, limited_memory
from sim_assets.models.reader import read
from sim_assets.models.validate import AssetError
from tests.helpers.hostile import MODELS, picture_bomb
from tests.helpers.urdfs import cabinet

SECONDS = 30
BYTES = 2 << 30
HUGE = 4 << 30
"""Larger than any hole that a long run of tests leaves in the heap."""


def measured(job: tuple[Path, str], report) -> tuple[str, float, int]:
    """Why a model is refused, the processor seconds that took, and the largest size so far."""
    folder, name = job
    report(name, 0)
    urdf = folder / "cabinet.urdf"
    limits.READ_SECONDS = 4.0  # in this worker; of the 20 that users wait for
    begun, reason = time.process_time(), ""
    try:
        read(urdf, "oven", root=folder)
    except AssetError as error:
        reason = str(error)
    taken = time.process_time() - begun
    return reason, taken, 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.slow
def test_each_is_refused_in_one_line_within_bounds(tmp_path: Path):
    for number, (_, make) in enumerate(MODELS.items()):
        make(tmp_path / str(number))
    cabinet(tmp_path / "good")
    jobs = [(tmp_path / str(number), name) for number, name in enumerate(MODELS)]
    with Pool(1, timeout=120) as pool:
        outcomes = {outcome.job[1]: outcome for outcome in pool.run(measured, jobs)}
        good = list(pool.run(measured, [(tmp_path / "good", "good")]))
    assert [outcome.failure for outcome in good] == [None]
    for name, outcome in outcomes.items():
        assert outcome.result is not None, (name, outcome.reason)
        reason, seconds, size = outcome.result
        assert "expected" in reason, name
        assert len(reason) < 1500, name
        assert reason.isprintable(), name
        assert seconds < SECONDS, name
        assert size < BYTES, name


def test_a_picture_of_too_many_texels_is_left_out(tmp_path: Path):
    picture_bomb(tmp_path)
    thing = read(tmp_path / "cabinet.urdf", "oven", root=tmp_path)
    assert any("texture was left out" in line for line in thing.origin.repairs)


def test_time_is_the_processors_and_swallowed_errors_count(monkeypatch):
    monkeypatch.setattr(limits, "READ_SECONDS", 0.3)
    monkeypatch.setattr(limits, "TICK", 0.05)
    before = signal.getsignal(signal.SIGPROF)

    def spin(swallowing: bool) -> None:
        until = time.thread_time() + 1.0
        with suppress(BaseException if swallowing else KeyError):  # as if nothing had been
            while time.thread_time() < until:
                sum(range(1000))

    for swallowing in (False, True):
        begun = time.thread_time()
        match = r"a: expected to be read in 0\.3 s, found that"
        with pytest.raises(AssetError, match=match), bounded(Path("a")):
            spin(swallowing)
        assert time.thread_time() - begun < 0.9
    with bounded(Path("a")):
        time.sleep(0.6)  # a busy machine is no reason to refuse
    assert signal.getsignal(signal.SIGPROF) is before
    assert signal.getitimer(signal.ITIMER_PROF) == (0.0, 0.0)


def test_memory_is_bounded_and_given_back():
    before = resource.getrlimit(resource.RLIMIT_AS)
    match = "a: expected to be read in 64 MiB of memory, found MemoryError"
    with pytest.raises(AssetError, match=match), bounded(Path("a"), 64 << 20), bounded(Path("b")):
        np.zeros(HUGE, np.uint8)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
    with limited_memory(1 << 40):
        np.zeros(100 << 20, np.uint8)
    assert resource.getrlimit(resource.RLIMIT_AS) == before


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (KeyError("x"), "KeyError: 'x'"),
        (RecursionError("maximum recursion depth exceeded"), "contents of sane depth"),
        (ValueError("zero-size array to reduction operation"), "ValueError: zero-size array"),
        (OSError(36, "File name too long"), "File name too long"),
    ],
)
def test_errors_of_libraries_name_the_file(error: Exception, words: str):
    match = f"^some file: expected .*{words}"
    with pytest.raises(AssetError, match=match), bounded(Path("some file")):
        raise error


def test_in_another_thread_only_the_memory_is_bounded():
    done: list[str] = []

    def work() -> None:
        try:
            with bounded(Path("a"), 64 << 20):
                np.zeros(HUGE, np.uint8)
        except AssetError as error:
            done.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert len(done) == 1
