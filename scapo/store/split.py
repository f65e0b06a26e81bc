# SPDX-License-Identifier: MIT
"""Samples, predictions and checkpoints on disk; what is read is validated here.

Layout: `DIR/<category>/<split>/manifest.json` and shards beside it (docs/data-format.md). One file
is written and read by `write` and `read` (of `files`), a split through `open_split` and `dataset`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np

from scapo.store.files import (
    SAMPLES,
    Arrays,
    Header,
    read,
    require,
    sha256_file,
)
from scapo.store.json_records import parse_json
from scapo.store.manifest import Manifest, read_manifest
from scapo.store.regular import is_odd, read_regular
from scapo.store.schema import LAYOUT, StoreError, check_samples, sample_shapes
from scapo.text import one_line


class Split:
    """One split of one category on disk, read shard by shard."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest of `folder`.

        Raises:
            StoreError: There is no manifest there, or it is not valid.
        """
        self.folder = folder
        self.manifest: Manifest = read_manifest(folder / "manifest.json")

    def shards(self, names: tuple[str, ...] | None = None) -> Iterator[Arrays]:
        """Arrays of each shard in order, checked against the manifest and the layout.

        Raises:
            StoreError: A shard is missing, of another split, size or shape, or holds values that
                cannot be, such as an axis that is no unit vector.
        """
        for shard in self.manifest.shards:
            path = self.folder / shard.file
            arrays, header = read(path, SAMPLES, names)
            self.check_header(path, header)
            check_samples(path, arrays, self.manifest, shard.first, shard.count)
            check_bytes(path, shard.sha256)
            yield arrays

    def arrays(self, *names: str) -> Arrays:
        """The named tensors of the whole split, in memory."""
        shapes = self.shapes(0)
        parts: list[Arrays] = (
            [{name: np.zeros(shapes[name], LAYOUT[name][0]) for name in names if name in shapes}]
            if not self.manifest.shards
            else []
        )
        for shard, arrays in zip(self.manifest.shards, self.shards(names), strict=True):
            require(self.folder / shard.file, names, arrays)
            parts.append(arrays)
        return {name: np.concatenate([part[name] for part in parts]) for name in names}

    def shapes(self, count: int) -> dict[str, tuple[int, ...]]:
        """Expected shape of each sample tensor for `count` samples (docs/data-format.md)."""
        return sample_shapes(self.manifest, count)

    def check_header(self, path: Path, header: Header) -> None:
        """Refuse a shard that says it belongs to another category or split.

        Raises:
            StoreError: Naming file, field, expected and found value.
        """
        for field in ("category", "split"):
            want = getattr(self.manifest, field)
            if header.get(field, want) != want:
                raise StoreError(f"{path}: {field}: expected {want!r}, found {header[field]!r}")

    def verify(self) -> None:
        """Compare every shard's bytes with the manifest.

        Raises:
            StoreError: A shard is missing or its SHA-256 differs.
        """
        for shard in self.manifest.shards:
            path = self.folder / shard.file
            if not path.is_file():
                raise StoreError(f"{path}: expected a shard of the manifest, found none")
            check_bytes(path, shard.sha256, again=True)


_CHECKED: set[tuple[Path, str, int, int]] = set()
"""Path, SHA-256, length and time of change of the shards that this process has compared."""


def check_bytes(path: Path, sha256: str, *, again: bool = False) -> None:
    """Compare a shard's bytes with the manifest, once in a process unless the file was changed.

    Args:
        path: Of the shard.
        sha256: By the manifest.
        again: Also where it was compared before.

    Raises:
        StoreError: They differ.
    """
    state = path.stat()
    key = (path.absolute(), sha256, state.st_size, state.st_mtime_ns)
    if key in _CHECKED and not again:
        return
    found = sha256_file(path)
    if found != sha256:
        raise StoreError(f"{path}: expected sha256 {sha256}, found {found}")
    _CHECKED.add(key)


def find_split(folder: Path | str, category: str | None, split: str) -> Path:
    """The split's folder below `folder`, which may be the data set, the category or the split.

    Looked for in this order: `folder` itself, `folder/split`, `folder/category/split`, and
    `folder/*/category/split` (a benchmark adds its name above the category).

    Raises:
        StoreError: Nothing there, or more than one.
    """
    folder = Path(folder)
    if not folder.is_dir():
        made = f"none; `scapo-data generate {category or 'CATEGORY'} --out {folder}` makes one"
        found = "a file" if folder.exists() else made
        raise StoreError(f"{folder}: expected a folder of samples, found {found}")

    def named(top: Path) -> list[Path]:
        return [top / category] if category else _folders(top)

    places = ([folder], [folder / split], [path / split for path in named(folder)])
    deep = (path / split for top in _folders(folder) for path in named(top))
    wanted = f"{category or '*'}/{split}"
    for paths in (*places, deep):
        found = [path for path in paths if _is_split(path, category, split)]
        if len(found) > 1:
            names = ", ".join(str(path.relative_to(folder)) for path in found)
            raise StoreError(f"{folder}: expected one {wanted}, found {names}")
        if found:
            return found[0]
    there = [path for depth in range(4) for path in folder.glob("*/" * depth + "manifest.json")]
    names = ", ".join(sorted(str(path.parent.relative_to(folder)) for path in there)[:20])
    command = f"scapo-data generate {category or 'CATEGORY'} --split {split} --out {folder}"
    raise StoreError(
        f"{folder}: expected {wanted}/manifest.json, found {names or 'none'}; `{command}` makes one"
    )


def _folders(path: Path) -> list[Path]:
    with suppress(OSError):
        return sorted(child for child in path.iterdir() if child.is_dir())
    return []


def _is_split(folder: Path, category: str | None, split: str) -> bool:
    path = folder / "manifest.json"
    if is_odd(path):
        return folder.name == split  # so that opening it says what is wrong
    if not path.exists():
        return False
    try:
        data: object = parse_json(read_regular(path))
    except (OSError, ValueError, RecursionError):
        return folder.name == split
    if not isinstance(data, dict):
        return folder.name == split
    fields = cast("dict[str, object]", data)
    return fields.get("split") == split and category in (None, fields.get("category"))


def open_split(folder: Path | str, category: str | None = None, split: str = "train") -> Split:
    """Find and open a split; see `find_split`."""
    return Split(find_split(Path(folder), category, split))


PARTS = ("clean", "complete", "isolated", "sensor", "real")
"""Folders above the categories that say what the data are."""
PROTOCOLS = {"full": "complete", "isolated": "isolated"}
"""How the clouds were taken -> the part that such data belong to."""


def data_name(folder: Path, split: Split) -> str:
    """`NAME@DIGEST`: what the data are called, and the first 12 digits of their digest.

    NAME is the manifest's option `benchmark`, else the folder above the category where that is
    part of the data set or of the benchmark (`PARTS`), else `complete` for whole surfaces,
    `isolated` for parts rendered alone, `sensor` for data with sensor noise, `clean` without.
    """
    manifest, root = split.manifest, folder.resolve()
    named = manifest.options.get("benchmark")
    above = split.folder.resolve().parent.parent
    inside = above != root and above.is_relative_to(root)
    if isinstance(named, str) and named:
        name = one_line(named, 100)
    elif inside or above.name in PARTS:
        name = above.name
    elif (protocol := str(manifest.options.get("protocol"))) in PROTOCOLS:
        name = PROTOCOLS[protocol]
    else:
        noisy = manifest.options.get("noise", "none") != "none"
        name = "sensor" if noisy else "clean"
    return f"{name}@{manifest.digest[:12]}"
