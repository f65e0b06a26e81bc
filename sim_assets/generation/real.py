# SPDX-License-Identifier: MIT
"""A user's folder of models for the benchmark's part `real`: which category each belongs to.

Asked in this order, the first that names a kind of object that we know wins: an `index.csv` at the
top of the folder (columns `category`, `id`), PartNet-Mobility's `meta.json`, the bodies that the
model's semantics name, the names of the folders, the robot's name in the URDF. Kinds that open like
one of the nine categories are shown as that category (`KINDS`).
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scapo.parallel.pool import AbstractPool
from scapo.store.json_records import parse_json
from scapo.store.regular import read_regular
from sim_assets.generation.assets import UrdfAsset
from sim_assets.generation.plan import Entry
from sim_assets.generation.shard import describe
from sim_assets.models.joints import words
from sim_assets.models.library import find, instance_id, source_root
from sim_assets.models.limits import CLOCK_SECONDS
from sim_assets.models.validate import MAX_URDF_BYTES, refuse

INDEX = "index.csv"
KINDS: dict[str, tuple[str, ...]] = {
    "laptop": ("laptop", "notebook"),
    "safe": ("safe", "microwave", "refrigerator", "fridge", "freezer"),
    "oven": ("oven", "dishwasher", "stove"),
    "washer": ("washer", "washing", "washingmachine", "dryer"),
    "eyeglasses": ("eyeglasse", "glasse", "spectacle"),
    "basket": ("basket",),
    "drawer": ("drawer", "storage", "storagefurniture", "furniture", "cabinet", "nightstand"),
    "suitcase": ("suitcase", "luggage"),
    "scissors": ("scissor",),
}
"""Words (as `words` gives them) of the kinds that are shown as a category: a box whose door turns
about an upright edge is a safe, one whose door falls open about its lower edge an oven, furniture
with a drawer a drawer. Boxes with flaps, staplers, buckets, taps and carts are none of the nine."""
MAX_BYTES = 4 << 20
"""Of the beginning of a file, which is asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RealModels:
    """The models of a folder."""

    root: Path
    models: Mapping[str, Sequence[UrdfAsset]]
    """Category -> its models; in the order of our list."""
    others: Mapping[str, str] = field(default_factory=dict)
    """Instance id -> why it belongs to no category."""


def real_models(path: Path) -> RealModels:
    """Every model of a folder by the category that it belongs to.

    Raises:
        AssetError: There is no such folder, or no URDF in it, or its index is no table.
    """
    root = source_root(path)
    listed = _index(root)
    found: dict[str, list[UrdfAsset]] = {name: [] for name in KINDS}
    others: dict[str, str] = {}
    for urdf in find(path):
        said = list(_said(urdf, root, listed))
        category = next((name for text in said if (name := category_of(text))), None)
        if category is None:
            texts = ", ".join(repr(text) for text in dict.fromkeys(said) if text)
            others[instance_id(urdf, root)] = f"expected one of {', '.join(KINDS)}, found {texts}"
        else:
            asset = UrdfAsset(urdf=urdf, root=root, category=category, any_model=True)
            found[category].append(asset)
    models = {name: assets for name, assets in found.items() if assets}
    return RealModels(root=root, models=models, others=others)


def category_of(text: str) -> str | None:
    """The category that a kind of object is shown as.

    >>> category_of("Refrigerator"), category_of("oven_body"), category_of("Stapler")
    ('safe', 'oven', None)
    """
    found = words(text)
    return next((name for name, kinds in KINDS.items() if found & set(kinds)), None)


def readable(
    models: Sequence[UrdfAsset], pool: AbstractPool[UrdfAsset, Entry]
) -> tuple[list[UrdfAsset], dict[str, str]]:
    """The models that can be read, and why the others cannot: each in a worker of its own.

    Raises:
        ValueError: None can.
    """
    done = pool.run(describe, models, within=CLOCK_SECONDS)
    outcomes = {outcome.job.name: outcome for outcome in done}
    refused = {
        model.name: outcomes[model.name].reason
        for model in models
        if outcomes[model.name].result is None
    }
    good = [model for model in models if model.name not in refused]
    if not good:
        why = "; ".join(refused.values())
        raise ValueError(f"{models[0].category}: expected real models that can be read: {why}")
    return good, refused


def _said(urdf: Path, root: Path, listed: Mapping[tuple[str, ...], str]) -> Iterator[str]:
    """What is said of the kind of a model, the surest first."""
    folders = urdf.resolve().relative_to(root.resolve()).parts[:-1]
    yield listed.get(folders[:2], "")
    yield _meta(urdf.parent / "meta.json")
    rows = [line.split(maxsplit=2) for line in _text(urdf.parent / "semantics.txt").splitlines()]
    moving = ("hinge", "slider")
    yield " ".join(row[2] for row in rows if len(row) == 3 and row[1] not in moving)
    yield " ".join(folders) or root.resolve().name
    tag = _text(urdf).partition("<robot")[2].partition(">")[0]
    named = re.search(r"\bname\s*=\s*[\"']([^\"']*)", tag)
    yield named[1] if named else ""


def _index(root: Path) -> dict[tuple[str, ...], str]:
    """(folder, id) -> category, of an index beside the models; empty where there is none."""
    try:
        rows = list(csv.DictReader(_text(root / INDEX).splitlines()))
    except csv.Error as error:
        raise refuse(root / INDEX, "a table with category and id", str(error)) from error
    return {
        (row["category"], row["id"]): row["category"]
        for row in rows
        if row.get("category") and row.get("id")
    }


def _meta(path: Path) -> str:
    try:
        data = parse_json(_text(path) or "{}")
    except (ValueError, RecursionError):
        return ""
    return str(data.get("model_cat", "")) if isinstance(data, dict) else ""


def _text(path: Path) -> str:
    """The beginning of a file; nothing where it cannot be read."""
    try:
        return read_regular(path, MAX_URDF_BYTES)[:MAX_BYTES].decode("utf-8-sig", "replace")
    except OSError:
        return ""
