# SPDX-License-Identifier: MIT
"""Labelled clouds per second against a bare SAPIEN loop, and memory: `make bench`.

The loops run in a process of their own, without the test run's checks of shapes.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sim_assets.generation.request import make_request
from sim_assets.generation.stream import _samples
from sim_assets.options import DataOptions
from sim_assets.rendering.backends import resolve_backend
from sim_assets.rendering.base import RenderError

SHARE = 0.8
"""Of the bare loops' rate that the command must reach."""
ALONE = 0.65
"""The same in one process by processor time, to notice a fall: less steady, 0.69 to 0.99."""
MEMORY_MB = 40
"""By which the process may grow over the later objects."""


@pytest.fixture(autouse=True)
def device() -> None:
    try:
        resolve_backend("sapien")
    except RenderError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("category", ["drawer", "oven", "eyeglasses"])
@pytest.mark.parametrize("workers", [(), ("2",)], ids=["one process", "command with 2 workers"])
def test_clouds_against_bare_loops(
    category: str,
    workers: tuple[str, ...],
    benchmark: BenchmarkFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    script = str(Path(__file__).with_name("clouds.py"))
    command = [sys.executable, "-W", "ignore", script, category, *workers]
    found: list[dict[str, float]] = []

    def once() -> None:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout.splitlines()[-1]))

    benchmark.pedantic(once, rounds=1)
    info: dict[str, Any] = benchmark.extra_info
    info.update({name: round(value, 3) for name, value in found[0].items()})
    with capsys.disabled():
        print(  # noqa: T201 - what `make bench` is for
            f"\n{category}: {found[0]['clouds']:.0f} clouds/s, bare {found[0]['bare']:.0f}/s, "
            f"ratio {found[0]['ratio']:.2f}{' (2 workers, 2 bare loops)' if workers else ''}"
        )
    assert found[0]["ratio"] >= (SHARE if workers else ALONE)


def test_many_objects_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    """The sweep over objects per batch; quick on the CPU, where it only has to run."""
    if find_spec("mani_skill") is None:
        pytest.skip("the package mani_skill (extra [gpu-sim]) is absent")
    script = str(Path(__file__).with_name("many.py"))
    command = [sys.executable, "-W", "ignore", script, "drawer"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    with capsys.disabled():
        print(f"\n{lines[0]['device']}")  # noqa: T201
        for line in lines:
            print(  # noqa: T201
                f"{line['at once']:5d} at once: {line['clouds']:.0f} clouds/s, "
                f"{line['pictures']:.0f} pictures/s"
            )
    assert len(lines) >= 3
    assert all(line["clouds"] > 0 for line in lines)


def test_memory_stays_flat(capsys: pytest.CaptureFixture[str]) -> None:
    status = Path("/proc/self/status")
    if not status.exists():
        pytest.skip("no /proc to read the size of the process from")
    options = DataOptions(count=80 * 10, instances=80, backend="sapien", points=256)
    request, assets = make_request("oven", options)
    sizes = []
    for number, _ in enumerate(_samples(request, assets)):
        if number in (300, 799):
            line = next(x for x in status.read_text().splitlines() if x.startswith("VmRSS"))
            sizes.append(int(line.split()[1]) / 1024)
    with capsys.disabled():
        print(f"\n{sizes[0]:.0f} MB after 30 objects, {sizes[1]:.0f} MB after 80")  # noqa: T201
    assert sizes[1] - sizes[0] < MEMORY_MB
