# SPDX-License-Identifier: MIT
"""Scores on disk: gzipped CSV, one row per sample, metric, slot and unit, and JSON beside it."""

from __future__ import annotations

import csv
import gzip
import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Int

from bench.metrics import METRICS
from bench.scoring.scores import Errors
from scapo.store import StoreError, write_bytes

FORMAT = "scapo-scores/1"
SUFFIX = ".csv.gz"
COLUMNS = (
    "method", "variant", "seed", "data", "category", "split",
    "sample", "metric", "slot", "value", "unit",
)  # fmt: skip
_RANK = {metric.name: rank for rank, metric in enumerate(METRICS)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Which run the rows of a scores file belong to: their first six columns."""

    method: str
    variant: str
    seed: int
    data: str
    category: str
    split: str

    @property
    def row(self) -> str:
        """Those columns as CSV text."""
        buffer = io.StringIO()
        fields = (self.method, self.variant, self.seed, self.data, self.category, self.split)
        csv.writer(buffer, lineterminator="").writerow(fields)
        return buffer.getvalue()


def side_file(scores: Path) -> Path:
    """The JSON beside a scores file."""
    if not scores.name.endswith(SUFFIX) or scores.name == SUFFIX:
        raise StoreError(f"{scores}: expected a name that ends in {SUFFIX}, found {scores.name!r}")
    return scores.with_name(scores.name.removesuffix(SUFFIX) + ".json")


@contextmanager
def writing(path: Path) -> Iterator[gzip.GzipFile]:
    """A gzip stream without time or name in it, renamed to `path` when complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as raw:
            with gzip.GzipFile("", "wb", 6, raw, mtime=0) as stream:
                stream.write((",".join(COLUMNS) + "\n").encode())
                yield stream
            raw.flush()
            os.fsync(raw.fileno())
        temporary.replace(path)
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def write_rows(stream: gzip.GzipFile, run: Run, first: int, errors: Errors) -> None:
    """The rows of samples first, first+1, ...; undefined values are empty."""
    names = sorted(errors, key=lambda key: _RANK[key[0]])
    columns = [
        (name, slot, unit) for name, unit in names for slot in range(errors[name, unit].shape[1])
    ]
    table = np.concatenate([errors[key] for key in names], 1)
    before = [f",{name},{slot}," for name, slot, _ in columns]
    after = [f",{unit}\n" for _, _, unit in columns]
    head = run.row
    lines: list[str] = []
    for index, values in enumerate(table.tolist(), first):
        start = f"{head},{index}"
        lines.extend(
            f"{start}{b}{'' if v != v else format(v, '.9g')}{a}"
            for b, v, a in zip(before, values, after, strict=True)
        )
    stream.write("".join(lines).encode())


def write_report(path: Path, report: dict[str, Any]) -> None:
    """The JSON beside the scores: sorted, NaN refused."""
    text = json.dumps({"format": FORMAT, **report}, sort_keys=True, indent=1, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """A scores file in memory."""

    path: Path
    run: Run
    samples: Int[np.ndarray, " B"]
    errors: Errors
    report: dict[str, Any]
    """The JSON beside it; empty where there is none."""

    @property
    def instance(self) -> Int[np.ndarray, " B"]:
        """The object of each sample; without the JSON every sample counts as its own."""
        known = self.report.get("instance")
        if known is None or len(known) <= int(self.samples.max(initial=-1)):
            return self.samples
        return np.asarray(known, np.int64)[self.samples]


def read_scores(path: Path) -> list[Scores]:
    """The runs of a scores file, usually one.

    Raises:
        StoreError: Not gzip, not our columns, a value that is no number, slots with gaps.
    """
    frame = _read_frame(path)
    report = _read_report(side_file(path))
    out = []
    for key, rows in frame.groupby(list(COLUMNS[:6]), sort=True):
        method, variant, seed, data, category, split = cast("tuple[Any, ...]", key)
        run = Run(
            method=method,
            variant=variant,
            seed=int(seed),
            data=data,
            category=category,
            split=split,
        )
        samples = np.unique(rows["sample"].to_numpy())
        out.append(
            Scores(
                path=path,
                run=run,
                samples=samples,
                report=report,
                errors=_arrays(path, rows, samples),
            )
        )
    return out


def _read_frame(path: Path) -> Any:  # noqa: ANN401
    import pandas as pd

    types = {
        **dict.fromkeys(("method", "variant", "data", "category", "split", "metric", "unit"), str),
        **dict.fromkeys(("seed", "sample", "slot"), np.int64),
        "value": float,
    }
    try:
        frame = pd.read_csv(
            path,
            compression="gzip",
            keep_default_na=False,
            na_values={"value": [""]},
            dtype=cast("Any", types),
        )
    except (OSError, EOFError, ValueError, pd.errors.ParserError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise StoreError(f"{path}: expected gzipped CSV of scores, found {first}") from error
    if tuple(frame.columns) != COLUMNS:
        raise StoreError(
            f"{path}: expected columns {','.join(COLUMNS)}, found "
            f"{','.join(map(str, frame.columns))}"
        )
    return frame


def _arrays(path: Path, rows: Any, samples: Int[np.ndarray, " B"]) -> Errors:  # noqa: ANN401
    errors: Errors = {}
    for (name, unit), group in rows.groupby(["metric", "unit"], sort=False):
        if name not in _RANK:
            raise StoreError(f"{path}: expected metrics {', '.join(_RANK)}, found {name!r}")
        slots = group["slot"].to_numpy()
        table = np.full((len(samples), int(slots.max()) + 1), np.nan)
        index = np.searchsorted(samples, group["sample"].to_numpy())
        if len(group) != table.size or len(np.unique(index * table.shape[1] + slots)) != len(group):
            raise StoreError(
                f"{path}: metric {name!r}: expected one row for each of "
                f"{table.size} samples and slots, found {len(group)} rows"
            )
        table[index, slots] = group["value"].to_numpy()
        errors[name, unit] = table
    return errors


def _read_report(path: Path) -> dict[str, Any]:
    try:
        report = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: expected the JSON of a scores file, found {error}") from error
    if not isinstance(report, dict) or report.get("format") != FORMAT:
        raise StoreError(f"{path}: expected format {FORMAT!r}, found another")
    return report
