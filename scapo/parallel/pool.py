# SPDX-License-Identifier: MIT
"""Run pure jobs in worker processes: a job that fails, dies or hangs costs that job only.

A job is any picklable value; the function that does it is a module-level function
`function(job, report)`, which calls `report(label, amount)` as a sign of life: what it is about to
do, and how much it has done since the last call. Workers are spawned, with one numerical thread
each, and end by themselves when the parent is gone.

An error is the job's own. A process that dies or stops need not be: the system may have killed it
for the memory that others took. So such a job is done again after all others, in a fresh process
with none beside it, and given up only when that happened `TRIES` times at the same place. One that
is silent for too long while its process has the processor hangs by itself: it is given up at once.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast

Job = TypeVar("Job")
Result = TypeVar("Result")
Report = Callable[[str, int], None]

ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "LP_NUM_THREADS",
)
"""Thread counts set to 1 in workers: of BLAS and OpenMP, and of Mesa's CPU renderer."""
TICK = 0.5
"""Seconds between looks at the clock."""
START = 120.0
"""Seconds that a worker may take to start and to import what it needs."""
TRIES = 3
"""Processes that may die or hang at one label of a job before the job is given up."""
BUSY = 2 / 3
"""Share of its silence in which a process has the processor, from which on the job is at fault, and
not a machine that has others to serve."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(Generic[Job, Result]):
    """How a job ended: with a result, or with a reason."""

    job: Job
    result: Result | None
    failure: Literal["error", "died", "hung"] | None = None
    reason: str = ""
    label: str = ""
    """What the job reported last."""


@dataclass(slots=True, kw_only=True, eq=False)
class _Attempt:
    """A job, what it reported since it was begun, and where its processes were lost."""

    job: Any
    label: str = ""
    amount: int = 0
    lost: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True, kw_only=True, eq=False)
class _Worker:
    process: Any
    pipe: Connection
    attempt: _Attempt | None = None
    """None: idle."""
    begun: bool = False
    heard: float = 0.0
    spent: float = 0.0
    """Processor seconds of the process when it was heard."""

    def hear(self) -> None:
        """Note a sign of life."""
        self.heard, self.spent = time.monotonic(), _processor_seconds(self.process.pid)

    def silence(self) -> tuple[float, float]:
        """Seconds since the last sign of life, by the clock and of the processor."""
        spent = _processor_seconds(self.process.pid) - self.spent
        return time.monotonic() - self.heard, spent


class AbstractPool(ABC, Generic[Job, Result]):
    """Something that does jobs; a context manager, and leaving it stops them."""

    @abstractmethod
    def run(
        self,
        function: Callable[[Job, Report], Result],
        jobs: Iterable[Job],
        on_report: Callable[[Job, str, int], None] | None = None,
        *,
        within: float = math.inf,
    ) -> Iterator[Outcome[Job, Result]]:
        """Do the jobs; outcomes come in the order in which they end.

        Args:
            function: Module-level, does one job.
            jobs: Handed out in order.
            on_report: Called in this process with the job and each of its reports; the amounts of
                an attempt that was lost are reported back as negative.
            within: Seconds without a sign of life after which the first attempt of a job is ended,
                where that is less than the pool's timeout. A job that was not at fault, since its
                process was stopped or had to wait for the processor, then has the pool's.
        """

    @abstractmethod
    def __enter__(self) -> AbstractPool[Job, Result]: ...

    @abstractmethod
    def __exit__(self, *exc: object) -> None: ...


class Pool(AbstractPool[Job, Result], Generic[Job, Result]):
    """Worker processes, as a context manager; leaving it ends them.

    Args of the constructor: `workers` processes, 0 for none: then jobs are done in this process,
    which a job that dies takes with it; `timeout` seconds without a sign of life after which a job
    counts as hung and its worker is killed.
    """

    def __init__(self, workers: int, *, timeout: float = 300.0) -> None:
        if workers < 0:
            raise ValueError(f"workers: expected 0 or more, found {workers}")
        self.size = workers
        self.timeout = timeout
        self._workers: list[_Worker] = []

    def __enter__(self) -> Pool[Job, Result]:
        return self

    def __exit__(self, *exc: object) -> None:
        for worker in self._workers:
            _end(worker)
        self._workers = []

    def run(
        self,
        function: Callable[[Job, Report], Result],
        jobs: Iterable[Job],
        on_report: Callable[[Job, str, int], None] | None = None,
        *,
        within: float = math.inf,
    ) -> Iterator[Outcome[Job, Result]]:
        """See `AbstractPool.run`."""
        if not self.size:
            yield from (_do_here(function, job, on_report) for job in jobs)
            return
        own = [_Attempt(job=job) for job in jobs]
        waiting, again = deque(own), deque[_Attempt]()
        try:
            while waiting or again or self._busy():
                self._hand_out(function, waiting, again)
                ready = wait([worker.pipe for worker in self._busy()], TICK)
                for worker in self._busy():
                    outcome = self._listen(worker, worker.pipe in ready, on_report, within)
                    if outcome is None:
                        continue
                    attempt, worker.attempt = cast("_Attempt", worker.attempt), None
                    if _is_given_up(attempt, outcome):
                        yield outcome
                        continue
                    if on_report is not None:
                        on_report(attempt.job, attempt.label, -attempt.amount)
                    attempt.label, attempt.amount = "", 0
                    again.append(attempt)
        finally:  # left before the end: the next run would take their outcomes for its own
            self._leave(own)

    def _leave(self, own: list[_Attempt]) -> None:
        """End the workers of a run, not those of one that began before it was freed."""
        for worker in self._busy():
            if worker.attempt in own:
                self._drop(worker)

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.attempt is not None]

    def _hand_out(
        self, function: Callable[..., Any], waiting: deque[_Attempt], again: deque[_Attempt]
    ) -> None:
        alone = not waiting and bool(again) and not self._busy()
        if alone:
            for worker in list(self._workers):
                self._drop(worker)
            waiting = deque([again.popleft()])
        idle = [worker for worker in self._workers if worker.attempt is None]
        while waiting and (idle or len(self._workers) < self.size):
            worker = idle.pop() if idle else self._start()
            try:
                worker.pipe.send((function, waiting[0].job))
            except (BrokenPipeError, ConnectionResetError):  # it died while idle
                self._drop(worker)
                continue
            worker.attempt, worker.begun = waiting.popleft(), False
            worker.hear()

    def _start(self) -> _Worker:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _environment(dict.fromkeys(ONE_THREAD, "1")), _interrupts_held():
            process.start()
        theirs.close()
        worker = _Worker(process=process, pipe=ours)
        self._workers.append(worker)
        return worker

    def _listen(
        self,
        worker: _Worker,
        ready: bool,
        on_report: Callable[[Job, str, int], None] | None,
        within: float,
    ) -> Outcome[Job, Result] | None:
        """The outcome of the worker's job if it has ended."""
        attempt = cast("_Attempt", worker.attempt)
        try:
            while ready and worker.pipe.poll():
                kind, *content = worker.pipe.recv()
                worker.hear()
                if kind == "begun":
                    worker.begun = True
                elif kind == "report":
                    attempt.label = content[0]
                    attempt.amount += content[1]
                    if on_report is not None:
                        on_report(attempt.job, *content)
                else:
                    result, reason = content
                    return _outcome(attempt, result, "error" if kind == "error" else None, reason)
        except (EOFError, OSError):  # before or amid a message
            worker.process.join(timeout=5)  # so that its exit code is known
            self._drop(worker)
            return _outcome(attempt, None, "died", _cause(worker.process.exitcode))
        return self._too_silent(worker, attempt, within)

    def _too_silent(
        self, worker: _Worker, attempt: _Attempt, within: float
    ) -> Outcome[Job, Result] | None:
        """The outcome of a job whose process has been silent for too long, which is ended."""
        limit = self.timeout if attempt.lost else min(self.timeout, within)
        limit = limit if worker.begun else max(limit, START)
        silent, spent = worker.silence()
        if silent <= limit:
            return None
        if spent >= BUSY * limit:
            attempt.lost[attempt.label] = TRIES
        self._drop(worker)
        return _outcome(attempt, None, "hung", f"no sign of life for {limit:g} s")

    def _drop(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        _end(worker)


def _do_here(
    function: Callable[[Job, Report], Result],
    job: Job,
    on_report: Callable[[Job, str, int], None] | None,
) -> Outcome[Job, Result]:
    """Do a job in this process."""
    last = ""

    def report(label: str, amount: int) -> None:
        nonlocal last
        last = label
        if on_report is not None:
            on_report(job, label, amount)

    try:
        return Outcome(job=job, result=function(job, report))
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this job only
        reason = describe_error(error)
        return Outcome(job=job, result=None, failure="error", reason=reason, label=last)


def _is_given_up(attempt: _Attempt, outcome: Outcome[Any, Any]) -> bool:
    """Whether an outcome is final; counts the processes that were lost at its label."""
    if outcome.failure not in ("died", "hung"):
        return True
    attempt.lost[outcome.label] += 1
    return attempt.lost[outcome.label] >= TRIES


def _outcome(
    attempt: _Attempt,
    result: Any,  # noqa: ANN401
    failure: Literal["error", "died", "hung"] | None,
    reason: str,
) -> Outcome[Any, Any]:
    return Outcome(
        job=attempt.job, result=result, failure=failure, reason=reason, label=attempt.label
    )


def _processor_seconds(process: int) -> float:
    """What a process has had of the processor; 0 where the system does not tell (no Linux)."""
    with suppress(OSError, ValueError, IndexError):
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _end(worker: _Worker) -> None:
    worker.pipe.close()  # an idle worker ends at once
    worker.process.join(timeout=2 if worker.attempt is None else 0)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _cause(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        with suppress(ValueError):
            return f"its process was ended by {signal.Signals(-exit_code).name}"
    return f"its process ended with exit code {exit_code}"


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for a process that is started here, and put them back."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Keep Ctrl-C from a process that is started here; its parent hears of it afterwards.

    A terminal interrupts workers too. One that is not yet at `_work` would end with a traceback; it
    inherits what is held back here, for good. Starting the tracker lets interrupts through again,
    so that one has to run before.
    """
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(pipe: Connection) -> None:
    """A worker: do what comes through the pipe until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def report(label: str, amount: int = 0) -> None:
        pipe.send(("report", label, amount))

    with suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the parent is gone
        while True:
            function, job = pipe.recv()
            pipe.send(("begun",))
            try:
                message = ("result", function(job, report), "")
            except (BrokenPipeError, ConnectionResetError):
                raise
            except Exception as error:  # noqa: BLE001 - whatever it is, it costs this job only
                message = ("error", None, describe_error(error))
            pipe.send(message)


def _end_with_parent() -> None:
    """A job that sends nothing would not notice that the parent was killed."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def describe_error(error: BaseException) -> str:
    """One line: the message of an error meant for users, else its type and message."""
    text = " ".join(str(error).split())
    if isinstance(error, (ValueError, OSError, RuntimeError)) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
