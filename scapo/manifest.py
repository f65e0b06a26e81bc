# SPDX-License-Identifier: MIT
"""`manifest.json`: what a split holds and what made it (CONTRACT 3)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

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
    statistics: dict[str, float]
    """Facts of the run that no reader needs, such as the share of views redrawn."""

    def to_json(self) -> str:
        """Indented, sorted, with a final newline."""
        data = {"format": FORMAT, **asdict(self)}
        return json.dumps(data, sort_keys=True, indent=1, allow_nan=False) + "\n"


def shards_digest(shards: tuple[Shard, ...]) -> str:
    """SHA-256 over the shard hashes in order: the digest of the data."""
    return hashlib.sha256("\n".join(shard.sha256 for shard in shards).encode()).hexdigest()


def _record(cls: type, data: object, where: str) -> Any:  # noqa: ANN401
    """A dataclass from JSON, refusing missing fields; unknown ones are left for later versions."""
    if not isinstance(data, dict):
        raise ManifestError(f"{where}: expected an object, found {type(data).__name__}")
    names = [field.name for field in fields(cls)]
    missing = [name for name in names if name not in data]
    if missing:
        raise ManifestError(f"{where}: expected field {missing[0]!r}, found none")
    return cls(**{name: _frozen(data[name]) for name in names})


def _frozen(value: object) -> object:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


def read_manifest(path: Path) -> Manifest:
    """Read and validate.

    Raises:
        ManifestError: No file, broken JSON, another format, a missing or contradictory field.
    """
    try:
        data = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ManifestError(f"{path}: expected a manifest, found no file") from error
    except (OSError, ValueError) as error:
        raise ManifestError(f"{path}: expected JSON, found {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise ManifestError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    data.setdefault("statistics", {})
    for name, cls in (("shards", Shard), ("instances", Instance), ("joints", JointSpec)):
        rows = data.get(name)
        if not isinstance(rows, list):
            raise ManifestError(f"{path}: {name}: expected a list, found {type(rows).__name__}")
        data[name] = [_record(cls, row, f"{path}: {name}[{i}]") for i, row in enumerate(rows)]
    manifest: Manifest = _record(Manifest, data, str(path))
    _check(path, manifest)
    return manifest


def _check(path: Path, manifest: Manifest) -> None:
    first = 0
    for shard in manifest.shards:
        if shard.first != first or shard.count < 1:
            raise ManifestError(
                f"{path}: shard {shard.file}: expected first {first} and a count "
                f"of 1 or more, found {shard.first} and {shard.count}"
            )
        if Path(shard.file).name != shard.file:
            raise ManifestError(
                f"{path}: expected a shard name without folders, found {shard.file!r}"
            )
        first += shard.count
    if first != manifest.count:
        raise ManifestError(f"{path}: expected count {manifest.count}, found {first} in shards")
    if len(manifest.parts) != len(manifest.joints) + 1:
        raise ManifestError(
            f"{path}: expected one joint less than parts, found "
            f"{len(manifest.parts)} parts and {len(manifest.joints)} joints"
        )
    found = shards_digest(manifest.shards)
    if found != manifest.digest:
        raise ManifestError(
            f"{path}: expected digest {found} of the shards, found {manifest.digest}"
        )
