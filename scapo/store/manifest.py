# SPDX-License-Identifier: MIT
"""`manifest.json`: what a split holds and what made it (docs/data-format.md)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scapo.categories import JointSpec
from scapo.geometry.matrices import rotation_error
from scapo.store.json_records import StoreError, from_json, read_json, readable_json
from scapo.store.regular import NOT_OWN, is_odd
from scapo.text import is_word

FORMAT = "scapo-manifest/1"
MAX_POINTS = 1 << 24
"""Of a shard, which is read whole: a quarter of a gigabyte."""


class ManifestError(StoreError):
    """The manifest is not valid: `path: field: expected, found`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shard:
    """One file of samples."""

    file: str
    first: int
    count: int
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Instance:
    """One object: where it came from and how its frames relate."""

    id: str
    source: str
    """Relative to the source folder."""
    sha256: str
    """Of its files."""
    object_T_asset: tuple[tuple[float, ...], ...]
    """4x4 similarity from the URDF root link at rest to the object frame."""
    rest: dict[str, float]
    """URDF joint name -> position at rest."""
    joint_names: tuple[str, ...]
    """The URDF joint of each category joint."""
    sign: tuple[float, ...]
    """state = sign * (q - rest)."""
    trait: str = ""
    """What sets it apart from the training shapes, in `test-ood`; not stored where empty."""
    account: tuple[str, ...] = ()
    """How a model was read, one sentence each: joints, size, repairs; not stored where empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """All of `manifest.json` but its format tag."""

    category: str
    split: str
    count: int
    points: int
    parts: tuple[str, ...]
    joints: tuple[JointSpec, ...]
    options: dict[str, Any]
    """All that changes pixels."""
    seed: int
    instances: tuple[Instance, ...]
    shards: tuple[Shard, ...]
    versions: dict[str, str]
    plan_digest: str
    digest: str
    """Of the data; ours is `shards_digest`, other writers may have their own."""
    statistics: dict[str, float] = field(default_factory=dict)
    """Facts of the run that no reader needs, such as the share of views redrawn."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Object -> reason, of those refused or given up; not written where there are none."""

    def to_json(self) -> str:
        """Indented, sorted, with a final newline."""
        data = {"format": FORMAT, **asdict(self)}
        for row in data["instances"]:
            for name in ("trait", "account"):
                if not row[name]:
                    del row[name]
        if not self.left_out:
            del data["left_out"]
        return readable_json(data)


def shards_digest(shards: tuple[Shard, ...]) -> str:
    """SHA-256 over the shard hashes in order: the digest of the data."""
    return hashlib.sha256("\n".join(shard.sha256 for shard in shards).encode()).hexdigest()


def read_manifest(path: Path | str) -> Manifest:
    """Read and validate; fields that this version does not know are left alone.

    Raises:
        ManifestError: No file, or a link, a pipe or a device; broken JSON, another format, a
            missing or contradictory field.
    """
    path = Path(path)
    if is_odd(path):
        raise ManifestError(f"{path}: {NOT_OWN}")
    if not path.exists():
        raise ManifestError(f"{path}: expected a manifest, found no file")
    data = read_json(path, ManifestError)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise ManifestError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    manifest = from_json(Manifest, data, str(path), error=ManifestError)
    for name in ("category", "split"):
        found = getattr(manifest, name)
        _expect(is_word(found), f"{path}: {name}: expected a folder's name, found {found!r}")
    _check_joints(path, manifest)
    _check_instances(path, manifest)
    _check_shards(path, manifest)
    return manifest


def _expect(holds: bool, message: str) -> None:
    if not holds:
        raise ManifestError(message)


def _unique(path: Path, what: str, names: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in names:
        _expect(name not in seen, f"{path}: expected different {what}, found {name!r} twice")
        seen.add(name)


def _check_joints(path: Path, manifest: Manifest) -> None:
    """Part 0 is the base, joint j links it to part j + 1 (docs/data-format.md)."""
    parts, joints = len(manifest.parts), len(manifest.joints)
    _expect(
        parts == joints + 1,
        f"{path}: expected one joint less than parts, found {parts} parts and {joints} joints",
    )
    _unique(path, "parts", manifest.parts)
    for i, joint in enumerate(manifest.joints):
        _expect(
            (joint.parent, joint.child) == (0, i + 1),
            f"{path}: joints[{i}]: expected parent 0 and child {i + 1}, found "
            f"{joint.parent} and {joint.child}",
        )
        _expect(
            joint.lower <= joint.upper,
            f"{path}: joints[{i}]: expected lower <= upper, found {joint.lower} and {joint.upper}",
        )


def _check_instances(path: Path, manifest: Manifest) -> None:
    _unique(path, "instance ids", [instance.id for instance in manifest.instances])
    joints = len(manifest.joints)
    for i, instance in enumerate(manifest.instances):
        where = f"{path}: instances[{i}]"
        for name in ("joint_names", "sign"):
            found = getattr(instance, name)
            _expect(
                len(found) == joints,
                f"{where}: {name}: expected {joints} entries, one per joint, found {len(found)}",
            )
        _expect(
            all(sign in (-1, 1) for sign in instance.sign),
            f"{where}: sign: expected 1 or -1, found {instance.sign}",
        )
        _expect(
            _is_similarity(instance.object_T_asset),
            f"{where}: object_T_asset: expected a 4x4 similarity, found {instance.object_T_asset}",
        )


def _is_similarity(rows: tuple[tuple[float, ...], ...]) -> bool:
    """Whether these are the rows of [s R | t; 0 0 0 1] with s > 0."""
    if [len(row) for row in rows] != [4] * 4 or rows[3] != (0, 0, 0, 1):
        return False
    linear = np.array(rows)[:3, :3]
    determinant = np.linalg.det(linear)
    return bool(determinant > 0 and rotation_error(linear / np.cbrt(determinant)) < 1e-3)


def _check_shards(path: Path, manifest: Manifest) -> None:
    _expect(manifest.points > 0, f"{path}: points: expected 1 or more, found {manifest.points}")
    _unique(path, "shard files", [shard.file for shard in manifest.shards])
    first = 0
    for shard in manifest.shards:
        _expect(
            shard.first == first and shard.count > 0,
            f"{path}: shard {shard.file}: expected first {first} and a count of 1 or more, "
            f"found {shard.first} and {shard.count}",
        )
        _expect(
            shard.count * manifest.points <= MAX_POINTS,
            f"{path}: shard {shard.file}: expected at most {MAX_POINTS} points, found "
            f"{shard.count} samples of {manifest.points}",
        )
        _expect(
            shard.file not in ("", "..") and Path(shard.file).name == shard.file,
            f"{path}: expected a shard name without folders, found {shard.file!r}",
        )
        first += shard.count
    _expect(
        first == manifest.count,
        f"{path}: expected count {manifest.count}, found {first} in shards",
    )
