# SPDX-License-Identifier: MIT
"""External data sets brought into our layouts (`scapo-data import`).

Clouds (`op-align-real`, `op-align-light`) become splits that every program here reads, models
(`shape2motion`, `hoi4d`, `partnet-mobility`) URDF folders for `scapo-data generate --source`. A
file that cannot be used is named with the reason and left out; nothing takes its place.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from scapo.export.urdf import write_urdf
from scapo.parallel.pool import AbstractPool, Pool, Report
from scapo.store.folders import refuse_inside
from scapo.text import one_line
from sim_assets.importers import hoi4d, op_align_light, op_align_real, shape2motion
from sim_assets.importers import partnet_mobility as partnet_models
from sim_assets.importers.clouds import CloudFile
from sim_assets.importers.models import Folder, Model
from sim_assets.importers.splits import CloudReader, SplitWriter, import_split
from sim_assets.models.limits import CLOCK_SECONDS, bounded

Progress = Callable[[str, int, int], None]


@runtime_checkable
class ModelReader(Protocol):
    """A module of `sim_assets.models.sources` that reads models."""

    @staticmethod
    def find(path: Path) -> list[Folder]:
        """The models of the set below a path."""
        ...

    @staticmethod
    def read(folder: Folder) -> Model:
        """One model."""
        ...


CLOUDS: dict[str, CloudReader] = {
    "op-align-real": op_align_real,
    "op-align-light": op_align_light,
}
MODELS: dict[str, ModelReader] = {
    "shape2motion": shape2motion,
    "hoi4d": hoi4d,
    "partnet-mobility": partnet_models,
}


@dataclass(slots=True, kw_only=True)
class Imported:
    """What became of a set."""

    written: list[Path] = field(default_factory=list)
    """Folders of splits, or URDF files."""
    refused: dict[str, str] = field(default_factory=dict)
    """File or folder -> why it could not be used."""
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Model -> what was put right."""
    samples: int = 0
    """Clouds written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How a set is read: nothing here changes what is written."""

    workers: int = 0
    """Processes; 0: this one, unprotected against files that crash it or never end."""
    timeout: float = 300.0
    """Seconds without a sign of life after which a file counts as hanging."""
    progress: Progress = lambda what, done, total: None
    """Told what is being read, how many are done, how many there are."""


def import_set(
    name: str,
    path: Path,
    out: Path,
    *,
    points: int = 1024,
    strict: bool = False,
    reading: Reading | None = None,
) -> Imported:
    """Bring a set into our layout.

    Args:
        name: Of the set, as on the command line.
        path: The set's folder, or one above or within it.
        out: Clouds: `out/<category>/<split>`, with the set's own names of variant and category
            above where one category and split has several. Models: `out/<category>/<id>`.
        points: Of each cloud.
        strict: Raise at the first file that cannot be used.
        reading: How.

    Raises:
        ValueError: No such set, nothing of it at `path`, a target that holds something else; with
            `strict`, the first file that cannot be used.
    """
    if name not in CLOUDS and name not in MODELS:
        known = ", ".join((*CLOUDS, *MODELS))
        raise ValueError(f"set {name!r}: expected one of {known}")
    if points < 1:
        raise ValueError(f"points: expected 1 or more, found {points}")
    result = Imported()

    def refuse(what: Path, reason: str) -> None:
        name, line = one_line(what), one_line(reason)
        if strict:
            raise ValueError(line)
        result.refused[name] = line.removeprefix(f"{name}: ")

    target = out.resolve()
    within = (target, *target.parents) if path.is_dir() else (target / path.name,)
    if path.exists() and path.resolve() in within:
        raise ValueError(f"{out}: expected a folder outside the source, found it in {path}")
    reading = reading or Reading()
    with Pool[Any, Any](reading.workers, timeout=reading.timeout) as pool:
        calls = pool, refuse, reading.progress
        if name in MODELS:
            _models(MODELS[name], path, out, result, calls)
        else:
            _clouds(CLOUDS[name], path, (out, points), result, calls)
    return result


Calls = tuple[AbstractPool[Any, Any], Callable[[Path, str], None], Progress]
"""What reads, what is told of a file that cannot be used, and of how much is done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelJob:
    """Read one model in a worker, and write it."""

    read: Callable[[Folder], Model]
    folder: Folder
    target: Path


def write_model(job: ModelJob, report: Report) -> tuple[Path, tuple[str, ...]]:
    """The URDF that was written, and what was put right.

    Raises:
        ValueError: It cannot be used, and why.
    """
    report(one_line(job.folder.name), 0)
    with bounded(job.folder.path):
        model = job.read(job.folder)
    return write_urdf(job.target, model.links, model.joints, model.name), model.notes


def _models(reader: ModelReader, path: Path, out: Path, result: Imported, calls: Calls) -> None:
    pool, refuse, show = calls
    folders = reader.find(path)
    jobs = _model_jobs(reader, folders, out, lambda folder, why: refuse(folder.path, why))
    refused = len(folders) - len(jobs)
    show("models", refused, len(folders))
    written: dict[Path, tuple[Path, tuple[str, ...]]] = {}
    outcomes = pool.run(write_model, jobs, within=CLOCK_SECONDS)
    for done, outcome in enumerate(outcomes, refused + 1):
        if outcome.result is None:
            refuse(outcome.job.folder.path, outcome.reason)
        else:
            written[outcome.job.target] = outcome.result
        show("models", done, len(folders))
    for job in jobs:  # in their order, be one read again or not
        if job.target in written:
            urdf, notes = written[job.target]
            result.written.append(urdf)
            if notes:
                result.notes[one_line(job.folder.name)] = notes


def _model_jobs(
    reader: ModelReader,
    folders: Sequence[Folder],
    out: Path,
    refuse: Callable[[Folder, str], None],
) -> list[ModelJob]:
    """What to read and where to write it, each in a place of its own outside the source."""
    source = Path(os.path.commonpath([folder.path for folder in folders]))
    seen: dict[Path, str] = {}
    jobs = []
    for folder in folders:
        target = out / folder.category / folder.id
        try:
            if target in seen:
                raise ValueError(
                    f"{folder.path}: expected one model {folder.category}/{folder.id}, found "
                    f"{seen[target]} too"
                )
            refuse_inside(target, folder.path, source)
        except ValueError as error:
            refuse(folder, str(error))
            continue
        seen[target] = folder.name
        jobs.append(ModelJob(read=reader.read, folder=folder, target=target))
    return jobs


def _clouds(
    reader: CloudReader,
    path: Path,
    wanted: tuple[Path, int],
    result: Imported,
    calls: Calls,
) -> None:
    pool, refuse, show = calls
    out, points = wanted
    files = sorted(reader.find(path), key=_split_of)
    source = Path(os.path.commonpath([file.path.parent for file in files]))
    several = _several(files)
    done = 0

    def on_file(file: CloudFile, reason: str) -> None:
        nonlocal done
        done += 1
        show("clouds", done, len(files))
        if reason:
            refuse(file.path, reason)

    show("clouds", done, len(files))
    for (category, split, variant), group in groupby(files, key=_split_of):
        members = list(group)
        top = out / variant if (category, split) in several else out
        writer = SplitWriter(
            folder=top / (category or "misplaced") / (split or "misplaced"),
            category=category,
            split=split,
            points=points,
            set_name=reader.SET,
            variant=variant,
        )
        refuse_inside(writer.folder, *(file.path for file in members), source)
        folder = import_split(reader, writer, members, pool, on_file)
        if folder is not None:
            result.written.append(folder)
            result.samples += writer.count


def _split_of(file: CloudFile) -> tuple[str, str, str]:
    return file.category, file.split, file.variant


def _several(files: list[CloudFile]) -> set[tuple[str, str]]:
    """Category and split pairs of which there is more than one variant."""
    variants: dict[tuple[str, str], set[str]] = {}
    for file in files:
        variants.setdefault((file.category, file.split), set()).add(file.variant)
    return {pair for pair, names in variants.items() if len(names) > 1}
