# SPDX-License-Identifier: MIT
"""What stands beside a method in every table, made when the method is scored.

Of the same predictions: one part order for the whole data set, and the best of the turns that look
alike where the data say so. Of the same split: the answers that are no method (`reference`), kept
in the folder `references` beside the scores and made again only when data or code have changed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

from bench.analysis.reference import RECIPE, training_split, write_answers, write_reference
from bench.requests import EvaluateRequest, Kind, ReferenceRequest, Request, Settings
from bench.scoring.evaluate import evaluate, open_data
from bench.scoring.score_files import SUFFIX, read_report
from scapo.store import Split, StoreError, open_split, sha256_file
from scapo.store.files import tensor_names
from scapo.store.provenance import commit
from scapo.store.split import data_name
from scapo.text import UsageError

FOLDER = "references"
"""Beside the scores of methods."""
TRAINING = "train"
"""The split that references learn from, which is not scored with them."""


def evaluate_beside(request: EvaluateRequest) -> tuple[dict[str, Any], list[Path]]:
    """Score predictions, and what stands beside them where the readings are the benchmark's.

    Returns:
        The report of what was asked for, and the scores files beside it.

    Raises:
        StoreError: As `bench.scoring.evaluate.evaluate`.
    """
    report = evaluate(request)
    if not request.companions or request.settings.changes():
        return report, []
    header, split = open_data(request)
    written = []
    for name, settings in readings(request.settings, split).items():
        out = named(request.out, name)
        evaluate(replace(request, settings=settings, out=out))
        written.append(out)
    if header.method not in get_args(Kind) and header.split != TRAINING:
        written += score_references(request.data, split, request.out.parent)
    return report, written


def readings(settings: Settings, split: Split) -> dict[str, Settings]:
    """The readings that stand beside the benchmark's, by what their files are called."""
    found = {"one-order": replace(settings, label_order="dataset")}
    shards = split.manifest.shards
    if shards and all("alike" in tensor_names(split.folder / shard.file) for shard in shards):
        found["ambiguity"] = replace(settings, ambiguity="on")
    return found


def named(scores: Path, reading: str) -> Path:
    """The scores file of another reading."""
    return scores.with_name(f"{scores.name.removesuffix(SUFFIX)}.{reading}{SUFFIX}")


def write_references(request: ReferenceRequest) -> list[Path]:
    """Write what `reference` was asked for; returns the files.

    Raises:
        UsageError: No place to write to, or one predictions file for two.
        StoreError: No such data.
    """
    kind = request.kind
    if request.out is None and request.scores is None:
        raise UsageError("reference: expected --out or --scores, found neither")
    written = []
    if request.out is not None:
        if kind == "both":
            raise UsageError("--out: expected constant or oracle-pose, one file each, found both")
        write_reference(kind, request.data, request.category, request.out, split=request.split)
        written.append(request.out)
    if request.scores is not None:
        split = open_split(request.data, request.category, request.split)
        train = training_split(split)
        if train is None:
            raise StoreError(f"{split.folder}: expected a split train beside it, found none")
        kinds = get_args(Kind) if kind == "both" else (kind,)
        written += score_references(request.data, split, request.scores, kinds=kinds)
    return written


def score_references(
    data: Path,
    split: Split,
    folder: Path,
    *,
    kinds: tuple[Kind, ...] = get_args(Kind),
) -> list[Path]:
    """Score the references of a split, unless that was done before by this code.

    Args:
        data: As for `evaluate`.
        split: That is scored.
        folder: Of scores; theirs go to `references` below it.
        kinds: Which of them.

    Returns:
        Their scores files, made now or before; none where there is no split to learn from.

    Raises:
        StoreError: Damaged data.
    """
    train = training_split(split)
    if train is None:
        return []
    files: list[Path] = []
    for kind in kinds:
        wanted = dict(_files(kind, data, split, folder / FOLDER))
        files += wanted
        if all(_is_made(out, split, train, asked) for out, asked in wanted.items()):
            continue
        with TemporaryDirectory() as temporary:
            answers = Path(temporary) / f"{kind}.safetensors"
            write_answers(kind, train, split, answers)
            for out, asked in wanted.items():
                evaluate(Request(predictions=answers, data=data, out=out,
                                 split=split.manifest.split, settings=asked))  # fmt: skip
    return files


def _files(kind: Kind, data: Path, split: Split, folder: Path) -> Iterator[tuple[Path, Settings]]:
    """The scores files of a reference, and how each is read."""
    words = (data_name(data, split).partition("@")[0], split.manifest.category,
             split.manifest.split, kind)  # fmt: skip
    name = "-".join(re.sub(r"[^\w.+-]", "-", word)[:60] for word in words)
    out = folder / f"{name}{SUFFIX}"
    yield out, Settings()
    for reading, settings in readings(Settings(), split).items():
        yield named(out, reading), settings


def _is_made(out: Path, split: Split, train: Split, settings: Settings) -> bool:
    """Whether a scores file is of these data, read like this, and of this code."""
    if not out.is_file():
        return False
    try:
        report = read_report(out)
    except StoreError:
        return False
    return (
        report.digests.data == split.manifest.digest
        and report.run.get("data_digest") == train.manifest.digest
        and report.run.get("recipe") == RECIPE
        and report.settings == asdict(settings)
        and report.commit == commit()
        and report.digests.scores == sha256_file(out)
    )
