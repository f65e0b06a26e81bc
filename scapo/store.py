# SPDX-License-Identifier: MIT
"""Samples, predictions and checkpoints on disk, and the only place where they are validated.

Every file is safetensors with ONE metadata entry, `scapo`, holding sorted JSON: several entries
are written in random order, which would break byte identity. Files appear under their final name
only when complete. Layout: `DIR/<category>/<split>/manifest.json` and shards beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from scapo.manifest import Manifest, ManifestError, read_manifest

if TYPE_CHECKING:
    from scapo.data import SampleDataset

SAMPLES = "scapo-samples/1"
PREDICTIONS = "scapo-predictions/1"
CHECKPOINT = "scapo-checkpoint/1"


@runtime_checkable
class Shaped(Protocol):
    """Anything with a shape: numpy or torch."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the dimensions."""
        ...


Arrays = dict[str, np.ndarray]
Header = dict[str, Any]


class StoreError(ValueError):
    """A file is not what it should be: `path: what was expected, what was found`."""


def canonical_json(value: object) -> str:
    """Sorted, compact JSON: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_bytes(data: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's bytes in hex, read in pieces."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def write_bytes(path: Path, data: bytes) -> None:
    """Write through a temporary name in the same folder, flushed to disk before the rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def write(path: Path, arrays: Mapping[str, np.ndarray], header: Header) -> str:
    """Write arrays and header atomically; the same input gives the same bytes.

    Returns:
        The SHA-256 of the file.
    """
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    data = save(contiguous, metadata={"scapo": canonical_json(header)})
    write_bytes(path, data)
    return sha256_bytes(data)


def _open(path: Path) -> Any:  # noqa: ANN401 - safetensors ships no types
    return safe_open(path, "numpy")


def read_header(path: Path, expected: str | None = None) -> Header:
    """The header alone.

    Args:
        path: A safetensors file.
        expected: The header's `format`, None for any.

    Raises:
        StoreError: No such file, not safetensors, no `scapo` entry, or another format.
    """
    if not path.is_file():
        raise StoreError(f"{path}: expected a file, found none")
    try:
        with _open(path) as file:
            metadata: dict[str, str] = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise StoreError(f"{path}: expected a safetensors file, found {error}") from error
    if "scapo" not in metadata:
        raise StoreError(
            f"{path}: expected the metadata entry 'scapo', found {sorted(metadata) or 'none'}"
        )
    try:
        header: Header = json.loads(metadata["scapo"])
    except json.JSONDecodeError as error:
        raise StoreError(f"{path}: expected JSON in the header, found {error}") from error
    if not isinstance(header, dict):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise StoreError(f"{path}: expected a JSON object, found {type(header).__name__}")
    if expected is not None and header.get("format") != expected:
        raise StoreError(f"{path}: expected format {expected!r}, found {header.get('format')!r}")
    return header


def read(
    path: Path, expected: str | None = None, names: tuple[str, ...] | None = None
) -> tuple[Arrays, Header]:
    """Arrays (all, or those of `names` that are there) and header.

    Raises:
        StoreError: As `read_header`, or a tensor cannot be read as numpy.
    """
    header = read_header(path, expected)
    arrays: Arrays = {}
    try:
        with _open(path) as file:
            for name in file.keys():  # noqa: SIM118 - the file is no mapping
                if names is None or name in names:
                    arrays[name] = file.get_tensor(name)
    except (SafetensorError, TypeError, OSError) as error:
        raise StoreError(f"{path}: expected numpy-readable tensors, found {error}") from error
    return arrays, header


class Split:
    """One split of one category on disk, read shard by shard."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest of `folder`.

        Raises:
            StoreError: There is no manifest there, or it is not valid.
        """
        self.folder = folder
        try:
            self.manifest: Manifest = read_manifest(folder / "manifest.json")
        except ManifestError as error:
            raise StoreError(str(error)) from error

    def shards(self, names: tuple[str, ...] | None = None) -> Iterator[Arrays]:
        """Arrays of each shard in order, shapes checked against the manifest.

        Raises:
            StoreError: A shard is missing, of another size or shape.
        """
        for shard in self.manifest.shards:
            path = self.folder / shard.file
            arrays, _ = read(path, SAMPLES, names)
            for name, array in arrays.items():
                check_shape(path, name, array, self.shapes(shard.count).get(name))
            yield arrays

    def arrays(self, *names: str) -> Arrays:
        """The named tensors of the whole split, in memory."""
        parts = list(self.shards(names))
        missing = [name for name in names if any(name not in part for part in parts)]
        if missing:
            raise StoreError(f"{self.folder}: expected tensor {missing[0]!r}, found none")
        return {name: np.concatenate([part[name] for part in parts]) for name in names}

    def shapes(self, count: int) -> dict[str, tuple[int, ...]]:
        """Expected shape of each sample tensor for `count` samples (CONTRACT 3)."""
        n, p, j = self.manifest.points, len(self.manifest.parts), len(self.manifest.joints)
        return {
            "points": (count, n, 3),
            "color": (count, n, 3),
            "part": (count, n),
            "camera_T_part": (count, p, 4, 4),
            "joint_pivot": (count, j, 3),
            "joint_axis": (count, j, 3),
            "joint_state": (count, j),
            "visible": (count, p),
            "camera": (count, 6),
            "instance": (count,),
        }

    def verify(self) -> None:
        """Compare every shard's bytes with the manifest.

        Raises:
            StoreError: A shard is missing or its SHA-256 differs.
        """
        for shard in self.manifest.shards:
            path = self.folder / shard.file
            if not path.is_file():
                raise StoreError(f"{path}: expected a shard of the manifest, found none")
            found = sha256_file(path)
            if found != shard.sha256:
                raise StoreError(f"{path}: expected sha256 {shard.sha256}, found {found}")


def check_shape(
    path: Path, name: str, array: Shaped, expected: tuple[int | None, ...] | None
) -> None:
    """Refuse an array of another shape; None matches any length.

    Raises:
        StoreError: Naming file, tensor, expected and found shape.
    """
    if expected is None:
        return
    fits = len(expected) == len(array.shape) and all(
        want in (None, have) for want, have in zip(expected, array.shape, strict=True)
    )
    if not fits:
        shape = tuple("*" if want is None else want for want in expected)
        raise StoreError(
            f"{path}: tensor {name!r}: expected shape {shape}, found {tuple(array.shape)}"
        )


def find_split(folder: Path, category: str | None, split: str) -> Path:
    """The split's folder below `folder`, which may be the data set, the category or the split.

    Looked for in this order: `folder` itself, `folder/split`, `folder/category/split`, and
    `folder/*/category/split` (a benchmark adds its name above the category).

    Raises:
        StoreError: Nothing there, or more than one.
    """
    name = category or "*"
    for pattern in (".", split, f"{name}/{split}", f"*/{name}/{split}"):
        found = [folder] if pattern == "." else sorted(folder.glob(pattern))
        found = [path for path in found if _is_split(path, category, split)]
        if len(found) > 1:
            raise StoreError(
                f"{folder}: expected one {name}/{split}, found "
                + ", ".join(str(path.relative_to(folder)) for path in found)
            )
        if found:
            return found[0]
    raise StoreError(f"{folder}: expected {name}/{split}/manifest.json, found none")


def _is_split(folder: Path, category: str | None, split: str) -> bool:
    path = folder / "manifest.json"
    if not path.is_file():
        return False
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError):
        return folder.name == split
    return data.get("split") == split and category in (None, data.get("category"))


def open_split(folder: Path | str, category: str | None = None, split: str = "train") -> Split:
    """Find and open a split; see `find_split`."""
    return Split(find_split(Path(folder), category, split))


def dataset(folder: Path | str, category: str | None = None, split: str = "train") -> SampleDataset:
    """A `torch.utils.data.Dataset` over a folder; see `scapo.data.SampleDataset`."""
    from scapo.data import dataset as build  # data reads through this module

    return build(folder, category, split)
