# SPDX-License-Identifier: MIT
"""Worker processes that fail, die and hang."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from scapo.parallel.pool import (
    ONE_THREAD,
    TRIES,
    Pool,
    _cause,
    _processor_seconds,
    describe_error,
)


def act(job: tuple[str, int], report) -> object:
    """What the workers do here."""
    verb, number = job
    report(f"{verb} {number}", 1)
    if verb == "raise":
        raise ValueError(f"number {number}:\n expected less")
    if verb == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if verb == "hang":
        time.sleep(600)
    if verb == "tick":
        for _ in range(8):
            time.sleep(0.25)
            report("tick", 0)
    if verb == "held":
        return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    if verb == "environment":
        return {name: os.environ.get(name) for name in ONE_THREAD}
    return number**2


def test_a_job_that_fails_dies_or_hangs_costs_that_job_only():
    jobs = [
        ("square", 1),
        ("raise", 2),
        ("die", 3),
        ("hang", 4),
        ("exit", 5),
        ("tick", 6),
        ("environment", 7),
        ("square", 8),
    ]
    heard: list[tuple[str, int]] = []
    with Pool(2, timeout=1.5) as pool:
        outcomes = {
            outcome.job: outcome
            for outcome in pool.run(act, jobs, lambda job, label, n: heard.append((label, n)))
        }
        after = [outcome.result for outcome in pool.run(act, [("square", 9)])]
        processes = [worker.process for worker in pool._workers]
        assert any(process.is_alive() for process in processes)
    assert not any(process.is_alive() for process in processes)
    assert after == [81]
    assert set(outcomes) == set(jobs)
    assert [outcomes["square", n].result for n in (1, 8)] == [1, 64]
    assert outcomes["tick", 6].result == 36  # two seconds, but with signs of life
    failures = {job: (o.failure, o.reason, o.label) for job, o in outcomes.items() if o.failure}
    assert failures == {
        ("raise", 2): ("error", "number 2: expected less", "raise 2"),
        ("die", 3): ("died", "its process was ended by SIGKILL", "die 3"),
        ("hang", 4): ("hung", "no sign of life for 1.5 s", "hang 4"),
    }
    assert outcomes["environment", 7].result == dict.fromkeys(ONE_THREAD, "1")
    assert ("square 1", 1) in heard


def struck(job: tuple[Path, str], report) -> list[int]:
    """Die or stop at each place as often as the file for it has lines."""
    folder, name = job
    for place in ("first", "second"):
        report(f"{name} {place}", 1)
        marks = folder / f"{name}-{place}"
        left = marks.read_text().splitlines() if marks.exists() else []
        with (folder / "log").open("a") as log:
            log.write(f"{os.getpid()} {name}\n")
        if left:
            marks.write_text("\n".join(left[1:]))
            os.kill(os.getpid(), signal.Signals[left[0]])
    others = [line for line in (folder / "log").read_text().splitlines() if name not in line]
    return [int(line.split()[0]) for line in others]


def test_a_job_whose_process_is_lost_is_done_again_alone(tmp_path: Path):
    """Killed twice at one place and twice at another, or stopped once: the result is there."""
    (tmp_path / "a-first").write_text("SIGKILL\nSIGKILL")
    (tmp_path / "a-second").write_text("SIGKILL\nSIGKILL")
    (tmp_path / "b-first").write_text("SIGSTOP")
    (tmp_path / "d-second").write_text("SIGKILL\n" * 9)
    amounts: dict[str, int] = {}

    def heard(job: tuple[Path, str], label: str, amount: int) -> None:
        del label
        amounts[job[1]] = amounts.get(job[1], 0) + amount

    jobs = [(tmp_path, name) for name in "abcd"]
    with Pool(2, timeout=2.5) as pool:
        outcomes = {outcome.job[1]: outcome for outcome in pool.run(struck, jobs, heard)}
    assert [name for name in "abcd" if outcomes[name].failure] == ["d"]
    assert (outcomes["d"].failure, outcomes["d"].label) == ("died", "d second")
    assert outcomes["d"].reason == "its process was ended by SIGKILL"
    assert [amounts[name] for name in "abc"] == [2, 2, 2]  # what was lost is taken back
    log = [line.split() for line in (tmp_path / "log").read_text().splitlines()]
    used = {name: list(dict.fromkeys(pid for pid, who in log if who == name)) for name in "abcd"}
    assert [len(used[name]) for name in "abcd"] == [5, 2, 1, TRIES]  # a fresh process each time
    again = [pid for name in "abd" for pid in used[name][1:]]
    assert len(set(again)) == len(again)


def test_a_run_that_is_left_before_its_end_leaves_nothing_to_the_next():
    with Pool(2) as pool:
        for outcome in pool.run(act, [("square", 2), ("tick", 3), ("tick", 4)]):
            assert outcome.result == 4
            break
        assert [outcome.result for outcome in pool.run(act, [("square", 5)])] == [25]


def test_a_run_that_is_freed_late_takes_no_job_from_the_next():
    """As where an error's traceback holds the first one, which has given all its outcomes."""
    with Pool(2) as pool:
        first = pool.run(act, [("square", 5)])
        assert next(first).result == 25
        second = pool.run(act, [("square", 2), ("tick", 3)])
        assert next(second).result == 4
        del first  # which ends it, while the other job of the second is done
        assert [outcome.result for outcome in second] == [9]


def test_no_jobs_start_no_process():
    with Pool(2) as pool:
        assert list(pool.run(act, [])) == []
        assert pool._workers == []


def test_without_workers_jobs_are_done_here():
    heard: list[str] = []
    with Pool(0) as pool:
        outcomes = list(
            pool.run(act, [("square", 2), ("raise", 3)], lambda job, label, n: heard.append(label))
        )
    assert heard == ["square 2", "raise 3"]
    assert outcomes[0].result == 4
    assert (outcomes[1].failure, outcomes[1].label) == ("error", "raise 3")
    assert outcomes[1].reason == "number 3: expected less"


def test_a_negative_number_of_workers_is_refused():
    with pytest.raises(ValueError, match="workers: expected 0 or more, found -1"):
        Pool(-1)


def test_how_a_process_ended():
    assert _cause(7) == "its process ended with exit code 7"
    assert _cause(-11) == "its process was ended by SIGSEGV"
    assert _cause(None) == "its process ended with exit code None"


def test_errors_in_one_line():
    assert describe_error(ValueError("a:\n  b")) == "a: b"
    assert describe_error(ZeroDivisionError("division by zero")) == (
        "ZeroDivisionError: division by zero"
    )
    assert describe_error(KeyError("x")) == "KeyError: 'x'"
    assert describe_error(MemoryError()) == "MemoryError"
    assert describe_error(OSError(28, "No space left on device")) == (
        "[Errno 28] No space left on device"
    )


def spin_or_wait(job: tuple[Path, str], report) -> str:
    """Take the processor without end; or wait, the first time."""
    log, verb = job
    report(verb, 1)
    with log.open("a") as file:
        file.write(f"{verb}\n")
    while verb == "spin":
        pass
    if log.read_text().split().count(verb) == 1:
        time.sleep(600)
    return verb


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the system does not tell")
@pytest.mark.slow
def test_who_spins_is_at_fault_and_who_waits_is_not(tmp_path: Path):
    """The first attempt has `within` seconds; a slow machine has the pool's timeout after it."""
    log = tmp_path / "log"
    with Pool(1, timeout=60) as pool:
        jobs = [(log, "wait"), (log, "spin")]
        waited = list(pool.run(spin_or_wait, jobs[:1], within=1.0))
    assert [(o.result, o.failure) for o in waited] == [("wait", None)]
    with Pool(1, timeout=5.0) as pool:
        (spun,) = pool.run(spin_or_wait, jobs[1:], within=2.0)
    assert (spun.failure, spun.label) == ("hung", "spin")
    assert spun.reason in ("no sign of life for 2 s", "no sign of life for 5 s")  # machine busy
    assert log.read_text().split().count("wait") == 2


def test_processor_time_is_that_of_the_process():
    begun, ours = time.process_time(), _processor_seconds(os.getpid())
    while time.process_time() < begun + 0.3:
        sum(range(1000))
    assert 0.2 < _processor_seconds(os.getpid()) - ours < 10
    assert _processor_seconds(2**30) == 0.0


def test_no_interrupt_reaches_a_worker_however_early_it_comes():
    """What a process is started with holds before its first line of Python."""
    with Pool(1) as pool:
        assert [outcome.result for outcome in pool.run(act, [("held", 0)])] == [True]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
