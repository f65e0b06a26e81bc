# SPDX-License-Identifier: MIT
"""`scapo-bench pictures RUN`: what a trained method did, as figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from bench.analysis.answered import Answered, read_answered
from bench.figures.overlay import overlay_picture
from bench.figures.pictures import ranking_picture, training_curve
from bench.figures.template import template_picture, template_shape
from bench.methods import load
from bench.scoring.evaluate import Request
from scapo.method import AbstractMethod, evenly
from scapo.store import StoreError
from scapo.store.files import Header

CURVE = "metrics.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class Pictures:
    """Figures of a run: clouds in one frame, its template, best to worst, the training curve."""

    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, or a checkpoint file."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    predictions: Path
    """Predictions of that run (safetensors)."""
    out: Path
    """Folder for overlay.png, template.png, ranking.png and training.png."""
    split: str = "test"
    """Split that was predicted."""
    calibration: Path | None = None
    """Predictions of the same run on the training split, as for evaluate: they put a method that
    saw no poses into the true frame, so that its figures are upright."""
    clouds: int = 24
    """Clouds in overlay.png, evenly spread over the split."""

    def run(self, console: Console) -> None:
        """Draw what the run has, and say what it has not."""
        method, header = load(self.checkpoint)
        answered = read_answered(
            Request(predictions=self.predictions, data=self.data, out=self.out,
                    split=self.split, calibration=self.calibration)
        )  # fmt: skip
        check_same(self.predictions, answered, header)
        for name, draw in self.figures(method, answered).items():
            path = self.out / name
            if isinstance(draw, str):
                console.print(f"{name}: {draw}", markup=False, highlight=False, soft_wrap=True)
                continue
            draw(path)
            console.print(str(path), markup=False, highlight=False, soft_wrap=True)

    def figures(
        self, method: AbstractMethod, answered: Answered
    ) -> dict[str, Callable[[Path], None] | str]:
        """File name -> what draws it, or why it is left out."""
        run = self.checkpoint if self.checkpoint.is_dir() else self.checkpoint.parent
        samples = evenly(len(answered.points), self.clouds).numpy()
        posed = bool(np.isfinite(answered.mine.pose).any())
        moved = bool(np.isfinite(answered.mine.state).any())
        shape = template_shape(method)
        out: dict[str, Callable[[Path], None] | str] = {
            "overlay.png": "left out, the predictions hold no poses",
            "template.png": f"left out, {method.name} has no template or says no joint states",
            "ranking.png": lambda path: ranking_picture(answered, self.predictions, path),
            "training.png": f"left out, no {CURVE} beside the checkpoint",
        }
        if posed:
            out["overlay.png"] = lambda path: overlay_picture(answered, path, samples)
        if shape is not None and moved:
            out["template.png"] = lambda path: template_picture(
                answered, shape, self.predictions, path
            )
        if (run / CURVE).is_file():
            out["training.png"] = lambda path: training_curve(run / CURVE, path)
        return out


def check_same(path: Path, answered: Answered, header: Header) -> None:
    """Refuse predictions of another run.

    Raises:
        StoreError: Method, category or seed differ.
    """
    for name in ("method", "category", "seed"):
        want, have = header.get(name), getattr(answered.header, name)
        if want != have:
            raise StoreError(
                f"{path}: header field {name!r}: expected {want!r} as in the run, found {have!r}"
            )
