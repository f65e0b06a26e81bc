# SPDX-License-Identifier: MIT
"""`release`: a trained run as a small checkpoint to give away, with its card and ten answers.

Numbers of half precision, nothing of the training clouds but what prediction looks at. The answers
are kept beside the inputs, so that whoever loads the model can see that it still gives them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.methods import find, load
from bench.requests import ReleaseRequest
from bench.runs.align import CLOUDS, MODE, aligned
from bench.scoring.score_files import SUFFIX, Report, read_report
from bench.tables.model import UNCALIBRATED, UNCALIBRATED_NOTE
from scapo.method import AbstractMethod, Mode, evenly
from scapo.predictor import Predictor
from scapo.store import Header, StoreError, open_split, sha256_file, write, write_bytes
from scapo.store.checkpoint import (
    RUN_FIELDS,
    alignment_field,
    check_header,
    require_fields,
    to_arrays,
    weights_file,
)
from scapo.store.files import read, require_suffix
from scapo.store.samples import SampleDataset, observe, observed

MAX_BYTES = 4 << 20
"""Of a released model."""
ANSWERS = 10
"""Clouds whose answers are kept."""
MODES: tuple[Mode, ...] = ("fast", "quick")
"""Whose answers are kept."""
LABELLED_SPLIT = "train"
CHECKS = "checks"
"""Folder of the answers, beside that of the checkpoints."""
FORMAT = "scapo-answers/2"
WHOLE = 255  # A part's weight of 1, as answers are kept
LEGEND = (
    "Means. S: part IoU; D: direction of the joints; C: their pivots; R, t: poses of the parts. C "
    "and t in units of 4 x the cloud's mean radius. `objects known`: told in training which clouds "
    "show the same object (`--supervision instance`). `released`: this file, asked by its name."
)
CAMERA = """
It uses where the camera stands: the origin of the cloud's frame, or `sensor`."""
CARD = """# {title}: {category}

`scapo.load("{name}").predict(points)`: parts, poses and joints of one {category} in a
point cloud, (N, 3), metres, camera frame (x right, y down, z forward).{camera}

| | |
|---|---|
| method | `{method}`, {parameters:,} parameters, half precision |
| trained on | data with digest `{data_digest}`, labels: {labels} |
| seed, steps, commit | {seed}, {steps:,}, `{commit}` |
| made by | `scapo-bench train {method}`, `scapo-bench release` |
| licence | MIT, as the code; the data are procedural |

## Scores

{scores}

## Intended use

Research on articulated objects, and a start for robots that open and close things, with the object
segmented from its surroundings. One object of the category, in the units of the camera.

## Limits

- Trained on procedural shapes: real objects look different (rows `real`, where there are any).
- Views that several poses explain are answered by one of them; the scores say how often.
- {frame}
- Nothing tells whether a cloud shows the category at all. No safety may rest on an answer.

<details><summary>Configuration</summary>

```json
{config}
```

</details>
"""
METRICS = (
    ("S, %", "iou_1", 100.0, 1),
    ("D, deg", "joint_direction_deg", 1.0, 1),
    ("C", "joint_pivot_r4", 1.0, 3),
    ("R, deg", "part_rotation_deg", 1.0, 1),
    ("t", "part_translation_r4", 1.0, 3),
)
"""Of the card: heading, key in a report, factor, decimals."""


def release(request: ReleaseRequest) -> list[Path]:
    """Write checkpoint, card and answers; returns their paths.

    A released checkpoint that is released to where it is stays to the byte, and so do calibrations
    of it: its card and answers are made anew, for a program that answers otherwise.

    Raises:
        StoreError: No finished run there, no such data, or a model that does not fit.
    """
    require_suffix(request.out, ".safetensors")
    method, header = load(request.checkpoint)
    require_fields(header, RUN_FIELDS, request.checkpoint)
    if not header["finished"]:
        raise StoreError(f"{request.checkpoint}: expected a finished run, found one that is not")
    source = weights_file(request.checkpoint)
    if source.resolve() != request.out.resolve():
        header = {**header, **frame_of_before(method, header, request),
                  "config": without_folders(header["config"])}  # fmt: skip
        slim(method, request.out, {**header, "source": sha256_file(source)})
    card = request.out.with_suffix(".md")
    write_bytes(card, card_of(header, request).encode())
    answers = answers_file(request.out)
    keep_answers(request, header["category"], answers)
    return [request.out, card, answers]


def frame_of_before(
    method: AbstractMethod, header: Header, request: ReleaseRequest
) -> dict[str, Any]:
    """The alignment of a run that was trained before runs had one, by its own training data."""
    if "pose" in method.supervision or header.get("alignment") is not None:
        return {}
    try:
        split = open_split(request.data, header["category"], LABELLED_SPLIT)
    except StoreError:
        return {}
    if split.manifest.digest != header["data_digest"]:
        return {}
    found = aligned(method, split, CLOUDS, MODE, "cpu")
    return {} if found is None else alignment_field(found)


def slim(method: AbstractMethod, out: Path, header: Header) -> None:
    """Write a model in half precision, without what training alone needs.

    Raises:
        StoreError: It is larger than `MAX_BYTES`, or has a number that half precision has not.
    """
    method.strip()
    arrays = to_arrays(method)
    for name, array in arrays.items():
        if array.dtype != np.float32:
            continue
        with np.errstate(over="ignore"):
            arrays[name] = array.astype(np.float16)
        if not np.isfinite(arrays[name]).all():
            raise StoreError(f"{out}: tensor {name!r}: expected numbers below 65,504, found larger")
    size = sum(array.nbytes for array in arrays.values())
    if size > MAX_BYTES:
        raise StoreError(f"{out}: expected at most {MAX_BYTES:,} bytes, found {size:,}")
    write(out, arrays, header)


def answers_file(checkpoint: Path) -> Path:
    """Where the answers of a released checkpoint are kept."""
    return checkpoint.parent.parent / CHECKS / checkpoint.name


def keep_answers(request: ReleaseRequest, category: str, out: Path) -> None:
    """Ask the released model about clouds spread over a split, and keep them with what it says."""
    split = open_split(request.data, category, request.split)
    samples = SampleDataset(split, observed(split))
    observation = observe(samples.batch(evenly(len(samples), ANSWERS)))
    points = observation.points.numpy()
    arrays = {"points": points}
    for mode, prediction in _asked(request.out, points):
        arrays |= {f"{mode}/{name}": value for name, value in prediction.items()}
    header = {"format": FORMAT, "model": sha256_file(request.out), "split": split.manifest.split,
              "data_digest": split.manifest.digest}  # fmt: skip
    write(out, arrays, header)


@dataclass(frozen=True, slots=True, kw_only=True)
class Differences:
    """How far a model's answers are from those that were kept, the largest of each cloud."""

    part_weight: np.ndarray
    pose: np.ndarray
    """Of any number of the matrices; metres, and of rotations without a unit."""


def compare_answers(checkpoint: Path) -> dict[str, Differences]:
    """The differences of each mode, by asking the model the same again.

    Raises:
        StoreError: No answers are kept, or those of another checkpoint.
    """
    path = answers_file(checkpoint)
    kept, header = read(path, FORMAT)
    digest = sha256_file(checkpoint)
    if header.get("model") != digest:
        raise StoreError(f"{path}: expected answers of {digest[:12]}, found those of another model")
    found = {}
    for mode, said in _asked(checkpoint, kept["points"]):
        off = {
            name: np.abs(value.astype(np.float32) - kept[f"{mode}/{name}"])
            for name, value in said.items()
        }
        found[mode] = Differences(
            part_weight=off["part_weight"].max((1, 2)) / WHOLE,
            pose=off["camera_T_part"].max((1, 2, 3)),
        )
    return found


def _asked(checkpoint: Path, points: np.ndarray) -> Iterator[tuple[Mode, dict[str, np.ndarray]]]:
    """The answers of each mode, weights as bytes."""
    method, header = load(checkpoint)
    model = Predictor(method, "cpu", check_header(header, str(checkpoint)).alignment)
    for mode in MODES:
        with torch.no_grad():
            said = model.predict(points, mode)
        if said.part_weight is None or said.camera_T_part is None:
            raise StoreError(f"{checkpoint}: expected parts and poses in mode {mode}, found none")
        yield mode, {"part_weight": (WHOLE * said.part_weight).round().byte().numpy(),
                     "camera_T_part": said.camera_T_part.float().numpy()}  # fmt: skip


def card_of(header: Header, request: ReleaseRequest) -> str:
    """The model's card, in Markdown."""
    entry = find(header["method"])
    return CARD.format(
        **{name: header.get(name, "") for name in ("method", "category", "data_digest", "seed")},
        title=header["method"] if entry is None else entry.title,
        name=request.out.stem.replace("-", "/", 1),
        camera=CAMERA if entry is not None and entry.camera else "",
        parameters=header.get("parameters", 0),
        steps=header["steps"],
        commit=header.get("commit", ""),
        frame=frame_sentence(header),
        labels=", ".join(header["supervision"]) or "none",
        scores=scores_table(header, request.scores),
        config=json.dumps(header["config"], indent=1, sort_keys=True),
    )


def without_folders(config: Header) -> Header:
    """A configuration whose `start` is the run's name: its folder is on one machine alone.

    >>> without_folders({"start": "OUT/runs/clean/oven-1", "epochs": 3})
    {'start': 'oven-1', 'epochs': 3}
    """
    start = config.get("start")
    return {**config, "start": Path(start).name} if isinstance(start, str) else config


def frame_sentence(header: Header) -> str:
    """In which frame the model answers, and by which labels."""
    found = check_header(header, "header").alignment
    if found is not None:
        return (
            "Poses are in the object's frame (z up, the front towards -x) and states 0 at rest by "
            f"{found.numbers} numbers,\n  fitted after training with the labels of "
            f"{found.clouds.samples} clouds of `{found.clouds.split}`; no weight depends on them."
        )
    if "pose" in header["supervision"]:
        return "Poses are in the frames of the training labels."
    return (
        "Without labels in training the frames of the parts are the method's own, up to one rigid "
        "offset\n  for each part (`scapo-bench calibrate` learns it from labelled clouds)."
    )


def scores_table(header: Header, scores: Path | None) -> str:
    """The scores of this run in a folder, by data, split, trait and variant."""
    if scores is None:
        return "Not given."
    rows = [
        (*_where(report), report.variant or "fast", trait, f"{clouds:,}", _numbers(report, found))
        for report in _reports(header, scores)
        for trait, clouds, found in _summaries(report)
    ]
    if not rows:
        return "None of this run."
    heads = ["data", "split", "variant", "objects", "clouds", *(metric[0] for metric in METRICS)]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    lines += [f"| {' | '.join(row)} |" for row in sorted(rows)]
    told = [UNCALIBRATED_NOTE] if any(UNCALIBRATED in line for line in lines) else []
    return "\n".join([*lines, "", LEGEND, *told])


def _where(report: Report) -> tuple[str, str]:
    return report.data.partition("@")[0], report.split


def _reports(header: Header, scores: Path) -> Iterator[Report]:
    """The reports of this very run, of the benchmark's readings and of ambiguous views."""
    for path in sorted(scores.rglob(f"*{SUFFIX}")):
        report = read_report(path)
        same = (report.method, report.category, report.seed) == (
            header["method"], header["category"], header["seed"]
        )  # fmt: skip
        if same and report.run.get("data_digest") == header["data_digest"] and (
            without_folders(report.run.get("config", {})) == header["config"]
        ) and "label-order" not in report.variant:  # fmt: skip
            yield report


def _summaries(report: Report) -> Iterator[tuple[str, int, Mapping[str, Any]]]:
    whole = {name: {"mean": one.mean} for name, one in report.summary.items()}
    yield "all", len(report.instance), whole
    for trait, found in report.by_trait.items():
        yield trait or "as in training", found["samples"], found["summary"]


def _numbers(report: Report, summary: Mapping[str, Any]) -> str:
    cells = []
    for _, key, factor, decimals in METRICS:
        mean = summary.get(key, {}).get("mean")
        mark = UNCALIBRATED * report.lacks_calibration(key.rpartition("_")[0])
        cells.append("–" if mean is None else f"{factor * mean:.{decimals}f}{mark}")
    return " | ".join(cells)
