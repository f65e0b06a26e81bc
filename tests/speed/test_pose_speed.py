# SPDX-License-Identifier: MIT
"""Clouds per second of `registered`, beside a plain search for nearest neighbours: `make bench`.

The yardstick scores 64 poses of each cloud the plain way: 256 of its points against all 1,600 of
the template, one batched search for the nearest. Both are timed in one process of one thread, in
turn, by processor time, so that what else the machine does hardly enters the ratio.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

from scapo.categories import CATEGORIES
from scapo.geometry.points import nearest
from scapo.geometry.rigid import random_rotations
from scapo.method import Mode
from scapo.registered.method import RegisteredConfig, RegisteredScapo
from scapo.registered.view_bank import ShownPoints
from scapo.types import Observation
from tests.helpers.sighted import sighted, template

CLOUDS, POSES, POINTS, ROUNDS = 32, 64, 256, 3


def trained() -> tuple[RegisteredScapo, Observation]:
    """The method with a true template of 1,600 points and placed clouds; 32 others of 1,024."""
    views, truth = sighted(128, seed=60)
    method = RegisteredScapo(
        RegisteredConfig(), CATEGORIES["oven"], torch.Generator().manual_seed(0)
    )
    method.template.load_state_dict(template(0, 1600).state_dict())
    camera = (truth.rotation.mT @ (views.camera - truth.translation)[..., None])[..., 0]
    cloud = views.points - views.camera[:, None]
    method.pseudo.set(cloud[:, 0], truth, camera, torch.ones(len(cloud)))
    method.pseudo.show(ShownPoints.of(views))
    fresh, _ = sighted(CLOUDS, seed=61)
    noise = 0.002 * torch.randn(CLOUDS, 4, POINTS, 3, generator=torch.Generator().manual_seed(1))
    dense = (fresh.points[:, None] + noise).flatten(1, 2)
    return method.eval(), Observation(points=dense - fresh.camera[:, None])


def plain(cloud: Tensor, shape: Tensor) -> Callable[[], object]:
    """Nearest template points of every cloud under 64 rotations."""
    turn = random_rotations(POSES, torch.Generator().manual_seed(2))
    posed = (cloud[:, None, :POINTS] @ turn.mT).flatten(0, 1)
    many = shape.expand(len(posed), -1, -1)
    return lambda: nearest(posed, many)


def seconds(call: Callable[[], object]) -> float:
    """Of processor time."""
    started = time.process_time()
    call()
    return time.process_time() - started


@pytest.mark.parametrize(
    ("mode", "batch", "most"),
    [("quick", 32, 1.0), ("quick", 1, 2.0), ("refine", 32, 3.0), ("refine", 1, 4.5)],
)
def test_rate(mode: Mode, batch: int, most: float, benchmark: BenchmarkFixture) -> None:
    torch.set_num_threads(1)
    method, observation = trained()
    some = Observation(points=observation.points[:batch])
    yardstick = plain(some.points, method.template.points.detach())
    method.predict(some, mode)
    yardstick()
    used = [
        (seconds(lambda: method.predict(some, mode)), seconds(yardstick)) for _ in range(ROUNDS)
    ]
    least, plain_least = (min(column) for column in zip(*used, strict=True))
    ratio = least / plain_least
    print(  # noqa: T201
        f"\n{mode}, batch {batch}: {batch / least:.1f} clouds/s of one core, "
        f"{ratio:.2f} times the plain search"
    )
    benchmark.pedantic(method.predict, args=(some, mode), rounds=1)
    assert ratio < most
