# SPDX-License-Identifier: MIT
"""The state of a split that is being made, kept in its folder so that it can be taken up again.

`.plan.json`: what is being made, and the objects as first read. `.finished`: one line per finished
shard with the SHA-256 of its bytes. Both go when the manifest is written.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scapo.store import canonical_json, sha256_file, write_bytes
from scapo.store.folders import alone
from scapo.store.json_records import StoreError, from_json, read_json
from scapo.store.manifest import Instance, Manifest, ManifestError, read_manifest
from scapo.store.regular import NOT_OWN, is_odd, read_regular
from scapo.text import one_line
from sim_assets.generation.assets import Asset
from sim_assets.generation.images import remove_unfinished
from sim_assets.generation.plan import Entry
from sim_assets.generation.shard import ShardDone, read_done

PLAN = ".plan.json"
FINISHED = ".finished"
SEEN = 60.0
"""Seconds after which a shard that another machine wrote must be seen here."""
PLAN_FORMAT = "scapo-plan/1"


class GenerateError(RuntimeError):
    """A split cannot be made: `where: what was expected, what was found`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Planned:
    """An object as first read."""

    instance: Instance
    geometry: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """All of `.plan.json`."""

    format: str
    identity: dict[str, Any]
    versions: dict[str, str]
    entries: tuple[_Planned, ...]
    refused: dict[str, str]


class Ledger:
    """The folder of a split: locked while open, and checked against what is to be made."""

    def __init__(
        self, folder: Path, identity: Mapping[str, Any], versions: Mapping[str, str]
    ) -> None:
        """Nothing is touched before the context is entered.

        Args:
            folder: Of the split.
            identity: What is to be made, as JSON values.
            versions: Of what makes the pixels.
        """
        self.folder = folder
        self.identity = json.loads(canonical_json(identity))
        self.versions = dict(versions)
        self.manifest: Manifest | None = None
        self.plan: _Plan | None = None
        self._held = ExitStack()

    def __enter__(self) -> Ledger:
        """Create and lock the folder, and read what is there.

        Raises:
            GenerateError: It holds something else, or another process is writing there.
        """
        with ExitStack() as opened:
            try:
                opened.enter_context(alone(self.folder, "generation"))
            except StoreError as error:
                raise GenerateError(str(error)) from error
            except OSError as error:
                message = f"{self.folder}: expected a folder to write to: {error}"
                raise GenerateError(message) from error
            self._look()
            self._held = opened.pop_all()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Unlock.

        Raises:
            GenerateError: In place of an OSError, which need not say where it arose.
        """
        self._held.close()
        if isinstance(error, OSError):
            where = error.filename or self.folder
            raise GenerateError(
                f"{where}: expected to be written, found: {error.strerror or error}"
            ) from error

    def entries(self, assets: Sequence[Asset]) -> tuple[tuple[Entry, ...], dict[str, str]] | None:
        """The objects as first read and those refused, if that was recorded."""
        if self.plan is None:
            return None
        by_name = {asset.name: asset for asset in assets}
        for row in self.plan.entries:
            if row.instance.id not in by_name:
                raise GenerateError(
                    f"{self.folder}: expected the objects it was begun with, found no "
                    f"{one_line(row.instance.id, 200)!r}; delete the folder to make it anew"
                )
        entries = tuple(
            Entry(asset=by_name[row.instance.id], instance=row.instance, geometry=row.geometry)
            for row in self.plan.entries
        )
        return entries, self.plan.refused

    def refused(self) -> dict[str, str]:
        """Objects that an earlier run refused, with the reason, beside its finished manifest."""
        if self.manifest is None:
            return {}
        shown = {record.id for record in self.manifest.instances}
        return {n: why for n, why in self.manifest.left_out.items() if n not in shown}

    def begin(self, entries: Sequence[Entry], refused: Mapping[str, str]) -> None:
        """Record the objects before the first shard is made.

        Raises:
            GenerateError: A finished data set is there, made from other objects.
        """
        if self.manifest is not None:
            before = [(record.id, record.sha256) for record in self.manifest.instances]
            there = [(entry.instance.id, entry.instance.sha256) for entry in entries]
            if there[: len(before)] != before:
                raise GenerateError(
                    f"{self.folder}: expected the objects of its manifest, found others; choose "
                    "another folder or delete this one"
                )
        plan = _Plan(
            format=PLAN_FORMAT,
            identity=self.identity,
            versions=self.versions,
            entries=tuple(_Planned(instance=e.instance, geometry=e.geometry) for e in entries),
            refused=dict(refused),
        )
        write_bytes(self.folder / PLAN, canonical_json(asdict(plan)).encode())

    def finished(self) -> dict[str, ShardDone]:
        """Shards that are there whole, by file name: none with an object that failed."""
        done = {}
        for file, sha256 in self._recorded().items():
            path = self.folder / file
            with suppress(StoreError):  # of another program: made anew
                if path.is_file() and sha256_file(path) == sha256:
                    shard = read_done(path, sha256)
                    if not shard.failed:
                        done[file] = shard
        return done

    def record(self, shard: ShardDone) -> None:
        """Note that a shard is finished.

        Raises:
            GenerateError: Another machine says that it wrote it, but it is not there.
        """
        path = self.folder / shard.file
        until = time.monotonic() + SEEN
        while not path.exists():  # a network file system may show it late
            if time.monotonic() > until:
                raise GenerateError(
                    f"{path}: expected a shard that is said to be written, found none: is the "
                    "folder on storage that all machines share?"
                )
            time.sleep(0.1)
            os.listdir(self.folder)  # noqa: PTH208 - makes an NFS client look again
        try:
            with (self.folder / FINISHED).open("a") as file:
                file.write(f"{shard.sha256}  {shard.file}\n")
        except OSError as error:  # a full disk is reported without a name
            raise OSError(error.errno, error.strerror, str(self.folder / FINISHED)) from error

    def finish(self, manifest: Manifest, empty: Sequence[str]) -> None:
        """Write the manifest, then remove what was needed only until now."""
        write_bytes(self.folder / "manifest.json", manifest.to_json().encode())
        for name in (*empty, FINISHED, PLAN):
            (self.folder / name).unlink(missing_ok=True)

    def _look(self) -> None:
        for path in self.folder.glob(".*.tmp"):  # of a run that was killed while writing
            path.unlink(missing_ok=True)
        remove_unfinished(self.folder)
        self._own()
        if (self.folder / "manifest.json").exists():
            try:
                self.manifest = read_manifest(self.folder / "manifest.json")
            except ManifestError as error:
                raise GenerateError(f"{error}; delete the folder to make it anew") from error
            self._compare(self._identity_of(self.manifest))
        if (self.folder / PLAN).exists():
            self.plan = self._read_plan()
            self._compare(self.plan.identity)
            if self.plan.versions != self.versions:
                raise GenerateError(
                    f"{self.folder}: expected the versions it was begun with, "
                    f"{_difference(self.plan.versions, self.versions)}; delete the folder to "
                    "make it anew"
                )
        if self.manifest is None and self.plan is None:
            found = sorted(path.name for path in self.folder.glob("*.safetensors"))
            if found:
                raise GenerateError(
                    f"{self.folder}: expected an empty folder, found {found[0]} without a manifest"
                )

    def _own(self) -> None:
        """Refuse records that are links; one that others share, as backups do, is copied."""
        for path in (self.folder / name for name in ("manifest.json", PLAN, FINISHED)):
            if is_odd(path):
                raise GenerateError(f"{path}: {NOT_OWN}")
        record = self.folder / FINISHED  # which is written on
        if record.exists() and record.stat().st_nlink > 1:
            write_bytes(record, read_regular(record))

    def _read_plan(self) -> _Plan:
        path = self.folder / PLAN
        try:
            plan = read_json(path)
            if not isinstance(plan, dict) or plan.get("format") != PLAN_FORMAT:
                raise GenerateError(f"{path}: expected format {PLAN_FORMAT!r}")
            return from_json(_Plan, plan, str(path))
        except StoreError as error:
            raise GenerateError(f"{error}; delete the folder to make it anew") from error

    def _recorded(self) -> dict[str, str]:
        recorded = {}
        if self.manifest is not None:
            recorded = {shard.file: shard.sha256 for shard in self.manifest.shards}
        try:
            lines = read_regular(self.folder / FINISHED).decode(errors="replace").splitlines()
        except FileNotFoundError:
            lines = []
        for line in lines:
            sha256, _, file = line.partition("  ")
            if len(sha256) == 64 and Path(file).suffix == ".safetensors":  # else cut off
                recorded[Path(file).name] = sha256
        return recorded

    def _identity_of(self, manifest: Manifest) -> dict[str, Any]:
        options = dict(manifest.options)
        options.pop("samples_per_instance", None)
        return {
            "category": manifest.category,
            "split": manifest.split,
            "seed": manifest.seed,
            "count": self.identity["count"]
            if manifest.statistics.get("samples_lost")
            else manifest.count,
            "options": options,
        }

    def _compare(self, there: dict[str, Any]) -> None:
        if there != self.identity:
            raise GenerateError(
                f"{self.folder}: expected what was begun there, "
                f"{_difference(there, self.identity)}; choose another folder or delete this one"
            )


def _difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """`points 1024, found points 512` for the first field that differs."""
    for name in sorted({*there, *asked}):
        a, b = there.get(name), asked.get(name)
        if a == b:
            continue
        if isinstance(a, dict) and isinstance(b, dict):
            return _difference(a, b)
        return f"{name} {one_line(a, 200)}, found {name} {one_line(b, 200)}"
    return "the same"
