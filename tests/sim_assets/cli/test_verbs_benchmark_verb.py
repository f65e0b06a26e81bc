# SPDX-License-Identifier: MIT
"""`scapo-data benchmark`: what it prints, and how it ends."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from sim_assets.cli.verbs import Benchmark
from sim_assets.generation import benchmark
from sim_assets.generation.benchmark import pieces

ONLY = ("sensor/scissors/val", "clean/laptop/val")


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_pieces_are_counted_and_the_record_named(
    console: Console, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "SIZES", dict.fromkeys(benchmark.SIZES, (1, 2)))
    verb = Benchmark(name="sim-art/2", out=tmp_path, only=ONLY, backend="raycast", workers=0)
    assert verb.run(console) == 0
    text = printed(console)
    names = [piece.name for piece in pieces(ONLY)]
    assert len(names) == 2
    assert all(f"{number}/2 {name}" in text for number, name in enumerate(names, 1))
    assert f"recorded in {tmp_path / benchmark.RECORD}" in text
    assert (tmp_path / benchmark.RECORD).is_file()


def test_a_failed_object_ends_in_1_after_all_pieces(
    console: Console, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "SIZES", dict.fromkeys(benchmark.SIZES, (1, 1)))
    make = benchmark.make_benchmark

    def failing(*arguments: object) -> Iterator[object]:
        for done in make(*arguments):  # type: ignore[arg-type]
            yield replace(done, made=replace(done.made, failed={"scissors-val-2-00000": "died"}))

    monkeypatch.setattr(benchmark, "make_benchmark", failing)
    verb = Benchmark(name="sim-art/2", out=tmp_path, only=ONLY, backend="raycast", workers=0)
    assert verb.run(console) == 1
    assert "2/2" in printed(console)
    assert "scissors-val-2-00000" in printed(console)
