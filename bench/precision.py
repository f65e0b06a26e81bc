# SPDX-License-Identifier: MIT
"""Average precision of Table 2: shares of samples within limits (PROTOCOL 1.8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Num

ApRule = Literal["mean", "min", "per-part"]


def average_precision(
    *,
    iou: np.ndarray,
    part_rotation: np.ndarray,
    part_translation: np.ndarray,
    joint_direction: np.ndarray,
    joint_pivot: np.ndarray,
    rule: str = "mean",
) -> dict[str, float]:
    """Shares of Table 2 (PROTOCOL 1.8): IoU over 75 and 50 %, errors under k degrees and k cm.

    `mean`: per sample, the mean over its parts (joints) of each error is compared. `min`: every
    part (joint) must pass. `per-part`: parts (joints) are counted one by one. Comparisons are
    strict. An undefined error fails; an undefined IoU (the part neither there nor predicted) is
    left out of its sample's mean or minimum, and fails where the sample has no other.

    Args:
        iou: (B, P).
        part_rotation: (B, P), degrees.
        part_translation: (B, P), metres.
        joint_direction: (B, J), degrees.
        joint_pivot: (B, J), metres.
        rule: How the parts of a sample join.

    Returns:
        `seg_75, seg_50, joint_5, joint_10, joint_15, part_5, part_10, part_15` as fractions; NaN
        for an empty batch.
    """
    passed = precision_passes(
        iou=iou,
        part_rotation=part_rotation,
        part_translation=part_translation,
        joint_direction=joint_direction,
        joint_pivot=joint_pivot,
        rule=rule,
    )
    return {name: float(p.mean()) if p.size else float("nan") for name, p in passed.items()}


def precision_passes(
    *,
    iou: np.ndarray,
    part_rotation: np.ndarray,
    part_translation: np.ndarray,
    joint_direction: np.ndarray,
    joint_pivot: np.ndarray,
    rule: str = "mean",
) -> dict[str, np.ndarray]:
    """What `average_precision` counts: bool (B,), or (B, P) and (B, J) for `per-part`."""
    rule_name = rule.replace("_", "-")
    if rule_name not in ("mean", "min", "per-part"):
        raise ValueError(f"rule: expected mean, min or per-part, found {rule!r}")
    joined = _Join(rule_name)
    overlaps = joined.iou(np.asarray(iou, np.float64))
    out = {f"seg_{k}": overlaps > k / 100 for k in (75, 50)}
    for name, angle, length in (
        ("joint", joint_direction, joint_pivot),
        ("part", part_rotation, part_translation),
    ):
        degrees, metres = joined.errors(np.asarray(angle)), joined.errors(np.asarray(length))
        for k in (5, 10, 15):
            out[f"{name}_{k}"] = (degrees < k) & (metres < k / 100)
    return out


@dataclass(frozen=True, slots=True)
class _Join:
    """How the values of one sample's slots become what is compared."""

    rule: str

    def iou(self, values: Float[np.ndarray, "B P"]) -> np.ndarray:
        if self.rule == "per-part":
            return values
        defined = ~np.isnan(values)
        if self.rule == "min":
            lowest = np.where(defined, values, np.inf).min(1)
            return np.where(defined.any(1), lowest, np.nan)
        total = np.where(defined, values, 0).sum(1)
        return np.where(defined.any(1), total / np.maximum(defined.sum(1), 1), np.nan)

    def errors(self, values: Num[np.ndarray, "B K"]) -> np.ndarray:
        if self.rule == "per-part":
            return values
        return values.max(1) if self.rule == "min" else values.mean(1)
