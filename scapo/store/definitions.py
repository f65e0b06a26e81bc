# SPDX-License-Identifier: MIT
"""Categories that the package has not: from a TOML file, and in headers of what is made of them.

A data set, a run and a predictions file of such a category carry its definition, so that only the
command that makes data needs the file (docs/categories.md). The package's own have none: their
name says all.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any, cast, get_args

from scapo.categories import CATEGORIES, Category, JointKind, Window, check_category
from scapo.store.json_records import StoreError, from_json
from scapo.store.manifest import Manifest
from scapo.store.regular import read_regular

tomllib = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

DEFINITION = "definition"
"""The field of headers, and of a manifest's options."""
MAX_TOML = 1 << 20
"""Bytes of a file of categories."""
ANYWHERE = Window(azimuth=(-180.0, 180.0), elevation=(-90.0, 90.0))


def read_categories(path: Path) -> dict[str, Category]:
    """The categories of a TOML file, by name: one table each, whose keys are `Category`'s fields.

    A joint's `parent` is the base (0), its `child` the next part and its `lower` 0 unless said;
    `degrees` may stand for `upper`, which is in rad or m.

    Raises:
        StoreError: No such file, not TOML, a category that cannot be, or a name of the package's.
    """
    try:
        tables = tomllib.loads(read_regular(path, MAX_TOML).decode())
    except (OSError, ValueError, RecursionError) as error:
        found = {FileNotFoundError: "none", IsADirectoryError: "a folder"}.get(type(error), error)
        raise StoreError(f"{path}: expected categories in TOML, found {found}") from error
    if not tables:
        raise StoreError(f"{path}: expected a table for each category, found none")
    return {name: _read(name, table, f"{path}: {name}") for name, table in tables.items()}


def _read(name: str, table: object, where: str) -> Category:
    if isinstance(table, dict) and "benchmark" in table:
        raise StoreError(f"{where}: expected fields of Category but benchmark, found it")
    if name in CATEGORIES:
        raise StoreError(f"{where}: expected a name that the package has not, found one of its own")
    if not isinstance(table, dict):
        raise StoreError(f"{where}: expected a table [{name}], found {table!r:.100}")
    record = {**cast("dict[str, Any]", table), "name": name}
    joints = record.get("joints")
    if isinstance(joints, list):
        pairs = enumerate(cast("list[object]", joints))
        record["joints"] = [_joint(joint, j, where) for j, joint in pairs]
    found = _checked(from_json(Category, record, where, others="refuse"), where)
    if len({joint.kind for joint in found.joints}) > 1:
        raise StoreError(f"{where}: joints: expected all of one kind, found hinges and slides")
    return found


def _joint(joint: object, j: int, where: str) -> object:
    """With what goes without saying."""
    if not isinstance(joint, dict):
        return joint
    said = cast("dict[str, Any]", joint)
    known = {"kind", "parent", "child", "lower", "upper", "degrees"}
    if unknown := sorted(set(said) - known):
        raise StoreError(
            f"{where}: joints[{j}]: expected {', '.join(sorted(known))}, found {unknown[0]!r}"
        )
    kinds = get_args(JointKind)
    if said.get("kind", kinds[0]) not in kinds:
        raise StoreError(
            f"{where}: joints[{j}].kind: expected {' or '.join(kinds)}, found {said['kind']!r:.100}"
        )
    record = {"parent": 0, "child": j + 1, "lower": 0.0, **said}
    degrees = record.pop("degrees", None)
    if degrees is not None:
        if isinstance(degrees, bool) or not isinstance(degrees, int | float) or "upper" in said:
            raise StoreError(f"{where}: joints[{j}]: expected degrees, a number, or upper")
        if said.get("kind") != "revolute":
            raise StoreError(
                f"{where}: joints[{j}]: degrees: expected only of a revolute joint, found "
                f"{said.get('kind', 'none')}"
            )
        record["upper"] = math.radians(degrees)
    return record


def _checked(kind: Category, where: str) -> Category:
    try:
        check_category(kind)
    except ValueError as error:
        raise StoreError(f"{where}: {error}") from error
    return kind


def foreign(kind: Category) -> Category | None:
    """The category, if it is none of the package's."""
    return None if CATEGORIES.get(kind.name) == kind else kind


def definition(kind: Category) -> dict[str, Any]:
    """What a header says of a category: nothing of the package's own."""
    record = asdict(kind)
    del record["benchmark"]  # of ours alone
    return {} if foreign(kind) is None else {DEFINITION: record}


def defined(fields: Mapping[str, Any], name: str, where: str) -> Category | None:
    """The category that a header speaks of: as it defines it, or the package's of that name.

    Raises:
        StoreError: A definition that cannot be, or of another category.
    """
    record = fields.get(DEFINITION)
    if record is None:
        return CATEGORIES.get(name)
    # What was made here has tuples yet, what was read has lists.
    where = f"{where}: {DEFINITION}"
    found = _checked(from_json(Category, json.loads(json.dumps(record)), where), where)
    if found.name != name:
        raise StoreError(f"{where}: expected of {name!r}, found of {found.name!r}")
    return found


def known_category(manifest: Manifest) -> Category | None:
    """The category of a split, as it is defined there or in the package; None of others' data.

    Raises:
        StoreError: A definition that does not fit the manifest.
    """
    where = f"manifest of {manifest.category}/{manifest.split}"
    found = defined(manifest.options, manifest.category, where)
    if found is None:
        return None
    if DEFINITION in manifest.options and (found.parts, found.joints) != (
        manifest.parts,
        manifest.joints,
    ):
        raise StoreError(f"{where}: {DEFINITION}: expected its parts and joints, found others")
    return found


def category_of(manifest: Manifest) -> Category:
    """The category of a split; of one that nobody defines, the parts and joints of its manifest.

    Raises:
        StoreError: A definition that does not fit the manifest, or joints that no method knows.
    """
    found = known_category(manifest)
    if found is not None:
        return found
    made = Category(
        name=manifest.category,
        parts=manifest.parts,
        joints=manifest.joints,
        window=ANYWHERE,
        diagonal=1.0,
    )
    return _checked(made, f"manifest of {manifest.category}/{manifest.split}")
