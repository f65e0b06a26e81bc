# SPDX-License-Identifier: MIT
"""`pictures`: what a trained method did, as figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.analysis.answered import Answered, read_answered
from bench.figures.overlay import overlay_picture
from bench.figures.pictures import ranking_picture, training_curve
from bench.figures.template import (
    TemplateShape,
    aligned_shape,
    template_picture,
    template_shape,
)
from bench.methods import load
from bench.requests import PicturesRequest, Request
from bench.run_files import METRICS
from scapo.method import AbstractMethod, evenly
from scapo.released import find as find_checkpoint
from scapo.store import StoreError
from scapo.store.checkpoint import check_header
from scapo.store.files import Header


def draw_pictures(request: PicturesRequest) -> Iterator[str]:
    """Draw what the run has; yields the path of each figure, or why it is left out.

    Raises:
        StoreError: No checkpoint, no such data, or predictions of another run.
    """
    request = replace(request, checkpoint=find_checkpoint(request.checkpoint))
    method, header = load(request.checkpoint)
    answered = read_answered(
        Request(
            predictions=request.predictions,
            data=request.data,
            out=request.out,
            split=request.split,
            calibration=request.calibration,
        )
    )
    check_same(request.predictions, answered, header)
    shape = template_shape(method)
    if shape is not None and answered.header.object_frame is not None:
        known = check_header(header, str(request.checkpoint)).alignment
        shape = None if known is None else aligned_shape(shape, known, method.category)
    for name, draw in _figures(request, method, answered, shape).items():
        if isinstance(draw, str):
            yield f"{name}: {draw}"
            continue
        draw(request.out / name)
        yield str(request.out / name)


def _figures(
    request: PicturesRequest,
    method: AbstractMethod,
    answered: Answered,
    shape: TemplateShape | None,
) -> dict[str, Callable[[Path], None] | str]:
    """File name -> what draws it, or why it is left out."""
    run = request.checkpoint if request.checkpoint.is_dir() else request.checkpoint.parent
    samples = evenly(len(answered.points), request.clouds).numpy()
    posed = bool(np.isfinite(answered.mine.pose).any())
    moved = bool(np.isfinite(answered.mine.state).any())
    out: dict[str, Callable[[Path], None] | str] = {
        "overlay.png": "left out, the predictions hold no poses",
        "template.png": f"left out, {method.name} has no template or says no joint states",
        "ranking.png": lambda path: ranking_picture(answered, request.predictions, path),
        "training.png": f"left out, no {METRICS} beside the checkpoint",
    }
    if posed:
        out["overlay.png"] = lambda path: overlay_picture(answered, path, samples)
    if shape is not None and moved:
        out["template.png"] = lambda path: template_picture(
            answered, shape, request.predictions, path
        )
    if (run / METRICS).is_file():
        out["training.png"] = lambda path: training_curve(run / METRICS, path)
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
