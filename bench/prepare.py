# SPDX-License-Identifier: MIT
"""What `evaluate` and `explain` share: the request, its data, the frames of the method."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from bench.calibration import Fitted, check_calibration, dataset_order, fit
from bench.compat_files import Canon, check_record, fit_canon
from bench.predictions import Header, Predictions, read_prediction_header
from bench.scores import Frames, Settings
from bench.truth import revolute, symmetry
from scapo.store import Split, StoreError, open_split, sha256_file


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What to score, how, and where the scores go."""

    predictions: Path
    data: Path
    out: Path
    split: str = "test"
    calibration: Path | None = None
    settings: Settings = field(default_factory=Settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """What was learned of a method's frames before scoring."""

    frames: Frames
    order: Int[np.ndarray, " P"] | None = None
    canon: Canon | None = None
    record: dict[str, Any] | None = None


def open_data(request: Request) -> tuple[Header, Split]:
    """The header of the predictions and the split they belong to, its bytes verified.

    Raises:
        StoreError: No predictions file, another split, no such data, or changed shards.
    """
    header = read_prediction_header(request.predictions)
    if header.split != request.split:
        raise StoreError(
            f"{request.predictions}: header field 'split': expected "
            f"{request.split!r}, found {header.split!r}"
        )
    return header, find_data(request.data, header)


def find_data(folder: Path, header: Header) -> Split:
    """The split that a header names, its bytes verified.

    Where several data sets below `folder` have that category and split (the benchmark's `clean`
    and `sensor` both have laptops), the digest decides.

    Raises:
        StoreError: Not found, not unique, or changed shards.
    """
    pattern = f"*/{header.category}/{header.split}/manifest.json"
    candidates = [Split(path.parent) for path in sorted(folder.glob(pattern))]
    fitting = [split for split in candidates if split.manifest.digest == header.data_digest]
    if len(candidates) > 1 and len(fitting) == 1:
        found = fitting[0]
    else:
        found = open_split(folder, header.category, header.split)
    found.verify()
    return found


def fit_frames(
    request: Request, header: Header, split: Split, predictions: Predictions
) -> Prepared:
    """Calibrate on the training split, where that was asked for."""
    compat = request.settings.geometry == "opalign-compat"
    if compat:
        check_record(request.predictions, predictions.names)
    frames = Frames(symmetry=symmetry(split.manifest), revolute=revolute(split.manifest))
    if request.calibration is None:
        if compat:
            raise StoreError(
                f"{request.predictions}: expected --calibration with predictions on "
                f"the training split for --geometry opalign-compat, found none"
            )
        order = None
        if request.settings.label_order == "dataset":
            order = dataset_order(predictions, split)
        return Prepared(frames=frames, order=order)
    path = request.calibration
    trained = read_prediction_header(path)
    check_calibration(path, trained, header)
    train = find_data(request.data, trained)
    fitted = fit(path, train, settings=request.settings, frames=frames)
    record = fitted.record() | {"sha256": sha256_file(path), "data": train.manifest.digest}
    canon = None
    if compat:
        canon, facts = fit_canon(path, train, frames)
        record["opalign"] = facts
    return Prepared(
        frames=_with_offsets(frames, fitted), order=fitted.order, canon=canon, record=record
    )


def _with_offsets(frames: Frames, fitted: Fitted) -> Frames:
    offsets = None if fitted.poses is None else fitted.poses.offsets
    return Frames(
        symmetry=frames.symmetry,
        revolute=frames.revolute,
        offsets=offsets,
        state_offset=fitted.state_offset,
    )
