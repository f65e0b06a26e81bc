# SPDX-License-Identifier: MIT
"""`scapo-data benchmark`: all data of the benchmark in one command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from sim_assets.console import progress_bar, show_made


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark:
    """Make the data of a benchmark: OUT/PART/CATEGORY/SPLIT, and a record of time, size and digest.

    Started again after an interruption it goes on; the bytes are the same either way.
    """

    name: tyro.conf.Positional[Literal["sim-art/1"]]
    """Which one: 69,000 samples of the nine categories, about 1 GB."""
    out: Path
    """Folder of the benchmark."""
    only: tuple[str, ...] = ()
    """Make only these: parts (clean, sensor), categories, splits, or several joined by /, such as
    sensor/laptop/train."""
    backend: Literal["auto", "sapien", "raycast"] = "sapien"
    """Renderer; the published digests are SAPIEN's."""
    workers: int | None = None
    """Processes, by default one per core."""
    engine: Literal["local", "ray"] = "local"
    """Where they run: on this machine, or on the Ray cluster of RAY_ADDRESS (docs/cluster.md)."""
    timeout: float = 300.0
    """Seconds without a sign of life after which an object counts as hanging and is left out."""
    strict: bool = False
    """Stop at the first object that fails."""

    def run(self, console: Console) -> int:
        """Make them, print a summary of each split, and name the objects that failed."""
        from sim_assets.benchmark import RECORD, make_benchmark, pieces
        from sim_assets.generate import Running

        total, failed = len(pieces(self.only)), False
        with progress_bar(console) as show:
            running = Running(
                workers=self.workers,
                engine=self.engine,
                timeout=self.timeout,
                strict=self.strict,
                progress=show,
            )
            made = make_benchmark(self.out, self.only, self.backend, running)
            for number, done in enumerate(made, 1):
                console.print(f"{number}/{total} {done.piece.name}", highlight=False)
                show_made(console, done.made, done.seconds)
                failed |= bool(done.made.failed)
        console.print(f"recorded in {self.out / RECORD}", soft_wrap=True, highlight=False)
        return 1 if failed else 0
