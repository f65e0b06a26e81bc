# SPDX-License-Identifier: MIT
"""One cloud of 1,024 points from array to joints by the released models, one thread: `make bench`.

Clouds per second are one over the median, or over `processor seconds` (means) on a busy machine.
"""

from __future__ import annotations

import time

import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

import scapo
from scapo.method import Mode
from scapo.released import released
from sim_assets import generate_samples

pytestmark = pytest.mark.usefixtures("one_thread")

ROUNDS: dict[Mode, int] = {"fast": 20, "quick": 10, "refine": 5}


@pytest.fixture(scope="module", params=sorted(released()))
def view(request: pytest.FixtureRequest) -> tuple[str, Tensor]:
    """A released category, and one depth view of an object of it."""
    samples = generate_samples(request.param, split="val", count=1, backend="auto")
    return request.param, next(samples).observation.points


@pytest.mark.parametrize("mode", ROUNDS)
def test_joints_of_one_cloud(
    view: tuple[str, Tensor], mode: Mode, benchmark: BenchmarkFixture
) -> None:
    category, points = view
    model, used = scapo.load(category), []

    def once() -> Tensor:
        started = time.process_time()
        joints = model.predict(points, mode).joints
        used.append(time.process_time() - started)
        assert joints is not None
        return joints.axis

    axis = benchmark.pedantic(once, rounds=ROUNDS[mode], warmup_rounds=1)
    benchmark.extra_info["processor seconds"] = round(sum(used[1:]) / len(used[1:]), 4)
    assert axis.norm(dim=-1).sub(1).abs().max() < 1e-4
