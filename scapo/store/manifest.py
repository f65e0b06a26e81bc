# SPDX-License-Identifier: MIT
"""`manifest.json`: what a split holds and what made it (docs/data-format.md)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

import numpy as np

from scapo.types import JointSpec

FORMAT = "scapo-manifest/1"


class ManifestError(ValueError):
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
    statistics: dict[str, float]
    """Facts of the run that no reader needs, such as the share of views redrawn."""

    def to_json(self) -> str:
        """Indented, sorted, with a final newline."""
        data = {"format": FORMAT, **asdict(self)}
        data["instances"] = [_without_defaults(Instance, row) for row in data["instances"]]
        return json.dumps(data, sort_keys=True, indent=1, allow_nan=False) + "\n"


def _without_defaults(kind: Any, row: dict[str, Any]) -> dict[str, Any]:  # noqa: ANN401
    usual = {entry.name: entry.default for entry in fields(kind) if entry.default is not MISSING}
    return {name: value for name, value in row.items() if usual.get(name, MISSING) != value}


def shards_digest(shards: tuple[Shard, ...]) -> str:
    """SHA-256 over the shard hashes in order: the digest of the data."""
    return hashlib.sha256("\n".join(shard.sha256 for shard in shards).encode()).hexdigest()


def read_manifest(path: Path | str) -> Manifest:
    """Read and validate; fields that this version does not know are left alone.

    Raises:
        ManifestError: No file, broken JSON, another format, a missing or contradictory field.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_number)
    except FileNotFoundError as error:
        raise ManifestError(f"{path}: expected a manifest, found no file") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ManifestError(f"{path}: expected JSON, found {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise ManifestError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    manifest: Manifest = _record(Manifest, {"statistics": {}, **data}, str(path))
    _check_joints(path, manifest)
    _check_instances(path, manifest)
    _check_shards(path, manifest)
    return manifest


def _no_number(text: str) -> None:
    raise ValueError(f"{text}, which JSON lacks")


def _record(cls: Any, data: object, where: str) -> Any:  # noqa: ANN401
    """A dataclass from JSON, each field checked against its annotation."""
    if not isinstance(data, dict):
        raise ManifestError(f"{where}: expected an object, found {type(data).__name__}")
    usual = {entry.name for entry in fields(cls) if entry.default is not MISSING}
    hints = {n: hint for n, hint in get_type_hints(cls).items() if n in data or n not in usual}
    missing = [name for name in hints if name not in data]
    if missing:
        raise ManifestError(f"{where}: expected field {missing[0]!r}, found none")
    return cls(
        **{name: _value(hint, data[name], f"{where}: {name}") for name, hint in hints.items()}
    )


_SCALARS: dict[Any, tuple[str, tuple[type, ...]]] = {
    str: ("text", (str,)),
    int: ("an integer", (int,)),
    float: ("a number", (int, float)),
}


def _value(hint: Any, value: object, where: str) -> Any:  # noqa: ANN401
    """A JSON value as the annotation `hint` has it; lists become tuples."""
    kind, inner = get_origin(hint), get_args(hint)
    if is_dataclass(hint):
        return _record(hint, value, where)
    if kind is tuple:
        _expect(isinstance(value, list), f"{where}: expected a list, found {value!r}")
        items = enumerate(cast("list[object]", value))
        return tuple(_value(inner[0], item, f"{where}[{i}]") for i, item in items)
    if kind is dict:
        _expect(isinstance(value, dict), f"{where}: expected an object, found {value!r}")
        pairs = cast("dict[str, object]", value).items()
        return {key: _value(inner[1], item, f"{where}[{key!r}]") for key, item in pairs}
    if kind is Literal:
        _expect(value in inner, f"{where}: expected one of {', '.join(inner)}, found {value!r}")
    if hint in _SCALARS:
        name, types = _SCALARS[hint]
        fits = isinstance(value, types) and not isinstance(value, bool)
        _expect(fits, f"{where}: expected {name}, found {value!r}")
        return hint(value)
    return value


def _expect(holds: bool, message: str) -> None:
    if not holds:
        raise ManifestError(message)


def _unique(path: Path, what: str, names: Sequence[str]) -> None:
    for i, name in enumerate(names):
        _expect(name not in names[:i], f"{path}: expected different {what}, found {name!r} twice")


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
    if not determinant > 0:
        return False
    rotation = linear / np.cbrt(determinant)
    return bool((abs(rotation @ rotation.T - np.eye(3)) < 1e-3).all())


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
            shard.file not in ("", "..") and Path(shard.file).name == shard.file,
            f"{path}: expected a shard name without folders, found {shard.file!r}",
        )
        first += shard.count
    _expect(
        first == manifest.count,
        f"{path}: expected count {manifest.count}, found {first} in shards",
    )
