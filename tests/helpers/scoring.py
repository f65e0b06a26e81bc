# SPDX-License-Identifier: MIT
"""Predictions written, evaluated and read back."""

from __future__ import annotations

from bench.requests import Request, Settings
from bench.scoring.evaluate import evaluate
from bench.scoring.score_files import read_scores
from scapo.store import open_split
from scapo.store.predictions import write_predictions
from tests.helpers import made


def root(split):
    return split.folder.parent.parent


def score(split, arrays, folder, calibration=None, settings=None, **header):
    """Write and evaluate; the scores as (metric, unit) -> (B, slots), and the report."""
    path, out = folder / "p.safetensors", folder / "s.csv.gz"
    write_predictions(path, made.header_of(split, **header), arrays)
    if calibration is not None:
        train = open_split(root(split), split.manifest.category, "train")
        write_predictions(folder / "c.safetensors", made.header_of(train, **header), calibration)
    report = evaluate(Request(
        predictions=path, data=root(split), out=out, settings=settings or Settings(),
        calibration=None if calibration is None else folder / "c.safetensors",
    ))  # fmt: skip
    (scores,) = read_scores(out)
    return scores.errors, report
