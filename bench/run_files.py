# SPDX-License-Identifier: MIT
"""What a training leaves beside its checkpoint: the log of its losses and the time it took."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from scapo.store.json_records import StoreError, from_json, parse_json, read_json
from scapo.store.regular import read_regular
from scapo.training.run_folder import TIMING

__all__ = ["METRICS", "TIMING", "Timing", "read_metrics", "read_timing"]

METRICS = "metrics.jsonl"
LARGEST = 10**18
"""Of steps and losses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """What `timing.json` says."""

    seconds: float
    samples_per_second: dict[str, float]
    """Of each stage, its last epoch."""
    stage_seconds: dict[str, float]
    memory: int = 0
    """Bytes of the process at its peak; 0 where that is not known."""


def read_timing(run: Path) -> Timing:
    """The time that a run took.

    Raises:
        StoreError: No such file, or a field is missing or not what it should be.
    """
    return from_json(Timing, read_json(run / TIMING), str(run / TIMING))


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a `metrics.jsonl`: step, stage and losses; none where there is no such file.

    Raises:
        StoreError: Naming the line that is none.
    """
    if not path.exists():
        return []
    try:
        lines = read_regular(path).decode().splitlines()
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: expected lines of JSON, found {error}") from error
    return [_row(line, f"{path}: line {number}") for number, line in enumerate(lines, 1)]


def _row(line: str, where: str) -> dict[str, Any]:
    try:
        value = parse_json(line)
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{where}: expected JSON, found {error}") from error
    row = cast("dict[str, Any]", value if isinstance(value, dict) else {})
    step = row.get("step")
    if type(step) is not int or abs(step) > LARGEST or type(row.get("stage")) is not str:
        raise StoreError(f"{where}: expected an object with a whole 'step' and a 'stage' in text")
    for name, loss in row.items():
        if name.startswith("loss") and not (type(loss) in (int, float) and abs(loss) < LARGEST):
            raise StoreError(f"{where}: {name}: expected a finite number, found {loss!r}")
    return row
