# SPDX-License-Identifier: MIT
"""The data of the benchmark `sim-art/1` (CONTRACT 4): OUT/PART/CATEGORY/SPLIT, resumable.

`clean` is exact depth of an object that fills the picture, `sensor` a simulated depth camera at a
drawn distance with an imperfect mask. What each split cost and holds is recorded in one JSON file.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from scapo.categories import CATEGORIES
from scapo.store import write_bytes
from sim_assets.generation.generate import Made, Running, generate, open_workers
from sim_assets.generation.request import make_request, versions
from sim_assets.options import DataOptions, SplitName

NAME = "sim-art/1"
FORMAT = "scapo-benchmark/1"
RECORD = "sim-art-1.json"
SEED = 1
"""Of the data; 1, 2, 3 are training seeds."""
Part = Literal["clean", "sensor"]
BackendName = Literal["auto", "sapien", "raycast"]
Sizes = Mapping[SplitName, tuple[int, int]]
SIZES: Sizes = {"train": (100, 50), "val": (10, 50), "test": (50, 20), "test-ood": (20, 20)}
"""Instances, and samples of each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """One split of one category of one part."""

    part: Part
    category: str
    split: SplitName

    @property
    def name(self) -> str:
        """PART/CATEGORY/SPLIT, also its folder."""
        return f"{self.part}/{self.category}/{self.split}"

    def options(self, sizes: Sizes, backend: BackendName) -> DataOptions:
        """How it is generated."""
        instances, each = sizes[self.split]
        sensor = self.part == "sensor"
        return DataOptions(
            split=self.split,
            count=instances * each,
            instances=instances,
            seed=SEED,
            points=1024,
            preset="sim-art-sensor" if sensor else "sim-art",
            noise="disparity" if sensor else "none",
            mask="imperfect" if sensor else "exact",
            backend=backend,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """A piece that is there."""

    piece: Piece
    made: Made
    seconds: float


def pieces(only: Sequence[str] = ()) -> list[Piece]:
    """The pieces asked for, all without a word.

    Args:
        only: Words such as `clean`, `laptop`, `test`, or several joined by `/`
            (`sensor/laptop/train`); a piece is taken if all words of one item name it.

    Raises:
        ValueError: A word that names nothing, or an item that names no piece.
    """
    every = [
        Piece(part=part, category=name, split=split)
        for part in get_args(Part)
        for name, category in CATEGORIES.items()
        if part in category.benchmark
        for split in get_args(SplitName)
    ]
    if not only:
        return every
    chosen = set()
    for item in only:
        words = set(item.split("/"))
        found = [piece for piece in every if words <= set(piece.name.split("/"))]
        if not found:
            parts, splits = ", ".join(get_args(Part)), ", ".join(get_args(SplitName))
            raise ValueError(
                f"only: expected parts ({parts}), categories, splits ({splits}) or these joined "
                f"by /, found {item!r}"
            )
        chosen.update(found)
    return [piece for piece in every if piece in chosen]


def make_benchmark(
    out: Path,
    only: Sequence[str] = (),
    backend: BackendName = "sapien",
    running: Running | None = None,
    sizes: Sizes | None = None,
) -> Iterator[Done]:
    """Make the pieces one after the other, and yield each when it is there and recorded.

    Args:
        out: Folder of the benchmark.
        only: See `pieces`.
        backend: Renderer.
        running: Workers and progress.
        sizes: Instances and samples of each, by split; the benchmark's by default.

    Raises:
        ValueError: `only` names nothing.
        RenderError: The backend does not work here.
        GenerateError: A folder holds something else, or a split cannot be made.
    """
    chosen, running = pieces(only), running or Running()
    with open_workers(running) as pool:  # they take seconds to start: one set for all pieces
        for piece in chosen:
            request, assets = make_request(piece.category, piece.options(sizes or SIZES, backend))
            settings = request.settings
            started = time.monotonic()
            made = generate(
                request,
                assets,
                out / piece.name,
                versions(settings.backend),
                running,
                pool,
            )
            done = Done(piece=piece, made=made, seconds=time.monotonic() - started)
            _record(out / RECORD, done)
            yield done


def _record(path: Path, done: Done) -> None:
    """Add a split to the record; its time stays if nothing was made this time."""
    record = read_record(path)
    entry = _entry(done)
    before = record["splits"].get(done.piece.name)
    if before and before["digest"] == entry["digest"]:
        if done.made.kept == len(done.made.manifest.shards):
            entry = {**entry, **{key: before[key] for key in ("seconds", "shards_kept")}}
        else:
            entry["shards_kept"] = done.made.kept
    record["splits"][done.piece.name] = entry
    splits = record["splits"].values()
    record["total"] = {
        key: round(sum(split[key] for split in splits), 1)
        for key in ("samples", "bytes", "seconds")
    }
    write_bytes(path, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode())


def read_record(path: Path) -> dict[str, Any]:
    """The record of a benchmark folder, empty where there is none.

    Raises:
        ValueError: The file is something else.
    """
    if not path.exists():
        return {"format": FORMAT, "benchmark": NAME, "splits": {}, "total": {}}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, found {error}") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise ValueError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    return record


def _entry(done: Done) -> dict[str, Any]:
    manifest = done.made.manifest
    files = [done.made.folder / shard.file for shard in manifest.shards]
    return {
        "samples": manifest.count,
        "objects": len(manifest.instances),
        "bytes": sum(path.stat().st_size for path in files),
        "seconds": round(done.seconds, 1),
        "shards_kept": done.made.kept,
        "digest": manifest.digest,
        "plan_digest": manifest.plan_digest,
        "redrawn_share": manifest.statistics.get("redrawn_share", 0.0),
        "samples_lost": int(manifest.statistics.get("samples_lost", 0)),
        "backend": manifest.options["backend"],
        "versions": dict(manifest.versions),
    }
