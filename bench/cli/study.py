# SPDX-License-Identifier: MIT
"""`scapo-bench study RUN...`: everything that is to be known of trained runs, and one page of it.

For each run and inference mode: predictions on the training split (some, for the frames) and on
the split to be scored, scores, the oracle ladder, pictures; for each run its stability. What is
there and newer than its run stays, so a study that was interrupted goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from bench.analysis.explain import explain
from bench.analysis.study_page import Entry, write_page
from bench.cli.pictures import Pictures
from bench.cli.stability import Stability
from bench.methods import load
from bench.runs.predict import Predict
from bench.scoring.evaluate import Request, evaluate
from scapo.method import Mode
from scapo.store import StoreError
from scapo.store.checkpoint import WEIGHTS


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """Predict, score, explain, draw and test the stability of runs; one page of all results."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, of any methods and categories."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Folder for predictions/, scores/, ladders/, pictures/, stability/ and README.md."""
    split: str = "test"
    """Split to score."""
    mode: Literal["fast", "refine", "both"] = "both"
    """Inference modes."""
    calibration: int = 500
    """Training clouds that fix the frames of a method that saw no poses."""
    samples: int = 20
    """Clouds for stability; 0 leaves it out."""
    device: str = "auto"
    """auto (CUDA where there is a GPU), cpu, cuda, ..."""

    def run(self, console: Console) -> None:
        """Do what is missing, then write the page anew."""
        modes: tuple[Mode, ...] = ("fast", "refine") if self.mode == "both" else (self.mode,)
        entries: list[Entry] = []
        for run in self.runs:
            name, calibrated = self._name(run)
            if any(entry.name.rpartition("-")[0] == name for entry in entries):
                raise StoreError(f"{run}: expected runs of different names, found {name!r} twice")
            entries += [self._mode(run, f"{name}-{mode}", mode, calibrated, console)
                        for mode in modes]  # fmt: skip
            if self.samples:
                self._stability(run, name, console)
        page = write_page(self.out, entries, self.command())
        console.print(f"Page: {page}", soft_wrap=True)

    def command(self) -> str:
        """As it was typed, without the folders of this machine."""
        words = ["scapo-bench study", *(_shown(run) for run in self.runs), "--data",
                 _shown(self.data), "--out", _shown(self.out), "--split", self.split,
                 "--mode", self.mode, "--calibration", str(self.calibration),
                 "--samples", str(self.samples)]  # fmt: skip
        return " ".join(words)

    def _name(self, run: Path) -> tuple[str, bool]:
        """A run's name in files, and whether its frames must be fitted."""
        method, header = load(run)
        words = [header["category"], method.name, method.variant, f"seed{header['seed']}"]
        name = "-".join(word.replace(" ", "_") for word in words if word)
        return name, "pose" not in method.supervision

    def _mode(self, run: Path, name: str, mode: Mode, calibrated: bool, console: Console) -> Entry:
        scored = self.out / "predictions" / f"{name}-{self.split}.safetensors"
        trained = self.out / "predictions" / f"{name}-train.safetensors"
        source = run / WEIGHTS if run.is_dir() else run
        self._predict(source, scored, mode, None, console)
        if calibrated:
            self._predict(source, trained, mode, self.calibration, console)
        inputs = (scored, trained) if calibrated else (scored,)
        frames = trained if calibrated else None
        scores = self.out / "scores" / f"{name}.csv.gz"
        ladder, pictures = self.out / "ladders" / name, self.out / "pictures" / name

        def request(out: Path) -> Request:
            return Request(predictions=scored, data=self.data, out=out, split=self.split,
                           calibration=frames)  # fmt: skip

        made(scores, inputs, lambda: evaluate(request(scores)), console)
        made(ladder / "ladder.md", inputs, lambda: explain(request(ladder)), console)
        draw = Pictures(checkpoint=run, data=self.data, predictions=scored, out=pictures,
                        split=self.split, calibration=frames)  # fmt: skip
        made(pictures / "ranking.png", inputs, lambda: draw.run(console), console)
        return Entry(name=name, mode=mode, scores=scores, ladder=ladder / "ladder.md",
                     pictures=pictures)  # fmt: skip

    def _predict(
        self, source: Path, out: Path, mode: Mode, limit: int | None, console: Console
    ) -> None:
        split = self.split if limit is None else "train"
        verb = Predict(checkpoint=source, data=self.data, out=out, split=split, mode=mode,
                       device=self.device, limit=limit)  # fmt: skip
        made(out, (source,), lambda: verb.run(console), console)

    def _stability(self, run: Path, name: str, console: Console) -> None:
        out = self.out / "stability" / f"{name}.json"
        source = run / WEIGHTS if run.is_dir() else run
        verb = Stability(checkpoint=source, data=self.data, out=out, split=self.split,
                         mode=self.mode, samples=self.samples, device=self.device)  # fmt: skip
        made(out, (source,), lambda: verb.run(console), console)


def made(out: Path, inputs: tuple[Path, ...], make: Callable[[], object], console: Console) -> None:
    """Make a file unless it is newer than all its inputs."""
    if out.is_file() and all(out.stat().st_mtime >= path.stat().st_mtime for path in inputs):
        return
    console.print(f"study: {out}", markup=False, highlight=False, soft_wrap=True)
    make()


def _shown(path: Path) -> str:
    return path.name if path.is_absolute() else str(path)
