# SPDX-License-Identifier: MIT
"""A predictions file beside the truth, in the true frames and in predicted slots, in memory."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

from bench.analysis.ladder import Pieces, predicted_pieces, true_pieces
from bench.scoring.evaluate import Prepared, Request, fit_frames, open_data
from bench.scoring.scores import Errors, agreement_of, label_of, score
from bench.scoring.truth import Truth, blocks
from scapo.geometry.part_order import hard_labels
from scapo.store import Split
from scapo.store.predictions import Header, Predictions


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered:
    """All samples of a split. Camera frame, metres."""

    header: Header
    split: Split
    fitted: Prepared
    points: Float[np.ndarray, "S N 3"]
    part_true: Int[np.ndarray, "S N"]
    """The slot that each point's true part is compared with; -1 = background."""
    part: Int[np.ndarray, "S N"]
    """Predicted slot; -1 = no answer."""
    true: Pieces
    mine: Pieces
    """Calibrated, where that was asked for."""
    errors: Errors
    scale: Float[np.ndarray, " S"]
    """Metres of one `r4`."""
    instance: Int[np.ndarray, " S"]
    order: Int[np.ndarray, "S P"]
    """The true part compared with each slot."""


def read_answered(request: Request) -> Answered:
    """Predictions, truth and errors of a whole split.

    Raises:
        StoreError: As `evaluate`.
    """
    header, split = open_data(request)
    found: list[tuple[Truth, np.ndarray, np.ndarray, Pieces, Pieces, Errors]] = []
    with Predictions(request.predictions, split) as predictions:
        fitted = fit_frames(request, header, split, predictions)
        frames, settings = fitted.frames, request.settings
        for truth in blocks(split):
            rows = predictions.rows(truth.first, len(truth))
            order = agreement_of(truth, rows, settings, fitted.order).order
            errors = score(truth, rows, settings=settings, frames=frames, order=fitted.order)
            true = true_pieces(truth, order, frames)
            mine = predicted_pieces(truth, rows, order, frames)
            found.append((truth, order, hard_labels(label_of(rows)), true, mine, errors))
        predictions.finish()
    truths, orders, parts, true, mine, errors = zip(*found, strict=True)
    order = np.concatenate(orders)
    return Answered(
        header=header,
        split=split,
        fitted=fitted,
        points=np.concatenate([truth.points for truth in truths]),
        part_true=slots(np.concatenate([truth.part for truth in truths]), order),
        part=np.concatenate(parts),
        true=_joined(true),
        mine=_joined(mine),
        errors={key: np.concatenate([item[key] for item in errors]) for key in errors[0]},
        scale=np.concatenate([truth.scale for truth in truths]),
        instance=np.concatenate([truth.instance for truth in truths]),
        order=order,
    )


def slots(part: Int[np.ndarray, "B N"], order: Int[np.ndarray, "B P"]) -> Int[np.ndarray, "B N"]:
    """The slot that is compared with each point's true part; negative parts stay."""
    slot = np.argsort(order, axis=1)
    named = np.take_along_axis(slot, np.maximum(part, 0).astype(np.int64), 1)
    return np.where(part < 0, -1, named)


def _joined(pieces: tuple[Pieces, ...]) -> Pieces:
    return Pieces(
        **{f.name: np.concatenate([getattr(p, f.name) for p in pieces]) for f in fields(Pieces)}
    )
