# SPDX-License-Identifier: MIT
"""`study`: everything that is to be known of trained runs, and one page of it.

For each run and inference mode: predictions on the training split (some, for the frames) and on
the split to be scored, scores, the oracle ladder, pictures; for each run its stability. What is
there and was asked for in the same way, of the same run and data, stays (`asked/` says how), so a
study that was interrupted goes on and a page never tells of another question.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from bench.analysis.beside import evaluate_beside
from bench.analysis.study_page import Entry, write_page
from bench.figures.explain import explain
from bench.figures.run import draw_pictures
from bench.methods import load
from bench.requests import (
    EvaluateRequest,
    Mode,
    PicturesRequest,
    PredictRequest,
    Request,
    StabilityRequest,
    StudyRequest,
    require_some,
)
from bench.runs.predict import Watch, predict
from bench.runs.stability import measure_stability
from scapo.released import find as find_checkpoint
from scapo.store import StoreError, open_split, sha256_file, write_bytes
from scapo.store.checkpoint import weights_file
from scapo.store.files import read_header
from scapo.store.json_records import readable_json

LONGEST_NAME = 150
"""Characters of a run's name in names of files, which may have 255 bytes."""
ASKED = "asked"
"""Folder that says of each file what was asked for when it was made."""


def study(request: StudyRequest, say: Callable[[str], None], watch: Watch = iter) -> Path:
    """Do what is missing, then write the page anew.

    Args:
        request: Which runs, on what.
        say: Told of each file before it is made.
        watch: Passes the batches of a prediction on.

    Returns:
        The page.

    Raises:
        UsageError: No runs.
        StoreError: No such run or data, or two runs of one name.
    """
    require_some("RUN", request.runs)
    modes: tuple[Mode, ...] = ("fast", "refine") if request.mode == "both" else (request.mode,)
    work = _Study(request, say, watch)
    entries: list[Entry] = []
    for run in request.runs:
        name, calibrated = _name(run)
        if any(entry.name.rpartition("-")[0] == name for entry in entries):
            raise StoreError(f"{run}: expected runs of different names, found {name!r} twice")
        of_run = [work.mode(run, f"{name}-{mode}", mode, calibrated) for mode in modes]
        report = work.stability(run, name)
        entries += [replace(entry, stability=report) for entry in of_run]
    return write_page(request.out, entries, command(request))


def command(request: StudyRequest) -> str:
    """As it was typed, without the folders of this machine."""
    words = ["scapo-bench study", *(_shown(run) for run in request.runs), "--data",
             _shown(request.data), "--out", _shown(request.out), "--split", request.split,
             "--mode", request.mode, "--calibration", str(request.calibration),
             "--samples", str(request.samples)]  # fmt: skip
    return " ".join(words)


def _shown(path: Path) -> str:
    return path.name if path.is_absolute() else str(path)


def _name(run: Path) -> tuple[str, bool]:
    """A run's name in files, and whether its frames must be fitted."""
    method, header = load(run)
    words = [header["category"], method.name, method.variant, f"seed{header['seed']}"]
    name = "-".join(re.sub(r"[^\w.,=+@-]", "_", word) for word in words if word)
    return name[:LONGEST_NAME], "pose" not in method.supervision


class _Study:
    """The files of one study."""

    def __init__(self, request: StudyRequest, say: Callable[[str], None], watch: Watch) -> None:
        self.request, self.say, self.watch = request, say, watch

    def mode(self, run: Path, name: str, mode: Mode, calibrated: bool) -> Entry:
        """Predictions, scores, ladder and pictures of one run in one mode."""
        data, split, out = self.request.data, self.request.split, self.request.out
        scored = out / "predictions" / f"{name}-{split}.safetensors"
        trained = out / "predictions" / f"{name}-train.safetensors"
        self._predict(run, scored, mode, None)
        calibrated = calibrated and trained != scored  # nothing is calibrated on what is scored
        if calibrated:
            self._predict(run, trained, mode, self.request.calibration)
        inputs = (scored, trained) if calibrated else (scored,)
        frames = trained if calibrated else None
        scores = out / "scores" / f"{name}.csv.gz"
        ladder, pictures = out / "ladders" / name, out / "pictures" / name

        def asked(out: Path) -> Request:
            return Request(predictions=scored, data=data, out=out, split=split,
                           calibration=frames)  # fmt: skip

        drawn = PicturesRequest(checkpoint=run, data=data, predictions=scored, out=pictures,
                                split=split, calibration=frames)  # fmt: skip
        self._made(scores, inputs, lambda: evaluate_beside(EvaluateRequest(
            predictions=scored, data=data, out=scores, split=split, calibration=frames,
        )))  # fmt: skip
        self._made(ladder / "ladder.md", inputs, lambda: explain(asked(ladder)))
        inputs = (weights_of(run), *inputs)
        self._made(pictures / "ranking.png", inputs, lambda: list(draw_pictures(drawn)))
        return Entry(name=name, mode=mode, scores=scores, ladder=ladder / "ladder.md",
                     pictures=pictures)  # fmt: skip

    def stability(self, run: Path, name: str) -> Path | None:
        """The stability report of a run, if it is asked for."""
        asked = self.request
        if not asked.samples:
            return None
        out = asked.out / "stability" / f"{name}.json"
        request = StabilityRequest(
            checkpoint=weights_of(run), data=asked.data, out=out, split=asked.split,
            mode=asked.mode, samples=asked.samples, device=asked.device,
        )  # fmt: skip
        self._said_by_run(request, lambda: measure_stability(request), samples=asked.samples)
        return out

    def _predict(self, run: Path, out: Path, mode: Mode, limit: int | None) -> None:
        asked = self.request
        request = PredictRequest(
            checkpoint=weights_of(run), data=asked.data, out=out, mode=mode, limit=limit,
            split=asked.split if limit is None else "train", device=asked.device,
        )  # fmt: skip
        self._said_by_run(request, lambda: predict(request, self.watch), limit=limit)

    def _said_by_run(
        self, request: PredictRequest | StabilityRequest, make: Callable[[], object], **more: object
    ) -> None:
        """Make what a run says of a split."""
        category = read_header(request.checkpoint)["category"]
        split = open_split(request.data, category, request.split).manifest
        about = {"data": split.digest, "split": split.split, "mode": request.mode, **more}
        self._made(request.out, (request.checkpoint,), make, **about)

    def _made(
        self,
        out: Path,
        inputs: tuple[Path, ...],
        make: Callable[[], object],
        **about: object,
    ) -> None:
        """Make a file unless it is there, of the same inputs and asked for in the same way."""
        asked = {**about, "inputs": [sha256_file(path) for path in inputs]}
        words, folder = readable_json(asked).encode(), self.request.out
        record = folder / ASKED / f"{out.relative_to(folder)}.json"
        if out.is_file() and record.is_file() and record.read_bytes() == words:
            return
        self.say(f"study: {out}")
        record.unlink(missing_ok=True)  # else it would speak of what an interrupt leaves half made
        make()
        write_bytes(record, words)


def weights_of(run: Path) -> Path:
    """The checkpoint of a run folder or released model."""
    return weights_file(find_checkpoint(run))
