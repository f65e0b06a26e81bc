# SPDX-License-Identifier: MIT
"""How many workers a request is worth: none for little, one at least for models of others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sim_assets.generation import generate as rooms
from sim_assets.generation.build import build
from sim_assets.generation.generate import Running, make_split
from sim_assets.generation.plan import Request
from sim_assets.generation.request import make_request
from sim_assets.generation.workers import WORKER_SECONDS, planned_workers, work_seconds
from sim_assets.options import DataOptions


def request_of(**options) -> Request:
    return make_request("laptop", DataOptions(**{"backend": "raycast", **options}))[0]


@pytest.mark.parametrize("count", [1, 100])
def test_little_work_is_done_without_workers(count: int):
    assert planned_workers(request_of(count=count), cores=64) == 0
    assert planned_workers(request_of(count=count, protocol="full"), cores=64) == 0


def test_much_work_is_done_by_all_cores():
    assert planned_workers(request_of(count=100_000), cores=8) == 8


def test_each_worker_saves_more_than_it_costs():
    for count in range(100, 4000, 100):
        request = request_of(count=count)
        workers = planned_workers(request, cores=64)
        alone = work_seconds(request)
        assert workers != 1
        if workers:
            assert workers * WORKER_SECONDS + alone / workers < 2 * alone
            assert WORKER_SECONDS + alone / workers < alone


def test_slow_options_and_several_requests_count():
    few = {"count": 100}
    assert planned_workers(request_of(sampling="fps", **few), cores=2) == 2
    assert work_seconds(request_of(noise="kinect", **few)) > work_seconds(request_of(**few))
    assert planned_workers(*[request_of(**few)] * 50, cores=2) == 2


def test_models_of_others_never_run_in_this_process(tmp_path: Path):
    list(build("laptop", count=2, seed=1, out=tmp_path, split="train"))
    request = request_of(source=str(tmp_path), count=4)
    assert planned_workers(request, cores=64) == 1
    assert planned_workers(request, request_of(count=1), cores=64) == 1


def test_the_decision_is_used_unless_a_number_is_given(tmp_path: Path, monkeypatch):
    opened: list[int | None] = []
    open_pool = rooms.open_pool

    def spy(engine, workers, *, timeout):
        opened.append(workers)
        return open_pool("local", 0, timeout=timeout)

    monkeypatch.setattr(rooms, "open_pool", spy)
    options = DataOptions(count=2, instances=1, protocol="full", points=64)
    running = Running(workers=None)
    small = make_split("laptop", options, tmp_path / "none", running)
    again = make_split("laptop", options, tmp_path / "three", replace(running, workers=3))
    with rooms.open_workers(replace(running, engine="ray")):
        pass
    assert opened == [0, 3, None]
    assert small.manifest.digest == again.manifest.digest
