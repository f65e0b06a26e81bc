# SPDX-License-Identifier: MIT
"""The data of the benchmark `sim-art/2` (docs/benchmark.md): OUT/PART/CATEGORY/SPLIT, resumable.

`clean` is exact depth of an object that fills the picture, `sensor` a simulated depth camera at a
drawn distance with an imperfect mask, `complete` the whole surface of what `clean` shows, `real`
the user's models by the camera of `clean`. What each split cost and holds is recorded in one JSON
file, its objects in another.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from scapo.categories import CATEGORIES
from scapo.store import write_bytes
from scapo.store.json_records import from_json, read_json, readable_json
from scapo.text import UsageError, one_line
from sim_assets.generation.assets import Asset, UrdfAsset
from sim_assets.generation.generate import Made, Running, generate, open_workers
from sim_assets.generation.plan import Request
from sim_assets.generation.real import RealModels, readable, real_models
from sim_assets.generation.request import make_request, versions
from sim_assets.options import DataOptions, PresetName, SplitName

NAME = "sim-art/2"
FORMAT = "scapo-benchmark/1"
RECORD = "sim-art-2.json"
IDS_FORMAT = "scapo-split-ids/1"
IDS = "sim-art-2-ids.json"
OLD_COMMIT = "01c5925"
"""Makes `sim-art/1`, with the digests of results/sim-art-1."""
SEED = 2
"""Of the data, whatever the training seed."""
Part = Literal["clean", "sensor", "complete", "real"]
PRESETS: dict[Part, PresetName] = {
    "clean": "sim-art",
    "sensor": "sim-art-sensor",
    "complete": "sim-art-complete",
    "real": "sim-art",
}
MADE: tuple[Part, ...] = ("clean", "sensor", "complete")
"""Parts of procedural objects."""
BackendName = Literal["auto", "sapien", "raycast"]
Sizes = Mapping[SplitName, tuple[int, int]]
SIZES: Sizes = {"train": (100, 50), "val": (50, 20), "test": (50, 20), "test-ood": (40, 20)}
"""Instances, and samples of each."""
REAL_VIEWS = 20
"""Samples of each real model."""


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
            preset=PRESETS[self.part],
            noise="disparity" if sensor else "none",
            mask="imperfect" if sensor else "exact",
            backend=backend,
            ambiguity=self.split in ("test", "test-ood"),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What to make, apart from how."""

    only: Sequence[str] = ()
    """See `pieces`."""
    backend: BackendName = "sapien"
    sizes: Sizes | None = None
    """Instances and samples of each, by split; the benchmark's by default."""
    real: Path | None = None
    """Folder of the user's models."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """A piece that is there."""

    piece: Piece
    made: Made
    seconds: float


def check_name(name: str) -> None:
    """Refuse the benchmark's predecessor.

    Raises:
        ValueError: Naming the commit that has it.
    """
    if name != NAME:
        raise ValueError(
            f"benchmark: expected {NAME}, found {name}, which is made by commit {OLD_COMMIT} alone "
            f"(git checkout {OLD_COMMIT}); its digests are in results/sim-art-1"
        )


def pieces(only: Sequence[str] = (), real: RealModels | None = None) -> list[Piece]:
    """The pieces asked for, all without a word.

    Args:
        only: Words such as `clean`, `laptop`, `test`, or several joined by `/`
            (`sensor/laptop/train`); a piece is taken if all words of one item name it.
        real: The user's models, which add a piece for each category that they have.

    Raises:
        UsageError: A word that names nothing, or an item that names no piece.
    """
    every = [
        Piece(part=part, category=name, split=split)
        for part in MADE
        for name, category in CATEGORIES.items()
        if ("clean" if part == "complete" else part) in category.benchmark
        for split in get_args(SplitName)
    ]
    if real is not None:
        every += [Piece(part="real", category=name, split="test") for name in real.models]
    if not only:
        return every
    chosen = set()
    for item in only:
        words = set(item.split("/"))
        found = [piece for piece in every if words <= set(piece.name.split("/"))]
        if not found:
            parts = ", ".join(dict.fromkeys(piece.part for piece in every))
            splits = ", ".join(get_args(SplitName))
            raise UsageError(
                f"only: expected parts ({parts}), categories, splits ({splits}) or these joined "
                f"by /, found {item!r}"
            )
        chosen.update(found)
    return [piece for piece in every if piece in chosen]


def find_real(task: Task) -> RealModels | None:
    """The user's models, by category.

    Raises:
        ValueError: There is no such folder, or no model in it.
    """
    return None if task.real is None else real_models(task.real)


def make_benchmark(
    out: Path, task: Task | None = None, running: Running | None = None
) -> Iterator[Done]:
    """Make the pieces one after the other, and yield each when it is there and recorded.

    Args:
        out: Folder of the benchmark.
        task: What.
        running: Workers and progress.

    Raises:
        ValueError: `only` names nothing, or there are no real models.
        RenderError: The backend does not work here.
        GenerateError: A folder holds something else, or a split cannot be made.
    """
    task, running = task or Task(), running or Running()
    real = find_real(task)
    chosen = pieces(task.only, real)
    planned = [_request(piece, task, real) for piece in chosen]
    with open_workers(running, *(p.request for p in planned)) as pool:  # one set for all pieces
        for piece, first in zip(chosen, planned, strict=True):
            plan = first
            started = time.monotonic()
            if real is not None and piece.part == "real":
                models, unreadable = readable(real.models[piece.category], pool)
                plan = replace(_request(piece, task, real, models), unreadable=unreadable)
            made = generate(
                plan.request,
                plan.assets,
                out / piece.name,
                versions(plan.request.settings.backend),
                running,
                pool,
            )
            made = replace(made, failed={**plan.unreadable, **made.failed})
            done = Done(piece=piece, made=made, seconds=time.monotonic() - started)
            _record(out / RECORD, done)
            _record_ids(out / IDS, done)
            yield done


@dataclass(frozen=True, slots=True, kw_only=True)
class _Planned:
    """What a piece asks for."""

    request: Request
    assets: Sequence[Asset]
    unreadable: Mapping[str, str] = field(default_factory=dict)
    """Models that cannot be read, and why."""


def _request(
    piece: Piece, task: Task, real: RealModels | None, models: Sequence[UrdfAsset] | None = None
) -> _Planned:
    """What to make of which objects; of real ones `models`, by default all of the category."""
    options = piece.options(task.sizes or SIZES, task.backend)
    if real is None or piece.part != "real":
        request, assets = make_request(piece.category, options)
        return _Planned(request=request, assets=assets)
    chosen = real.models[piece.category] if models is None else models
    source = str(real.root.absolute())
    options = replace(options, source=source, count=REAL_VIEWS * len(chosen), instances=len(chosen))
    request, assets = make_request(piece.category, options, chosen)
    told = {**request.source_options, "chosen_by": f"benchmark {NAME} --real"}
    return _Planned(request=replace(request, source_options=told), assets=assets)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Split:
    """What is read of a split's entry."""

    samples: int
    bytes: int
    seconds: float
    digest: str
    shards_kept: int


@dataclass(frozen=True, slots=True, kw_only=True)
class _Record:
    """What is read of the record."""

    splits: dict[str, _Split]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Listed:
    """What is read of the list of objects."""

    splits: dict[str, tuple[str, ...]]


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
    write_bytes(path, readable_json(record).encode())


def _record_ids(path: Path, done: Done) -> None:
    """Add the objects of a split to the list of all: ids in order, and the traits of `test-ood`."""
    listed = read_record(path, IDS_FORMAT)
    instances = done.made.manifest.instances
    listed["splits"][done.piece.name] = [instance.id for instance in instances]
    traits = {instance.id: instance.trait for instance in instances if instance.trait}
    if traits:
        listed.setdefault("traits", {})[done.piece.name] = traits
    write_bytes(path, readable_json(listed).encode())


def read_record(path: Path, expected: str = FORMAT) -> dict[str, Any]:
    """The record of a benchmark folder, or its list of objects; empty where there is none.

    Args:
        path: The file.
        expected: Its `format`.

    Raises:
        ValueError: The file is something else.
    """
    if not path.exists():
        return {"format": expected, "benchmark": NAME, "seed": SEED, "splits": {}}
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") != expected:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise ValueError(
            f"{path}: expected format {expected!r}, found {one_line(repr(found), 200)}"
        )
    from_json(_Record if expected == FORMAT else _Listed, record, str(path))
    return record


def _entry(done: Done) -> dict[str, Any]:
    manifest = done.made.manifest
    traits = Counter(instance.trait for instance in manifest.instances if instance.trait)
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
        **({"traits": dict(sorted(traits.items()))} if traits else {}),
        **({"left_out": dict(done.made.failed)} if done.made.failed else {}),
    }
