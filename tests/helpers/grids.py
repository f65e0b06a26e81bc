# SPDX-License-Identifier: MIT
"""A small grid on invented data, whose commands are `fake_bench`'s."""

from __future__ import annotations

from pathlib import Path

from bench.grid.execute import Ended, Machines, execute
from bench.grid.plan import Plan, chosen, make_plan
from bench.grid.presets import Entry, Preset
from tests.helpers.made import make_data

CALLS = "calls.txt"


def preset(*seeds: int) -> Preset:
    """Two methods, one with labels and one without, on ovens."""
    entries = (
        Entry(method="icp", parts=("clean",), training=2.0, seconds={"fast": 0.1}),
        Entry(method="scapo", parts=("clean",), seeds=seeds or (1,), rates=(10, 10),
              seconds={"fast": 0.1}),
    )  # fmt: skip
    return Preset(entries=entries, categories={"clean": ("oven",)}, splits=("test",), budget=0.1,
                  sizes={"train": (6, 2), "test": (4, 2)})  # fmt: skip


def make_splits(folder: Path) -> None:
    """Training and test ovens in `folder/data/clean`."""
    make_data(folder / "data" / "clean", "oven", count=4, train=6)


def plan_of(folder: Path, *seeds: int) -> Plan:
    """The plan of that grid."""
    return make_plan("smoke", folder / "data", presets={"smoke": preset(*seeds)})


def run(plan: Plan, folder: Path, *only: str) -> list[Ended]:
    """Do it in this process; how each step ended."""
    done = execute(plan, chosen(plan.chains, only), folder / "out", folder / "data",
                   Machines(workers=0))  # fmt: skip
    return [one for _, ended in done for one in ended]


def calls(folder: Path) -> list[str]:
    """What the fake was asked for, one line a call."""
    path = folder / CALLS
    return path.read_text().splitlines() if path.exists() else []
