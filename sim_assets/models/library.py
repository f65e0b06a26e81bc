# SPDX-License-Identifier: MIT
"""A folder of models: its URDFs, their instance ids, and which split each belongs to."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from sim_assets.models.validate import refuse

SPLITS = ("train", "val", "test")
SHARES = {"train": 0.7, "val": 0.1, "test": 0.2}
"""By hash of the instance id, where the source has no splits of its own."""
FEW = 10
"""Fewer models than this are not divided."""
MAX_ID = 240
"""Characters of an instance id: with an ending it still is the name of a file."""
INNER = ("urdf", "urdfs", "robots")
"""Folders in which a package keeps its URDFs, the meshes beside them."""
PREFERRED = ("mobility.urdf", "model.urdf", "robot.urdf")
VARIANT = re.compile(
    r"[_-](cvx|vhacd|convex|collision|fixed|static|repo|relabel|simple|simplified|orig|original"
    r"|backup|new|old)$",
    re.IGNORECASE,
)
"""Endings of file names that mark another version of the same model."""


def find(path: Path) -> list[Path]:
    """The URDFs of a folder, recursively, one per model, in a stable order.

    In a folder with several URDFs `mobility.urdf` (or `model.urdf`, `robot.urdf`) stands for the
    model, and the others count as its variants. Else names that end like a variant (`_cvx`,
    `_fixed`, `_repo`, ...) go where the plain name is there too, and each other file is a model.
    Links to folders are not followed.

    Args:
        path: A folder, or one `.urdf` file.

    Raises:
        AssetError: No such path, or no URDF in it.
    """
    if path.is_file() and path.suffix.lower() == ".urdf":
        return [path]
    if not path.is_dir():
        raise refuse(path, "a folder or a .urdf file", "a file" if path.exists() else "nothing")
    found = [urdf for folder, names in _folders(path) for urdf in _models(folder, names)]
    if not found:
        raise refuse(path, "URDF files in the folder", "none")
    return sorted(found, key=lambda urdf: urdf.relative_to(path).parts)


def source_root(source: Path) -> Path:
    """The folder that holds all files of a source: below it meshes are found and ids are made.

    Args:
        source: A folder of models, or one `.urdf` file.

    Returns:
        The folder, or that of the file; of a package's own folder of URDFs, the package.
    """
    folder = source if source.is_dir() else source.parent
    full = folder.resolve()
    return full.parent if full.name in INNER and _siblings(full) else folder


def _folders(path: Path) -> Iterator[tuple[Path, list[str]]]:
    for folder, below, names in os.walk(path):
        below[:] = sorted(name for name in below if not name.startswith("."))
        urdfs = [n for n in sorted(names) if n.lower().endswith(".urdf") and n[0] != "."]
        if urdfs:
            yield Path(folder), urdfs


def _models(folder: Path, names: list[str]) -> list[Path]:
    for preferred in PREFERRED:
        if preferred in names:
            return [folder / preferred]
    stems = {Path(name).stem for name in names}
    plain = [
        name
        for name in names
        if VARIANT.sub("", Path(name).stem) not in stems or not VARIANT.search(Path(name).stem)
    ]
    return [folder / name for name in plain]


def instance_id(urdf: Path, root: Path) -> str:
    """The model's folder relative to the source folder, as one safe word.

    Where the file's name tells models apart (several in one folder) it is added. A word that
    had to be changed or cut, and so might be another's too, ends in a hash of the original. The
    folder is that in which the file's name stands, be it a link.
    """
    folder = urdf.parent.resolve()
    relative = folder.relative_to(root.resolve())
    pieces = list(relative.parts) or [folder.name]
    if len(pieces) == 1 and folder.name in INNER:  # says nothing: the package's name
        pieces = [folder.parent.name]
    if len(_models(folder, _siblings(folder))) > 1:
        pieces.append(urdf.stem)
    word = "-".join(pieces)
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", word).strip(".") or "model"
    doubtful = safe != word or (len(pieces) > 1 and any("-" in piece for piece in pieces))
    if doubtful or len(safe) > MAX_ID:
        mark = hashlib.sha256(os.fsencode("/".join(pieces))).hexdigest()[:8]
        safe = f"{safe[:80]}-{mark}"
    return safe


def _siblings(folder: Path) -> list[str]:
    names = (p.name for p in folder.iterdir() if p.suffix.lower() == ".urdf")
    return sorted(name for name in names if name[0] != ".")


def select(paths: Sequence[Path], split: str, root: Path) -> list[Path]:
    """The models of a split.

    A source with folders `train`, `val` or `test` keeps its own division; fewer than ten models
    all belong to the split asked for; else a hash of the instance id decides (70, 10, 20 %).

    Args:
        paths: From `find`.
        split: "train", "val" or "test".
        root: The source folder.

    Raises:
        AssetError: No model is in the split.
    """
    own = {path: _own_split(path, root) for path in paths}
    if any(own.values()):
        chosen = [path for path in paths if own[path] == split]
    elif len(paths) < FEW:
        chosen = list(paths)
    else:
        chosen = [path for path in paths if hash_split(instance_id(path, root)) == split]
    if not chosen:
        raise refuse(root, f"a model in the split {split!r}", f"none of {len(paths)}")
    return chosen


def undivided(source: Path) -> int:
    """How many models a source has, if all of them are in every split; else 0."""
    root, paths = source_root(source), find(source)
    whole = len(paths) < FEW and not any(_own_split(path, root) for path in paths)
    return len(paths) if whole else 0


def _own_split(path: Path, root: Path) -> str | None:
    parts = path.parent.resolve().relative_to(root.resolve()).parts
    return next((part for part in parts if part in SPLITS), None)


def hash_split(instance: str) -> str:
    """The split of an instance, the same on every machine and whatever else is in the set."""
    digest = hashlib.sha256(instance.encode()).digest()
    share = int.from_bytes(digest[:8], "big") / 2**64
    if share < SHARES["train"]:
        return "train"
    return "val" if share < SHARES["train"] + SHARES["val"] else "test"
