# SPDX-License-Identifier: MIT
"""Predictions files: the header, the tensors, and the refusal of what is not one.

One safetensors file, written by any program (CONTRACT 3, docs/bring-your-own-method.md). Every
complaint is one line: `file: tensor: expected, found`. A sample whose whole row of a tensor is
NaN has no answer there: it is counted and its scores are empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, get_args

import numpy as np
from safetensors import SafetensorError, safe_open

from bench.prediction_layout import check_rows, check_tensors
from scapo.manifest import Manifest
from scapo.store import PREDICTIONS, Split, StoreError, read_header, write
from scapo.types import Supervision

DIGEST_KEYS = ("data_digest", "digest", "data")
"""The header field that names the data; the first is ours, the others are read too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What made a predictions file."""

    method: str
    variant: str
    category: str
    split: str
    seed: int
    data_digest: str
    """`digest` of the manifest of the split that was predicted."""
    supervision: tuple[Supervision, ...]
    """Labels that training used."""
    budget: dict[str, Any] = field(default_factory=dict)
    """Anything about cost: device, seconds of training, parameters, seconds per cloud."""

    run: dict[str, Any] = field(default_factory=dict)
    """The training behind it: commit, config, machine, data digest of its split."""

    def record(self) -> dict[str, Any]:
        """As stored in the file."""
        return {
            "format": PREDICTIONS,
            "method": self.method,
            "variant": self.variant,
            "category": self.category,
            "split": self.split,
            "seed": self.seed,
            "data_digest": self.data_digest,
            "supervision": sorted(self.supervision),
            "budget": self.budget,
            "run": self.run,
        }


def write_predictions(path: Path, header: Header, arrays: Mapping[str, np.ndarray]) -> str:
    """Write a predictions file atomically; returns its SHA-256."""
    return write(path, arrays, header.record())


def read_prediction_header(path: Path) -> Header:
    """The header, every field checked.

    Raises:
        StoreError: Not a predictions file, a second metadata entry, a missing or wrong field.
    """
    try:
        record = read_header(path, PREDICTIONS)
        with safe_open(path, "numpy") as file:
            entries = sorted(file.metadata() or {})
    except (SafetensorError, OSError, RecursionError, UnicodeError) as error:
        raise StoreError(
            f"{path}: expected a safetensors file with a header, found {error}"
        ) from error
    if entries != ["scapo"]:
        raise StoreError(f"{path}: expected the one metadata entry 'scapo', found {entries}")
    digests = [record[key] for key in DIGEST_KEYS if key in record]
    if not digests:
        raise StoreError(f"{path}: header field {DIGEST_KEYS[0]!r}: expected text, found none")
    seed = record.get("seed")
    if isinstance(seed, bool) or not isinstance(seed, int) or abs(seed) >= 2**63:
        raise StoreError(f"{path}: header field 'seed': expected an integer, found {seed!r}")
    return Header(
        method=_text(path, record, "method"),
        variant=_text(path, record, "variant", empty=True),
        category=_text(path, record, "category"),
        split=_text(path, record, "split"),
        seed=seed,
        data_digest=_text(path, {DIGEST_KEYS[0]: digests[0]}, DIGEST_KEYS[0]),
        supervision=_supervision(path, record),
        budget=_object(path, record, "budget"),
        run=_object(path, record, "run"),
    )


def _object(path: Path, record: dict[str, Any], name: str) -> dict[str, Any]:
    value = record.get(name, {})
    if not isinstance(value, dict):
        raise StoreError(f"{path}: header field {name!r}: expected an object, found {value!r}")
    return value


def _text(path: Path, record: dict[str, Any], name: str, *, empty: bool = False) -> str:
    value = record.get(name)
    if not isinstance(value, str) or not (value or empty) or not value.isprintable():
        found = "none" if value is None else repr(value)
        raise StoreError(f"{path}: header field {name!r}: expected text, found {found}")
    return value


def _supervision(path: Path, record: dict[str, Any]) -> tuple[Supervision, ...]:
    value, known = record.get("supervision"), get_args(Supervision)
    if not isinstance(value, list) or any(item not in known for item in value):
        raise StoreError(
            f"{path}: header field 'supervision': expected a list of "
            f"{', '.join(known)}, found {'none' if value is None else repr(value)}"
        )
    return tuple(sorted(set(value)))


def check_belongs(path: Path, header: Header, manifest: Manifest) -> None:
    """Refuse predictions of another category, split or data set.

    Raises:
        StoreError: Naming the field.
    """
    expected = {
        "category": manifest.category,
        "split": manifest.split,
        "data_digest": manifest.digest,
    }
    for name, want in expected.items():
        have = getattr(header, name)
        if have != want:
            raise StoreError(
                f"{path}: header field {name!r}: expected {want!r} as in the data, found {have!r}"
            )


class Predictions:
    """An open predictions file, read and validated in blocks of samples."""

    def __init__(self, path: Path, split: Split) -> None:
        """Validate header, names, dtypes and shapes against the data.

        Raises:
            StoreError: One line naming what was expected and found.
        """
        self.path = path
        self.header = read_prediction_header(path)
        check_belongs(path, self.header, split.manifest)
        self.unanswered: dict[str, int] = {}
        """Samples without an answer so far, by tensor."""
        self._count = split.manifest.count
        self._parts = len(split.manifest.parts)
        self._file = safe_open(path, "numpy")
        self._slices = check_tensors(str(path), self._file.__enter__(), split)

    def __enter__(self) -> Predictions:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._slices = {}
        self._file.__exit__(kind, error, trace)

    @property
    def names(self) -> tuple[str, ...]:
        """The tensors of the file, sorted."""
        return tuple(sorted(self._slices))

    def rows(self, first: int, count: int) -> dict[str, np.ndarray]:
        """The tensors of samples first..first+count-1, checked.

        `part` comes as int16 with -1 for 255.

        Raises:
            StoreError: A value no answer can have, naming tensor and sample.
        """
        out: dict[str, np.ndarray] = {}
        for name, item in self._slices.items():
            try:
                array = item[first : first + count]
            except SafetensorError as error:
                raise StoreError(
                    f"{self.path}: tensor {name!r}: expected readable data, found {error}"
                ) from error
            where = f"{self.path}: tensor {name!r}"
            out[name], missing = check_rows(where, name, array, first, self._parts)
            self.unanswered[name] = self.unanswered.get(name, 0) + missing
        return out

    def finish(self) -> None:
        """After the last block: refuse a tensor in which no sample has an answer.

        Raises:
            StoreError: Naming the tensor.
        """
        for name, missing in self.unanswered.items():
            if self._count and missing == self._count:
                raise StoreError(
                    f"{self.path}: tensor {name!r}: expected an answer for at least "
                    f"one of {self._count} samples, found NaN in all"
                )
