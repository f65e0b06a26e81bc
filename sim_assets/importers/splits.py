# SPDX-License-Identifier: MIT
"""Labelled clouds of other people's sets as splits in our layout (docs/data-format.md).

Each file of the set is one sample. The points are drawn by a generator that the file's name seeds,
so a sample does not depend on which other files are there. A split is written beside its place and
moved there when whole.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from scapo.categories import CATEGORIES
from scapo.parallel.pool import AbstractPool, Report
from scapo.store import SAMPLES, canonical_json, write, write_bytes
from scapo.store.folders import refuse_foreign, swap
from scapo.store.manifest import (
    Instance,
    Manifest,
    ManifestError,
    Shard,
    read_manifest,
    shards_digest,
)
from scapo.text import one_line
from sim_assets.describe.card import CARD, write_card
from sim_assets.describe.croissant import CROISSANT
from sim_assets.formats.archives import read_bytes
from sim_assets.importers.clouds import CloudFile, RawCloud
from sim_assets.models.limits import CLOCK_SECONDS, bounded
from sim_assets.models.validate import refuse
from sim_assets.sampling.viewpoints import generator

SHARD_SAMPLES = 64
Row = dict[str, np.ndarray]


@runtime_checkable
class CloudReader(Protocol):
    """A module of `sim_assets.models.sources` that reads clouds."""

    SET: str

    @staticmethod
    def find(path: Path) -> list[CloudFile]:
        """The files of the set below a path."""
        ...

    @staticmethod
    def read(file: CloudFile, data: bytes) -> RawCloud:
        """One cloud."""
        ...


@dataclass(slots=True, kw_only=True)
class SplitWriter:
    """Writes the samples of one split; a context that leaves nothing behind when it fails."""

    folder: Path
    """Where the split will be."""
    category: str
    split: str
    points: int
    set_name: str
    variant: str
    shards: list[Shard] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    instances: dict[str, list[str]] = field(default_factory=dict)
    """Id -> lines of file name and SHA-256."""
    count: int = 0

    @property
    def place(self) -> Path:
        """Where it is while it is being written."""
        return self.folder.with_name(f".{self.folder.name}.importing")

    def __enter__(self) -> SplitWriter:
        """Clear the place of what a run that was killed left there."""
        refuse_foreign(self.folder, *self._mine())
        shutil.rmtree(self.place, ignore_errors=True)
        return self

    def __exit__(self, *exc: object) -> None:
        """Remove the place, unless it has been moved."""
        shutil.rmtree(self.place, ignore_errors=True)

    def _mine(self) -> tuple[Callable[[Path], bool], str]:
        return partial(made_from, self.set_name), f"data from {self.set_name}"

    def add(self, file: CloudFile, sha256: str, row: Row) -> None:
        """One sample, and the SHA-256 of its file."""
        lines = self.instances.setdefault(file.instance, [])
        lines.append(f"{file.name} {sha256}\n")
        row["instance"] = np.array(list(self.instances).index(file.instance), np.int32)
        self.rows.append(row)
        self.count += 1
        if len(self.rows) == SHARD_SAMPLES:
            self._flush()

    def _flush(self) -> None:
        if not self.rows:
            return
        name, first = f"{len(self.shards):05d}.safetensors", self.count - len(self.rows)
        arrays = {key: np.stack([row[key] for row in self.rows]) for key in self.rows[0]}
        header = {
            "format": SAMPLES,
            "category": self.category,
            "split": self.split,
            "first": first,
            "count": len(self.rows),
            "options": self._options(),
        }
        sha256 = write(self.place / name, arrays, header)
        self.shards.append(Shard(file=name, first=first, count=len(self.rows), sha256=sha256))
        self.rows.clear()

    def _options(self) -> dict[str, Any]:
        options = {"source": self.set_name, "points": self.points, "noise": "real"}
        if self.variant:
            options |= {"variant": self.variant, "noise": "none"}
        return options

    def finish(self, refused: int) -> Path:
        """Write the last shard and the manifest, and move the split to its place."""
        self._flush()
        write_bytes(self.place / "manifest.json", self._manifest(refused).to_json().encode())
        write_card(self.place)
        swap(self.place, self.folder, *self._mine())
        return self.folder

    def _manifest(self, refused: int) -> Manifest:
        category = CATEGORIES[self.category]
        files = [line for lines in self.instances.values() for line in lines]
        return Manifest(
            category=self.category,
            split=self.split,
            count=self.count,
            points=self.points,
            parts=category.parts,
            joints=category.joints,
            options=self._options(),
            seed=0,
            instances=tuple(self._instance(name) for name in self.instances),
            shards=tuple(self.shards),
            versions={"import": f"scapo-import-{self.set_name}/1"},
            plan_digest=hashlib.sha256(canonical_json(files).encode()).hexdigest(),
            digest=shards_digest(tuple(self.shards)),
            statistics={"files_refused": float(refused)},
        )

    def _instance(self, name: str) -> Instance:
        joints = len(CATEGORIES[self.category].joints)
        lines = self.instances[name]
        return Instance(
            id=name,
            source=lines[0].rpartition(" ")[0].rpartition("/")[0],
            sha256=hashlib.sha256("".join(lines).encode()).hexdigest(),
            object_T_asset=tuple(tuple(row) for row in np.eye(4).tolist()),
            rest={},
            joint_names=tuple(f"joint_{j}" for j in range(joints)),
            sign=(1.0,) * joints,
        )


def made_from(set_name: str, folder: Path) -> bool:
    """Whether a folder holds a split of that set and no other file."""
    try:
        manifest = read_manifest(folder / "manifest.json")
    except ManifestError:
        return False
    own = {"manifest.json", CARD, CROISSANT, *(shard.file for shard in manifest.shards)}
    alone = all(path.name in own and not path.is_symlink() for path in folder.iterdir())
    return alone and manifest.options.get("source") == set_name


def sample(cloud: RawCloud, points: int, name: str) -> Row:
    """One sample's tensors but the instance: `points` of its points, seeded by its name.

    All points in their order where the number is right; drawn with replacement where it is short.
    """
    count = len(cloud.points)
    rng = generator("import", name)
    chosen = np.arange(count)
    if count != points:
        chosen = rng.choice(count, points, replace=count < points)
    row = {
        "points": cloud.points[chosen],
        "camera_T_part": cloud.camera_T_part,
        "joint_pivot": cloud.pivot,
        "joint_axis": cloud.axis,
        "joint_state": cloud.state,
        "visible": cloud.visible,
        "camera": np.array(cloud.camera),
    }
    result = {key: np.asarray(value, np.float32) for key, value in row.items()}
    result["part"] = cloud.part[chosen]
    if cloud.color is not None:
        result["color"] = cloud.color[chosen]
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudJob:
    """Read one file in a worker."""

    read: Callable[[CloudFile, bytes], RawCloud]
    file: CloudFile
    points: int


def read_sample(job: CloudJob, report: Report) -> tuple[str, Row]:
    """The SHA-256 of a file and its sample.

    Raises:
        ValueError: It cannot be used, and why.
    """
    report(one_line(job.file.name), 0)
    with bounded(job.file.path):
        if not job.file.name.isprintable():
            raise refuse(job.file.path, "names that can be printed", "others")
        data = read_bytes(job.file.path)
        row = sample(job.read(job.file, data), job.points, job.file.name)
    return hashlib.sha256(data).hexdigest(), row


def import_split(
    reader: CloudReader,
    writer: SplitWriter,
    files: Sequence[CloudFile],
    pool: AbstractPool[CloudJob, tuple[str, Row]],
    on_file: Callable[[CloudFile, str], None],
) -> Path | None:
    """Write one split.

    Args:
        reader: Of the set.
        writer: Of the split.
        files: In the order of its samples.
        pool: Reads them.
        on_file: Told of each file when it is done why it could not be used, "" if it could; may
            raise.

    Returns:
        Its folder, or None where no file could be used.
    """
    refused = 0
    with writer:
        for start in range(0, len(files), SHARD_SAMPLES):
            chunk = files[start : start + SHARD_SAMPLES]
            jobs = [CloudJob(read=reader.read, file=f, points=writer.points) for f in chunk]
            done = pool.run(read_sample, jobs, within=CLOCK_SECONDS)
            outcomes = {outcome.job.file.path: outcome for outcome in done}
            for file in chunk:  # in their order, be one read again or not
                result = outcomes[file.path].result
                if result is None:
                    refused += 1
                else:
                    writer.add(file, *result)
                on_file(file, outcomes[file.path].reason)
        return writer.finish(refused) if writer.count else None
