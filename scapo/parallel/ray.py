# SPDX-License-Identifier: MIT
"""Run pure jobs on a Ray cluster: the same function, the same outcomes as `pool.Pool`.

A Ray task does one job in a process of its own beside it (a local pool of one worker), so a job
that kills or hangs its process is told apart from a machine that is lost: the first is the job's
failure, the second is made up for by doing the job again elsewhere.
"""

from __future__ import annotations

import math
import os
import queue
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Any, Generic, Literal

from scapo.parallel.pool import (
    TICK,
    AbstractPool,
    Job,
    Outcome,
    Pool,
    Report,
    Result,
    describe_error,
)

Engine = Literal["local", "ray"]
"""Where jobs run: worker processes of this machine, or a Ray cluster."""
MAX_LOST = 3
"""Machines or workers that may be lost under one job before it counts as their killer."""
AHEAD = 2
"""Jobs handed to the cluster per core, so that none idles and an autoscaler sees the demand."""
PATIENCE = 20.0
"""Seconds in which the cluster must answer."""
BETWEEN = 0.25
"""Seconds between signs of life that a task sends on."""
MISSING = "engine ray: expected the package ray (pip install 'scapo[cluster]'), found none"


def open_pool(
    engine: Engine, workers: int | None = None, *, timeout: float = 300.0, gpus: float = 0.0
) -> AbstractPool[Any, Any]:
    """The pool of an engine.

    Args:
        engine: Where the jobs run.
        workers: Jobs at once; None for one per core, of this machine or of the cluster.
        timeout: Seconds without a sign of life after which a job counts as hung.
        gpus: Of each job on a cluster, which are then all that it sees.

    Raises:
        ValueError: `workers` is out of range.
    """
    if engine == "ray":
        return RayPool(workers, timeout=timeout, gpus=gpus)
    return Pool(os.cpu_count() or 1 if workers is None else workers, timeout=timeout)


def find_ray() -> Any:  # noqa: ANN401 - of an extra that may be missing
    """The package.

    Raises:
        RuntimeError: It is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    try:
        return import_module("ray")
    except ImportError as error:
        raise RuntimeError(MISSING) from error


@dataclass(slots=True, kw_only=True, eq=False)
class _Attempt:
    """A job, and the task that does it now."""

    job: Any
    stream: Any = None
    """Of the task's messages."""
    label: str = ""
    amount: int = 0
    lost: int = 0


class RayPool(AbstractPool[Job, Result], Generic[Job, Result]):
    """A Ray cluster, as a context manager.

    Connects to the cluster that RAY_ADDRESS names, else to one that runs on this machine, else
    starts one here. Every node needs this package in the same version. Args of the constructor:
    `workers` jobs at once at most, None for as many as the cluster has cores; `timeout` as for
    `Pool`; `gpus` of each job, which sees these alone.
    """

    def __init__(
        self, workers: int | None = None, *, timeout: float = 300.0, gpus: float = 0.0
    ) -> None:
        if workers is not None and workers < 1:
            raise ValueError(f"workers: expected 1 or more with engine ray, found {workers}")
        self.workers = workers
        self.timeout = timeout
        self.gpus = gpus
        self.lost = 0
        """Jobs that were done again because their machine was lost."""
        self._ray: Any = None
        self._ours = False
        self._running: list[_Attempt] = []

    def __enter__(self) -> RayPool[Job, Result]:
        """Connect.

        Raises:
            RuntimeError: Ray is not installed.
            ConnectionError: No cluster answers.
        """
        self._ray = find_ray()
        if not self._ray.is_initialized():
            _connect(self._ray)
            self._ours = True
        return self

    def __exit__(self, *exc: object) -> None:
        self._cancel(self._running)
        if self._ours:
            self._ray.shutdown()

    def run(
        self,
        function: Callable[[Job, Report], Result],
        jobs: Iterable[Job],
        on_report: Callable[[Job, str, int], None] | None = None,
        *,
        within: float = math.inf,
    ) -> Iterator[Outcome[Job, Result]]:
        """See `AbstractPool.run`; the amounts of a lost attempt are reported back as negative."""
        own = [_Attempt(job=job) for job in jobs]
        waiting = deque(own)
        task = _task(self._ray, self.gpus)
        try:
            while waiting or self._running:
                while waiting and len(self._running) < self._slots():
                    attempt = waiting.popleft()
                    attempt.stream = task.remote(function, attempt.job, self.timeout, within)
                    self._running.append(attempt)
                streams = [attempt.stream for attempt in self._running]
                ready, _ = self._ray.wait(
                    streams, num_returns=len(streams), timeout=TICK, fetch_local=False
                )
                for attempt in [a for a in self._running if any(a.stream is r for r in ready)]:
                    outcome = self._listen(attempt, on_report)
                    if outcome is not None:
                        self._running.remove(attempt)
                        yield outcome
                    elif attempt.stream is None:  # lost
                        self._running.remove(attempt)
                        waiting.appendleft(attempt)
        finally:  # left before the end
            self._cancel(own)

    def _cancel(self, own: list[_Attempt]) -> None:
        """End those of a run, not of one that began before it was freed."""
        for attempt in [running for running in self._running if running in own]:
            self._ray.cancel(attempt.stream, force=True)
            self._running.remove(attempt)

    def _slots(self) -> int:
        if self.workers is not None:
            return self.workers
        return max(1, AHEAD * int(self._ray.cluster_resources().get("CPU", 0)))

    def _listen(
        self, attempt: _Attempt, on_report: Callable[[Job, str, int], None] | None
    ) -> Outcome[Job, Result] | None:
        """The next message of a task that has one: the outcome if it is the last."""
        errors = self._ray.exceptions
        try:
            message = self._ray.get(next(attempt.stream))
        except errors.RayTaskError as error:  # before or after the job: code that is not there
            reason = describe_error(getattr(error, "cause", None) or error)
            return Outcome(job=attempt.job, result=None, failure="error", reason=reason)
        except (errors.RayError, StopIteration) as error:
            return self._take_back(attempt, error, on_report)
        if isinstance(message, Outcome):
            return message
        attempt.label, amount = message
        attempt.amount += amount
        if on_report is not None:
            on_report(attempt.job, attempt.label, amount)
        return None

    def _take_back(
        self,
        attempt: _Attempt,
        error: Exception,
        on_report: Callable[[Job, str, int], None] | None,
    ) -> Outcome[Job, Result] | None:
        """A task whose machine or worker was lost: to be done again, unless that comes often."""
        attempt.lost += 1
        attempt.stream = None
        if attempt.lost >= MAX_LOST:
            reason = f"its machine or worker was lost {attempt.lost} times ({_kind(error)})"
            return Outcome(
                job=attempt.job, result=None, failure="died", reason=reason, label=attempt.label
            )
        self.lost += 1
        if on_report is not None:
            on_report(attempt.job, attempt.label, -attempt.amount)
        attempt.amount = 0
        return None


def _task(ray: Any, gpus: float) -> Any:  # noqa: ANN401
    """The remote function; a lambda, since wrappers that check calls hide what is a generator."""
    options = {"num_cpus": 1, "num_gpus": gpus, "max_retries": 0, "num_returns": "streaming"}
    return ray.remote(**options)(lambda *job: (yield from _supervise(*job)))


def _kind(error: Exception) -> str:
    return type(error).__name__


def _connect(ray: Any) -> None:  # noqa: ANN401
    """Connect as RAY_ADDRESS says.

    Raises:
        ConnectionError: No cluster answers.
    """
    address = os.environ.get("RAY_ADDRESS", "")
    try:
        host, _, port = address.rpartition("/")[2].rpartition(":")
        if host and port.isdigit():  # Ray itself would try for minutes
            socket.create_connection((host, int(port)), timeout=PATIENCE).close()
        ray.init(
            include_dashboard=None if address else False,
            log_to_driver=False,
            logging_level="ERROR",
        )
    except Exception as error:
        where = f"RAY_ADDRESS {address}" if address else "this machine"
        raise ConnectionError(
            f"{where}: expected a Ray cluster that answers: {describe_error(error)}"
        ) from error


@lru_cache(maxsize=4)
def _pool(timeout: float, gpus: str) -> Pool[Any, Any]:
    """The process beside this Ray worker, kept from task to task; it ends with the worker.

    One for each set of `gpus` (CUDA_VISIBLE_DEVICES), which it takes over when it starts.
    """
    del gpus
    return Pool(1, timeout=timeout)


def _supervise(
    function: Callable[[Any, Report], Any],
    job: Any,  # noqa: ANN401
    timeout: float,
    within: float,
) -> Iterator[tuple[str, int] | Outcome[Any, Any]]:
    """What a Ray task does: yields (label, amount) as it goes on, then the outcome."""
    messages: queue.SimpleQueue[Any] = queue.SimpleQueue()

    arguments = (messages, function, job, timeout, within)
    threading.Thread(target=_do, args=arguments, daemon=True).start()
    told, heard = time.monotonic(), []
    while True:
        message = _next(messages)
        ended = isinstance(message, Outcome)
        if message is not None and not ended:
            heard.append(message)
        if heard and (ended or time.monotonic() - told > BETWEEN):
            yield heard[-1][0], sum(amount for _, amount in heard)
            told, heard = time.monotonic(), []
        if ended:
            yield message
            return


def _do(
    messages: queue.SimpleQueue[Any],
    function: Callable[[Any, Report], Any],
    job: Any,  # noqa: ANN401
    timeout: float,
    within: float,
) -> None:
    """Do the job in the process beside this one; messages: (label, amount), then the outcome."""
    try:
        pool = _pool(timeout, os.environ.get("CUDA_VISIBLE_DEVICES", ""))

        def heard(_: Any, label: str, amount: int) -> None:  # noqa: ANN401
            messages.put((label, amount))

        for outcome in pool.run(function, [job], heard, within=within):
            messages.put(outcome)
    except Exception as error:  # noqa: BLE001 - told instead of an endless wait
        reason = describe_error(error)
        messages.put(Outcome(job=job, result=None, failure="error", reason=reason))


def _next(messages: queue.SimpleQueue[Any]) -> Any:  # noqa: ANN401
    """The next message, or None if none comes soon."""
    try:
        return messages.get(timeout=BETWEEN)
    except queue.Empty:
        return None
