# SPDX-License-Identifier: MIT
"""The models that answer: one of a run, of a category, or all that were released."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.infer.calibration import Calibration, calibration_file, read_calibration
from bench.methods import load
from bench.requests import Mode
from scapo.categories import Category
from scapo.predictor import Predictor
from scapo.released import find, released
from scapo.store.checkpoint import WEIGHTS, check_header, weights_file
from scapo.store.files import sha256_file
from scapo.store.schema import StoreError
from scapo.text import UsageError, did_you_mean


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model:
    """A trained method, and what is known of its answers."""

    name: str
    """Of its run folder, or of its category where it was released."""
    predictor: Predictor
    category: Category
    method: str
    digest: str
    """SHA-256 of the checkpoint."""
    calibration: Calibration | None
    """Of one mode; None: it was not calibrated for that."""


def load_model(what: Path | str, device: str, mode: Mode | None) -> Model:
    """The model of a run folder, a checkpoint file or a category.

    Args:
        what: Its folder, file or category.
        device: Where it runs.
        mode: Whose calibration is read, if there is one; None: none is.

    Raises:
        StoreError: None there, or a calibration that belongs to another.
    """
    path = find(what)
    file = weights_file(path)
    method, header = load(path)
    digest = sha256_file(file)
    beside = None if mode is None else calibration_file(file, mode)
    known = read_calibration(beside, digest) if beside and beside.is_file() else None
    alignment = check_header(header, str(file)).alignment
    if alignment is None and known is not None:
        alignment = known.alignment
    return Model(
        name=file.resolve().parent.name if file.name == WEIGHTS else file.stem,
        predictor=Predictor(method, device, alignment),
        category=method.category,
        method=header["method"],
        digest=digest,
        calibration=known,
    )


def load_models(run: Path | None, category: str | None, device: str, mode: Mode) -> list[Model]:
    """Those that are asked: of the run or the category, or every released one.

    Raises:
        UsageError: Both are given, or no model of that category is released.
        StoreError: There is none.
    """
    if run is not None and category is not None:
        raise UsageError("--run, --category: expected one of the two or none, found both")
    if run is not None:
        return [load_model(run, device, mode)]
    weights = released()
    if category is not None and category not in weights:
        known = f"one of {', '.join(weights)}" if weights else "none, as no model is released yet"
        raise UsageError(
            f"--category {category}: expected {known}; a run of your own is given by --run RUN"
            f"{did_you_mean(category, weights)}"
        )
    names = list(weights) if category is None else [category]
    if not names:
        raise StoreError(
            "expected released models, found none yet: give one of your own with --run RUN "
            "(scapo-bench train registered --category C --data DIR --out RUN)"
        )
    return [load_model(weights[name], device, mode) for name in names]
