# SPDX-License-Identifier: MIT
"""Jobs of one program that worker processes do ahead of their being asked for."""

from __future__ import annotations

import pickle  # noqa: TID251 - between our own processes, nothing is kept
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Generic, TypeVar

from scapo.parallel.pool import AbstractPool, Outcome, Report

T = TypeVar("T")
Numbered = tuple[int, bytes]
"""A job's place, and its pickle: bytes, since tensors by themselves would be shared."""


def ahead(
    pool: AbstractPool[Numbered, bytes], jobs: Sequence[Callable[[], T]]
) -> list[Callable[[], T]]:
    """What returns, or raises, the same as each job; the first one asked for begins on the rest.

    Args:
        pool: Does nothing else until the last one was asked for.
        jobs: Asked for in order, or from some place on. They can be pickled.
    """
    known = _Ahead(pool, jobs)
    return [partial(known.take, number) for number in range(len(jobs))]


class _Ahead(Generic[T]):
    """What is known of jobs in a pool."""

    def __init__(
        self, pool: AbstractPool[Numbered, bytes], jobs: Sequence[Callable[[], T]]
    ) -> None:
        self.pool, self.jobs = pool, jobs
        self._running: Iterator[Outcome[Numbered, bytes]] | None = None
        self._done: dict[int, Outcome[Numbered, bytes]] = {}

    def take(self, number: int) -> T:
        """The result of a job.

        Raises:
            RuntimeError: Its process was lost again and again.
        """
        if self._running is None:
            left = [(k, pickle.dumps(job)) for k, job in enumerate(self.jobs) if k >= number]
            self._running = self.pool.run(_do, left)
        while number not in self._done:
            outcome = next(self._running)
            self._done[outcome.job[0]] = outcome
        outcome = self._done.pop(number)
        if outcome.result is None:
            raise RuntimeError(outcome.reason)
        made, error = pickle.loads(outcome.result)
        if error is not None:
            raise error
        return made


def _do(job: Numbered, report: Report) -> bytes:
    """In a worker: the pickle of the result and of no error, or of none and the error."""
    del report
    try:
        made = pickle.loads(job[1])()
    except Exception as error:  # noqa: BLE001 - raised where the job is asked for
        return pickle.dumps((None, error))
    return pickle.dumps((made, None))
