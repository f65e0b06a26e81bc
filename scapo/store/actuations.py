# SPDX-License-Identifier: MIT
"""What came of pulling at predicted joints: one CSV row per sample and joint (docs/actuate.md)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from scapo.store.files import write_bytes
from scapo.store.json_records import from_json
from scapo.store.regular import read_regular
from scapo.store.schema import StoreError
from scapo.text import as_cell, csv_text, from_cell
from scapo.types import Supervision

Towards = Literal["open", "closed", ""]
Unit = Literal["deg", "m"]
MAX_TEXT = 1 << 26
"""Bytes of a file; a row has about 150."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuation:
    """One joint of one sample; what could not be measured is None, an empty cell."""

    method: str
    variant: str
    seed: int
    supervision: str
    """Labels that training used, with spaces between."""
    data: str
    """NAME@DIGEST, as in scores."""
    category: str
    split: str
    sample: int
    instance: int
    joint: int
    """Of the truth."""
    success: bool | None
    """None: it could not be tried."""
    towards: Towards
    """Where it was pulled; empty if it was not."""
    moved: float | None
    """Farthest, in `unit`, the way it was pulled."""
    needed: float | None
    """Of it for a success."""
    travel: float | None
    """Left on that side."""
    unit: Unit
    off_path_mean: float | None
    """N, of the force across the true path."""
    off_path_peak: float | None
    reason: str
    """Why it did not open, or was not tried."""


COLUMNS = tuple(field.name for field in fields(Actuation))
_WHOLE = ("seed", "sample", "instance", "joint")
_NUMBERS = ("moved", "needed", "travel", "off_path_mean", "off_path_peak")


def write_actuations(path: Path, rows: Sequence[Actuation]) -> None:
    """Write the file atomically; the same rows give the same bytes."""
    cells = (map(_cell, asdict(row).values()) for row in rows)
    write_bytes(path, csv_text(COLUMNS, cells).encode())


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return f"{value:.6g}"
    return as_cell(str(value))


def is_actuations(path: Path) -> bool:
    """Whether a file begins with the columns of actuations."""
    head = ",".join(COLUMNS).encode()
    with path.open("rb") as file:
        return file.read(len(head)) == head


def read_actuations(path: Path) -> list[Actuation]:
    """The rows of a file.

    Raises:
        StoreError: Not a file of actuations, or a cell is not what it should be.
    """
    try:
        text = read_regular(path, MAX_TEXT).decode()
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: expected CSV of actuations, found {error}") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        table = list(reader)
    except csv.Error as error:
        raise StoreError(f"{path}: expected CSV of actuations, found {error}") from error
    if not table or tuple(table[0]) != COLUMNS:
        raise StoreError(f"{path}: expected the columns {', '.join(COLUMNS)}, found others")
    rows = [_row(cells, f"{path}: line {line}") for line, cells in enumerate(table[1:], 2)]
    if not rows:
        raise StoreError(f"{path}: expected a row for each sample, found none")
    return rows


def _row(cells: list[str], where: str) -> Actuation:
    if len(cells) != len(COLUMNS):
        raise StoreError(f"{where}: expected {len(COLUMNS)} cells, found {len(cells)}")
    record: dict[str, Any] = dict(zip(COLUMNS, map(from_cell, cells), strict=True))
    try:
        record |= {name: int(record[name]) for name in _WHOLE}
        record |= {name: float(record[name]) if record[name] else None for name in _NUMBERS}
        record["success"] = {"": None, "0": False, "1": True}[record["success"]]
    except (ValueError, KeyError) as error:
        raise StoreError(
            f"{where}: expected numbers, and success 0, 1 or empty: {error}"
        ) from error
    unknown = set(record["supervision"].split()) - set(get_args(Supervision))
    if unknown:
        raise StoreError(
            f"{where}: supervision: expected known labels, found {sorted(unknown)[0]!r}"
        )
    return from_json(Actuation, record, where)
