# SPDX-License-Identifier: MIT
"""Files in, files out: predictions and data -> scores per sample (CSV) and a report (JSON)."""

from __future__ import annotations

import platform
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from bench.requests import Request, Settings
from bench.scoring.ambiguity import check_alike, score_best
from bench.scoring.calibration import Fitted, check_calibration, dataset_order, fit
from bench.scoring.compat_files import Canon, check_record, fit_canon, score_compat
from bench.scoring.score_files import Run, side_file, writing
from bench.scoring.scores import Errors, Frames, Rows, score
from bench.scoring.summary import by_trait, summarise
from bench.scoring.truth import Truth, blocks, revolute, symmetry
from bench.statistics import BOOTSTRAP_SEED
from scapo.store import Split, StoreError, sha256_file
from scapo.store.predictions import Header, Predictions, find_data, read_prediction_header
from scapo.store.provenance import commit, machine
from scapo.store.split import data_name


def evaluate(request: Request) -> dict[str, Any]:
    """Score a predictions file; returns the report that is written beside the scores.

    Raises:
        StoreError: A file is missing or not what it should be: one line with file, tensor,
            expected and found.
    """
    side_file(request.out)
    header, split = open_data(request)
    if request.settings.ambiguity == "on":
        check_alike(split)
    with Predictions(request.predictions, split) as predictions:
        fitted = fit_frames(request, header, split, predictions)
        scored = _Scored()
        run = run_of(request, header, split)
        with writing(request.out) as file:
            for truth in blocks(split):
                rows = predictions.rows(truth.first, len(truth))
                errors = _errors(request.settings, fitted, truth, rows)
                file.add(run, truth.first, errors)
                scored.add(truth, errors)
            predictions.finish()
            file.report = _report(request, header, split, fitted, scored, predictions)
    return file.report


class _Scored:
    """Errors of all samples so far: a few numbers each."""

    def __init__(self) -> None:
        self.errors: list[Errors] = []
        self.instance: list[np.ndarray] = []

    def add(self, truth: Truth, errors: Errors) -> None:
        self.errors.append(errors)
        self.instance.append(truth.instance)

    def joined(self) -> Errors:
        names = self.errors[0] if self.errors else {}
        return {name: np.concatenate([block[name] for block in self.errors]) for name in names}


def _errors(settings: Settings, fitted: Prepared, truth: Truth, rows: Rows) -> Errors:
    if settings.ambiguity == "on":
        single = replace(settings, ambiguity="off")
        return score_best(
            truth, rows, lambda *some: _errors(single, fitted, *some), fitted.frames.revolute
        )
    errors = score(truth, rows, settings=settings, frames=fitted.frames, order=fitted.order)
    if fitted.canon is not None:
        errors |= score_compat(truth, rows, fitted.canon, fitted.frames)
    return errors


def run_of(request: Request, header: Header, split: Split) -> Run:
    """The first columns of the rows; readings other than the default are named in the variant."""
    changes = request.settings.changes()
    variant = f"{header.variant}[{changes}]" if changes else header.variant
    return Run(
        method=header.method,
        variant=variant,
        seed=header.seed,
        data=data_name(request.data, split),
        category=header.category,
        split=header.split,
    )


def _report(
    request: Request,
    header: Header,
    split: Split,
    fitted: Prepared,
    scored: _Scored,
    predictions: Predictions,
) -> dict[str, Any]:
    errors = scored.joined()
    instance = np.concatenate(scored.instance) if scored.instance else np.zeros(0, np.int64)
    run = run_of(request, header, split)
    return {
        **{name: getattr(run, name) for name in Run.__slots__},
        "supervision": list(header.supervision),
        "budget": header.budget,
        "parts": list(split.manifest.parts),
        "joints": [joint.kind for joint in split.manifest.joints],
        "settings": asdict(request.settings),
        "counts": {
            "samples": split.manifest.count,
            "instances": len(np.unique(instance)),
            "unanswered": dict(sorted(predictions.unanswered.items())),
        },
        "calibration": fitted.record,
        "seeds": {
            "training": header.seed,
            "calibration": None if fitted.record is None else fitted.record.get("seed"),
            "bootstrap": BOOTSTRAP_SEED,
        },
        "part_order": None if fitted.order is None else fitted.order.tolist(),
        "digests": {
            "data": split.manifest.digest,
            "predictions": sha256_file(request.predictions),
        },
        **_origin(header),
        "camera": header.camera,
        "instance": instance.tolist(),
        **_by_trait(request, split, errors, instance),
        **summarise(errors, instance, request.settings.ap_rule),
    }


def _by_trait(
    request: Request, split: Split, errors: Errors, instance: Int[np.ndarray, " B"]
) -> dict[str, Any]:
    """What sets each object apart from the training shapes, and the summaries told apart by it."""
    trait = [thing.trait for thing in split.manifest.instances]
    return {
        "trait": trait if any(trait) else [],
        "by_trait": by_trait(errors, instance, trait, request.settings.ap_rule),
    }


def _origin(header: Header) -> dict[str, Any]:
    """What made the predictions, and what scored them."""
    versions = {
        "scapo": version("scapo"),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    return {"run": header.run, "commit": commit(), "machine": machine(), "versions": versions}


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
            f"{request.split!r}, found {header.split!r}: --split {header.split}?"
        )
    return header, find_data(request.data, header)


def fit_frames(
    request: Request, header: Header, split: Split, predictions: Predictions
) -> Prepared:
    """Calibrate on the training split, where that was asked for.

    Answers that training already brought to the object's frame are taken as they are without it.
    """
    compat = request.settings.geometry == "opalign-compat"
    if compat:
        check_record(request.predictions, predictions.names)
    frames = Frames(
        symmetry=symmetry(split.manifest),
        revolute=revolute(split.manifest),
        order=() if header.object_frame is None else header.object_frame.order,
    )
    if request.calibration is None:
        if compat:
            raise StoreError(
                f"{request.predictions}: expected --calibration with predictions on "
                f"the training split for --geometry opalign-compat, found none"
            )
        order = None
        if request.settings.label_order == "dataset":
            order = dataset_order(predictions, split)
        return Prepared(frames=frames, order=order, record=at_training(header))
    path = request.calibration
    trained = read_prediction_header(path)
    check_calibration(path, trained, header)
    train = find_training(request.data, trained, split)
    fitted = fit(path, train, settings=request.settings, frames=frames)
    record = fitted.record() | {"sha256": sha256_file(path), "data": train.manifest.digest}
    canon = None
    if compat:
        canon, facts = fit_canon(path, train, frames)
        record["opalign"] = facts
    return Prepared(
        frames=_with_offsets(frames, fitted), order=fitted.order, canon=canon, record=record
    )


def at_training(header: Header) -> dict[str, Any] | None:
    """What a report says of answers that came in the object's frame without pose labels."""
    frame = header.object_frame
    if frame is None:
        return None
    return {"at": "training", "samples": frame.samples, "split": frame.split,
            "data": frame.data_digest, "mode": frame.mode}  # fmt: skip


def find_training(folder: Path, trained: Header, scored: Split) -> Split:
    """The split that calibrates: in the data, else in another part of the benchmark beside them.

    Real objects have no training split: their models were trained on `clean` or `sensor`.

    Raises:
        StoreError: Not found in either, or changed shards.
    """
    try:
        found = find_data(folder, trained)
    except StoreError:
        found = None
    if found is not None and found.manifest.digest == trained.data_digest:
        return found
    beside = dict.fromkeys(path.parents[2] for path in (scored.folder.absolute(),
                                                        scored.folder.resolve()))  # fmt: skip
    name = f"*/{trained.category}/{trained.split}/manifest.json"
    for path in (path for parts in beside for path in sorted(parts.glob(name))):
        other = _readable(path.parent)
        if other is not None and other.manifest.digest == trained.data_digest:
            other.verify()
            return other
    return found or find_data(folder, trained)


def _readable(folder: Path) -> Split | None:
    """A split that lies beside the one asked for, None where it is damaged: it may be anybody's."""
    try:
        return Split(folder)
    except StoreError:
        return None


def _with_offsets(frames: Frames, fitted: Fitted) -> Frames:
    offsets = None if fitted.poses is None else fitted.poses.offsets
    return replace(frames, offsets=offsets, state_offset=fitted.state_offset)
