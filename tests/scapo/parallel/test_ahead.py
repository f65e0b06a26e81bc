# SPDX-License-Identifier: MIT
"""Jobs that worker processes do ahead: their order, their errors, where they begin."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from scapo.parallel.ahead import Numbered, ahead
from scapo.parallel.pool import Pool


@pytest.fixture(scope="module")
def pool() -> Iterator[Pool[Numbered, bytes]]:
    with Pool[Numbered, bytes](2) as made:
        yield made


def draw(path: Path, number: int, generator: torch.Generator) -> tuple[int, Tensor]:
    """The process, and what is drawn; a file tells that it was done."""
    (path / str(number)).touch()
    return os.getpid(), torch.rand(number, generator=generator)


def fail(number: int) -> tuple[int, Tensor]:
    raise LookupError(f"number {number}")


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_jobs_return_in_order_what_they_return_here(
    pool: Pool[Numbered, bytes], tmp_path: Path
) -> None:
    generators = [torch.Generator().manual_seed(k) for k in range(6)]
    jobs = [partial(draw, tmp_path, k, g) for k, g in enumerate(generators)]
    made = [job() for job in ahead(pool, jobs)]
    here = [job()[1] for job in jobs]
    assert all(torch.equal(a[1], b) for a, b in zip(made, here, strict=True))
    assert os.getpid() not in {process for process, _ in made}


def test_those_before_the_first_that_is_asked_for_are_not_done(
    pool: Pool[Numbered, bytes], tmp_path: Path
) -> None:
    jobs = [partial(draw, tmp_path, k, torch.Generator()) for k in range(5)]
    made = ahead(pool, jobs)
    assert not list(tmp_path.iterdir())  # none is begun on before one is asked for
    assert [len(job()[1]) for job in made[3:]] == [3, 4]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["3", "4"]


def test_an_error_is_raised_where_its_job_is_asked_for(
    pool: Pool[Numbered, bytes], tmp_path: Path
) -> None:
    one = partial(draw, tmp_path, 2, torch.Generator())
    first, second, third = ahead(pool, [one, partial(fail, 7), one])
    assert len(first()[1]) == 2
    with pytest.raises(LookupError, match="number 7"):
        second()
    assert len(third()[1]) == 2


def test_a_process_that_is_lost_again_and_again_is_told(pool: Pool[Numbered, bytes]) -> None:
    lost, other = ahead(pool, [die, partial(os.getpid)])
    with pytest.raises(RuntimeError, match="ended by SIGKILL"):
        lost()
    assert other() != os.getpid()
