# SPDX-License-Identifier: MIT
"""Files in, files out: predictions and data -> scores per sample (CSV) and a report (JSON)."""

from __future__ import annotations

import platform
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from bench.compat_files import score_compat
from bench.predictions import Header, Predictions
from bench.prepare import Prepared, Request, fit_frames, open_data
from bench.report import summarise
from bench.score_files import Run, side_file, write_report, write_rows, writing
from bench.scores import Errors, Rows, Settings, score
from bench.statistics import BOOTSTRAP_SEED
from bench.truth import Truth, blocks
from scapo.provenance import commit, machine
from scapo.store import Split, sha256_file

__all__ = ["Request", "data_name", "evaluate", "run_of"]


def evaluate(request: Request) -> dict[str, Any]:
    """Score a predictions file; returns the report that is written beside the scores.

    Raises:
        StoreError: A file is missing or not what it should be: one line with file, tensor,
            expected and found.
    """
    side_file(request.out)
    header, split = open_data(request)
    with Predictions(request.predictions, split) as predictions:
        fitted = fit_frames(request, header, split, predictions)
        scored = _Scored()
        run = run_of(request, header, split)
        with writing(request.out) as stream:
            for truth in blocks(split):
                rows = predictions.rows(truth.first, len(truth))
                errors = _errors(request.settings, fitted, truth, rows)
                write_rows(stream, run, truth.first, errors)
                scored.add(truth, errors)
            predictions.finish()
            report = _report(request, header, split, fitted, scored, predictions)
    write_report(side_file(request.out), report)
    return report


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


def data_name(folder: Path, split: Split) -> str:
    """`NAME@DIGEST`: what the data are called, and the first 12 digits of their digest.

    NAME is the manifest's option `benchmark`, else the folder above the category where that is
    part of the data set (`clean`, `sensor`), else `sensor` for data with simulated sensor noise
    and `clean` without.
    """
    manifest, root = split.manifest, folder.resolve()
    named = manifest.options.get("benchmark")
    above = split.folder.resolve().parent.parent
    inside = above != root and above.is_relative_to(root)
    if isinstance(named, str) and named:
        name = named
    elif inside or above.name in ("clean", "sensor"):
        name = above.name
    else:
        noisy = manifest.options.get("noise", "none") != "none"
        name = "sensor" if noisy else "clean"
    return f"{name}@{manifest.digest[:12]}"


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
        "instance": instance.tolist(),
        **summarise(errors, instance, request.settings.ap_rule),
    }


def _origin(header: Header) -> dict[str, Any]:
    """What made the predictions, and what scored them."""
    versions = {
        "scapo": version("scapo"),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    return {"run": header.run, "commit": commit(), "machine": machine(), "versions": versions}
