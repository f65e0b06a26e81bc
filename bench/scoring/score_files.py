# SPDX-License-Identifier: MIT
"""Scores on disk: gzipped CSV, one row per sample, metric, slot and unit, and JSON beside it.

Both appear together or not at all, and are read together: a report holds the digest of its scores.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import secrets
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal, cast

import numpy as np
from jaxtyping import Int

from bench.metrics import METRICS
from bench.scoring.scores import Errors
from scapo.store import StoreError, sha256_bytes, sha256_file
from scapo.store.files import require_suffix
from scapo.store.json_records import from_json, read_json, readable_json
from scapo.store.regular import read_regular
from scapo.text import as_cell, from_cell
from scapo.types import Supervision

FORMAT = "scapo-scores/1"
SUFFIX = ".csv.gz"
COLUMNS = (
    "method", "variant", "seed", "data", "category", "split",
    "sample", "metric", "slot", "value", "unit",
)  # fmt: skip
MAX_TEXT = 256 << 20
"""Bytes of a file of scores, unpacked, when read and when written; 1,000 pairs of glasses take 1.8
to 2.3 million. Reading takes five times as much memory."""
LONGEST_NAME = 300
"""Characters of a name; a variant is that of the predictions and the readings of the metrics."""
CALIBRATED = ("part_rotation", "part_translation", "joint_state")
"""Metrics that need the frames or the states to be the category's."""
_RANK = {name: rank for rank, name in enumerate(METRICS)}


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
        fields = [as_cell(v) if isinstance(v, str) else v for v in asdict(self).values()]
        csv.writer(buffer, lineterminator="").writerow(fields)
        return buffer.getvalue()


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Mean of a metric with its 95 % interval; None where no value is defined."""

    mean: float | None
    low: float | None
    high: float | None
    count: int
    undefined: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Of what was scored."""

    samples: int
    instances: int
    unanswered: dict[str, int]
    """Samples without an answer, or without one of a part or joint, by tensor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Seeds:
    """Of what was drawn at random."""

    training: int
    calibration: int | None
    bootstrap: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Digests:
    """SHA-256 of what was read and written."""

    data: str
    predictions: str
    scores: str | None = None
    """None in reports of before it was kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bootstrap:
    """How the intervals were made."""

    resamples: int
    seed: int
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The JSON beside the scores."""

    format: Literal["scapo-scores/1"]
    method: str
    variant: str
    seed: int
    data: str
    category: str
    split: str
    supervision: tuple[Supervision, ...]
    budget: dict[str, Any]
    """As the predictions' header has it."""
    parts: tuple[str, ...]
    joints: tuple[str, ...]
    settings: dict[str, str]
    counts: Counts
    calibration: dict[str, Any] | None
    seeds: Seeds
    part_order: tuple[int, ...] | None
    digests: Digests
    run: dict[str, Any]
    """The training, as the predictions' header has it."""
    commit: str
    machine: dict[str, str | int]
    versions: dict[str, str]
    instance: tuple[int, ...]
    """The object of each sample."""
    summary: dict[str, Summary]
    """By metric and unit, such as `iou_1`."""
    average_precision: dict[str, Any]
    bootstrap: Bootstrap
    camera: bool | None = None
    """Whether training or prediction uses where the camera stands; None: not said."""
    trait: tuple[str, ...] = ()
    """Of each object, what sets it apart from the training shapes; empty where none has any."""
    by_trait: dict[str, Any] = field(default_factory=dict)
    """Trait -> its samples, instances, `summary` and `average_precision`."""

    def lacks_calibration(self, metric: str) -> bool:
        """Whether a metric was taken in frames that the method found for itself.

        Poses of a method that saw none, and states of one that saw no joints either, mean something
        only after a calibration: at training, or by `evaluate --calibration`.
        """
        learned = {"pose", "joint"} if metric == "joint_state" else {"pose"}
        known = bool(learned & set(self.supervision)) or self.calibration is not None
        return metric in CALIBRATED and not known

    def cost(self, name: str) -> float | None:
        """A number of the budget, which is as the predictions' writer has it: anything."""
        value = self.budget.get(name)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        return float(value) if 0 < value < 1e15 else None


def side_file(scores: Path) -> Path:
    """The JSON beside a scores file."""
    require_suffix(scores, SUFFIX)
    return scores.with_name(scores.name.removesuffix(SUFFIX) + ".json")


class ScoresWriter:
    """Rows and report of a scores file that is not there yet."""

    def __init__(self, stream: gzip.GzipFile, path: Path) -> None:
        """Rows go to `stream`, the file of which is to be called `path`."""
        self.stream = stream
        self.path = path
        self.report: dict[str, Any] = {}
        """To be set before the end."""

    def add(self, run: Run, first: int, errors: Errors) -> None:
        """The rows of samples first, first+1, ...; undefined values are empty.

        Raises:
            StoreError: More than is read again.
        """
        names = sorted(errors, key=lambda key: _RANK[key[0]])
        slots = [(name, slot, unit) for name, unit in names
                 for slot in range(errors[name, unit].shape[1])]  # fmt: skip
        table = np.concatenate([errors[key] for key in names], 1)
        before = [f",{name},{slot}," for name, slot, _ in slots]
        after = [f",{unit}\n" for _, _, unit in slots]
        head = run.row
        lines: list[str] = []
        for index, values in enumerate(table.tolist(), first):
            start = f"{head},{index}"
            lines.extend(
                f"{start}{b}{'' if v != v else format(v, '.9g')}{a}"
                for b, v, a in zip(before, values, after, strict=True)
            )
        self.stream.write("".join(lines).encode())
        if self.stream.tell() > MAX_TEXT:
            raise StoreError(
                f"{self.path}: expected at most {MAX_TEXT} bytes of scores, which is what `tables` "
                f"reads, found more with sample {first + len(table) - 1}: score fewer at a time"
            )


@contextmanager
def writing(path: Path) -> Iterator[ScoresWriter]:
    """A writer whose scores and report get their names together, when both are complete.

    The gzip stream has no time and no name in it: the same scores are the same bytes.

    Raises:
        StoreError: A folder is in the way, or there is more than is read again.
        OSError: It cannot be written; the file it names is `path` or the report.
    """
    beside = side_file(path)
    for target in (path, beside):
        if target.is_dir():
            raise StoreError(f"{target}: expected a file to write, found a folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    mark = secrets.token_hex(8)
    scores, report = (path.with_name(f".{mark}.{kind}.tmp") for kind in ("csv", "json"))
    try:
        with (
            _creating(scores, path) as raw,
            gzip.GzipFile("", "wb", 6, raw, mtime=0) as stream,
        ):
            stream.write((",".join(COLUMNS) + "\n").encode())
            writer = ScoresWriter(stream, path)
            yield writer
        record = {"format": FORMAT, **writer.report}
        record["digests"] = {**record["digests"], "scores": sha256_file(scores)}
        with _creating(report, beside) as raw:
            raw.write(readable_json(record).encode())
        report.replace(beside)
        scores.replace(path)
    finally:
        for temporary in (scores, report):
            with suppress(OSError):
                temporary.unlink()


@contextmanager
def _creating(temporary: Path, path: Path) -> Iterator[BinaryIO]:
    """A new file, flushed to disk; its errors name the `path` that it is to have."""
    try:
        with temporary.open("xb") as raw:
            yield raw
            raw.flush()
            os.fsync(raw.fileno())
    except OSError as error:
        if error.filename not in (None, str(temporary)):  # of another file, read meanwhile
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """A scores file in memory."""

    path: Path
    run: Run
    samples: Int[np.ndarray, " B"]
    errors: Errors
    report: Report

    @property
    def instance(self) -> Int[np.ndarray, " B"]:
        """The object of each sample."""
        return np.asarray(self.report.instance, np.int64)[self.samples]

    @property
    def traits(self) -> tuple[str, ...]:
        """Every trait that some sample has, sorted."""
        return tuple(sorted(set(self._trait_of_samples()) - {""}))

    def of_trait(self, trait: str) -> Scores:
        """The samples of objects with this trait alone."""
        members = np.array([own == trait for own in self._trait_of_samples()], bool)
        errors = {key: table[members] for key, table in self.errors.items()}
        return replace(self, samples=self.samples[members], errors=errors)

    def _trait_of_samples(self) -> list[str]:
        """The trait of each sample's object, empty where the report does not say."""
        known = self.report.trait
        return [known[i] if 0 <= i < len(known) else "" for i in self.instance.tolist()]


def is_report(path: Path) -> bool:
    """Whether a JSON file says that it is a report of scores."""
    try:
        data = read_json(path)
    except StoreError:
        return False
    return isinstance(data, dict) and data.get("format") == FORMAT


def read_report(scores: Path) -> Report:
    """The report beside a scores file.

    Raises:
        StoreError: None there, or a field is missing or not what it should be.
    """
    path = side_file(scores)
    if not path.is_file():
        raise StoreError(f"{path}: expected the report of {scores.name} beside it, found none")
    return from_json(Report, read_json(path), str(path))


def read_scores(path: Path) -> list[Scores]:
    """The runs of a scores file, usually one.

    Raises:
        StoreError: Not gzip, not our columns, a value that is no number, slots with gaps, no
            report or that of other scores.
    """
    report = read_report(path)
    try:
        data = read_regular(path)
    except OSError as error:
        raise StoreError(f"{path}: expected gzipped CSV of scores, found {error}") from error
    frame = _read_frame(path, data)
    if report.digests.scores not in (None, sha256_bytes(data)):
        raise StoreError(f"{path}: expected the scores of {side_file(path).name}, found others")
    out = []
    for key, rows in frame.groupby(list(COLUMNS[:6]), sort=True):
        method, variant, seed, data, category, split = cast("tuple[Any, ...]", key)
        run = Run(method=method, variant=variant, seed=int(seed), data=data,
                  category=category, split=split)  # fmt: skip
        samples = np.unique(rows["sample"].to_numpy())
        if samples[0] < 0 or samples[-1] >= len(report.instance):
            raise StoreError(
                f"{path}: expected samples 0 to {len(report.instance) - 1} as in the report, "
                f"found {samples[0]} to {samples[-1]}"
            )
        out.append(Scores(path=path, run=run, samples=samples, report=report,
                          errors=_arrays(path, rows, samples)))  # fmt: skip
    return out


def _read_frame(path: Path, data: bytes) -> Any:  # noqa: ANN401
    """All rows, their names as they were before `as_cell`."""
    import pandas as pd

    names = [*COLUMNS[:2], *COLUMNS[3:6]]
    types = {
        **dict.fromkeys((*names, "metric", "unit"), str),
        **dict.fromkeys(("seed", "sample", "slot"), np.int64),
        "value": float,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of numbers that no integer can be
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
                text = file.read(MAX_TEXT + 1)
            if len(text) > MAX_TEXT:
                raise ValueError(f"more than {MAX_TEXT} bytes unpacked")
            frame = pd.read_csv(
                io.BytesIO(text),
                keep_default_na=False,
                na_values={"value": [""]},
                dtype=cast("Any", types),
            )
    except (OSError, EOFError, ValueError, OverflowError, zlib.error, Warning) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise StoreError(f"{path}: expected gzipped CSV of scores, found {first}") from error
    if tuple(frame.columns) != COLUMNS:
        raise StoreError(
            f"{path}: expected columns {','.join(COLUMNS)}, found "
            f"{','.join(map(str, frame.columns))}"
        )
    if frame.drop(columns="value").isna().any(axis=None):
        raise StoreError(f"{path}: expected {len(COLUMNS)} cells in every row, found fewer")
    return _checked(path, frame, names)


def _checked(path: Path, frame: Any, names: Sequence[str]) -> Any:  # noqa: ANN401
    """The rows with the names of these columns as they were written, values possible."""
    for name in names:
        for text in frame[name].unique():
            if not text.isprintable() or len(text) > LONGEST_NAME:
                raise StoreError(
                    f"{path}: {name}: expected at most {LONGEST_NAME} printable characters, "
                    f"found {text[:LONGEST_NAME]!r}"
                )
        frame[name] = frame[name].map(from_cell)
    values = frame["value"].dropna()
    if not ((values >= 0) & (values < np.inf)).all():
        raise StoreError(f"{path}: value: expected finite numbers of 0 or more, found another")
    return frame


def _arrays(path: Path, rows: Any, samples: Int[np.ndarray, " B"]) -> Errors:  # noqa: ANN401
    errors: Errors = {}
    for (name, unit), group in rows.groupby(["metric", "unit"], sort=False):
        if name not in METRICS:
            raise StoreError(f"{path}: expected metrics {', '.join(METRICS)}, found {name!r}")
        if unit not in METRICS[name]:
            raise StoreError(f"{path}: metric {name!r}: expected one of its units, found {unit!r}")
        slots = group["slot"].to_numpy()
        count = int(slots.max()) + 1
        index = np.searchsorted(samples, group["sample"].to_numpy())
        size = len(samples) * count
        if slots.min() < 0 or len(group) != size or len(np.unique(index * count + slots)) != size:
            raise StoreError(
                f"{path}: metric {name!r}: expected one row for each of "
                f"{size} samples and slots, found {len(group)} rows"
            )
        table = np.full((len(samples), count), np.nan)
        table[index, slots] = group["value"].to_numpy()
        errors[name, unit] = table
    return errors
