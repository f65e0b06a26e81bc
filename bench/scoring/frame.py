# SPDX-License-Identifier: MIT
"""The object's frame for a method that saw no poses: its alignment, fitted on labelled clouds.

The offsets of part frames that `evaluate --calibration` fits, after one order of the parts for all
clouds; one sense of each joint, and the median of its states' offsets where that fit takes the
mean (docs/protocol.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from bench.matching import choose_order
from bench.requests import Settings
from bench.scoring.calibration import Gathered
from bench.scoring.scores import Frames, label_of, to_arrays
from bench.scoring.truth import Truth
from scapo.alignment import Alignment, LabelledClouds, middle_of_box
from scapo.categories import Category
from scapo.geometry.part_order import confusion, hard_labels
from scapo.types import Prediction

LEAST_SAMPLES = 20
"""Clouds that an alignment is fitted to."""
CLEARER = 0.05
"""Share of the median error of translations that a box's middle has to take away."""


def fit_alignment(
    found: Prediction, truth: Truth, clouds: LabelledClouds, category: Category
) -> Alignment | None:
    """What brings these answers, by the method's own conventions, to the truth.

    Args:
        found: Answers to the clouds of `truth`.
        truth: Labelled.
        clouds: Where they come from.
        category: Theirs.

    Returns:
        None where some part has a pose in fewer than `LEAST_SAMPLES` clouds.
    """
    named = Alignment.of_order(data_order(found, truth), clouds)
    unit = torch.as_tensor(truth.scale)
    rows = to_arrays(named.apply(found, unit, category))
    turns = np.array([spec.kind == "revolute" for spec in category.joints])
    symmetry = None if category.symmetry is None else np.array(category.symmetry, np.float64)
    gathered = Gathered(Frames(symmetry=symmetry, revolute=turns), Settings())
    gathered.add(truth, rows, None)
    poses, _, _ = gathered.fitted()
    if poses is None or poses.answered.min() < LEAST_SAMPLES:
        return None
    zero, votes = np.zeros(len(turns)), np.ones(len(turns))
    if gathered.residual:
        zero = middle(np.concatenate(gathered.residual), turns)
        votes = np.concatenate(gathered.sign).sum(0)
    fixed = replace(
        named,
        own_T_part=tuple(tuple(map(tuple, one)) for one in poses.offsets.tolist()),
        sign=tuple(np.where(votes < 0, -1.0, 1.0).tolist()),
        zero=tuple(zero.tolist()),
    )
    told = fixed.apply(found, unit, category)
    return replace(fixed, origin=origin_of(told, np.concatenate(gathered.true), truth.scale))


def origin_of(
    told: Prediction, true: Float[np.ndarray, "B P 4 4"], scale: Float[np.ndarray, " B"]
) -> tuple[float, float, float] | None:
    """Where the object's origin is from the middle of the box of what is told of its shape.

    Args:
        told: In the object's frame.
        true: Poses of its parts, in the same order.
        scale: Unit of lengths of each cloud, m.

    Returns:
        None where that is told no better by the middle of a box (`CLEARER`).
    """
    if told.camera_T_part is None or told.canonical_points is None:
        return None
    pose = told.camera_T_part.numpy().astype(np.float64)
    away = true[..., :3, 3] - pose[..., :3, 3]
    away = (away[..., None, :] @ pose[..., :3, :3])[..., 0, :] / scale[:, None, None]
    box = middle_of_box(told.canonical_points).numpy() / scale[:, None]
    rest = away - box[:, None]
    constant = np.nanmedian(rest, (0, 1))
    before, after = (
        np.nanmedian(np.linalg.norm(error, axis=-1)) for error in (away, rest - constant)
    )
    return tuple(constant.tolist()) if after < (1 - CLEARER) * before else None


def data_order(found: Prediction, truth: Truth) -> tuple[int, ...]:
    """The part that each slot is in most clouds."""
    rows = to_arrays(found)
    parts = truth.camera_T_part.shape[1]
    counts = confusion(truth.part, hard_labels(label_of(rows)), parts)
    order = choose_order(counts, "dataset", np.zeros(counts.shape))[0]
    return tuple(order.tolist())


def middle(
    residual: Float[np.ndarray, "B J"], revolute: Bool[np.ndarray, " J"]
) -> Float[np.ndarray, " J"]:
    """Medians, of angles about the circular mean; 0 for a joint whose states nobody knows."""
    out = np.zeros(len(revolute))
    for joint, turns in enumerate(revolute):
        known = residual[np.isfinite(residual[:, joint]), joint]
        if len(known) == 0:
            continue
        mean = np.arctan2(np.sin(known).mean(), np.cos(known).mean()) if turns else 0.0
        away = known - mean
        if turns:
            away = (away + np.pi) % (2 * np.pi) - np.pi
        out[joint] = mean + np.median(away)
    return out
