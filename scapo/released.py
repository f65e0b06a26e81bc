# SPDX-License-Identifier: MIT
"""The models that come with the package, by name: `oven`, `oven/scapo`. Light to import."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from scapo.categories import CATEGORIES
from scapo.store.schema import StoreError
from scapo.text import did_you_mean

RELEASED = "weights"
"""Folder in the package with the released checkpoints: CATEGORY.safetensors of the method that
answers by default, CATEGORY-NAME.safetensors of others."""
CHECKOUT = Path("results", "checkpoints")
"""The same folder in a checkout, from which the package's is made."""


def find(path_or_category: str | Path) -> Path:
    """The checkpoint's path.

    A folder without one, such as a category's clouds, hides no released model of its name.

    Raises:
        StoreError: Nothing of that name.
    """
    path, there = Path(path_or_category), weights()
    named = there.get(str(path_or_category))
    if path.exists() and (named is None or path.is_file() or any(path.glob("*.safetensors"))):
        return path
    if named is not None:
        return named
    known = ", ".join(there) or "none yet"
    raise StoreError(
        f"{path_or_category}: expected a run folder, a checkpoint or a category with released "
        f"weights ({known}), found none{did_you_mean(str(path_or_category), there)}"
    )


def released() -> dict[str, Path]:
    """Checkpoints that come with the package, by category: each of its default method."""
    return {name: path for name, path in weights().items() if name in CATEGORIES}


def weights() -> dict[str, Path]:
    """Every checkpoint that comes with the package or the checkout, by the name to load it by."""
    package = Path(str(files("scapo")))
    folders = (package / RELEASED, package.parent / CHECKOUT)
    found = [path for folder in folders for path in sorted(folder.glob("*.safetensors"))]
    named = {path.stem.replace("-", "/", 1): path for path in found}
    return {name: path for name, path in named.items() if name.partition("/")[0] in CATEGORIES}
