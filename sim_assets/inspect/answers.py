# SPDX-License-Identifier: MIT
"""A predictions file beside the data that it is of, for the viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from scapo.geometry.part_order import hard_labels
from scapo.store import Split, StoreError
from scapo.store.predictions import Header, Predictions, read_prediction_header
from scapo.store.schema import UNLABELLED


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answers:
    """What a method says of every sample of a split."""

    header: Header
    part: UInt8[np.ndarray, "S N"]
    """By the method's own numbers; 255 where it has no answer."""
    pivot: Float[np.ndarray, "S J 3"]
    """Camera frame, m; NaN where there is none, as of the axis."""
    axis: Float[np.ndarray, "S J 3"]

    @property
    def title(self) -> str:
        """Method and variant."""
        return " ".join(filter(None, (self.header.method, self.header.variant)))


def read_answers(path: Path, splits: Mapping[str, Split]) -> tuple[str, Answers]:
    """The predictions, and the name of the split that they are of.

    Args:
        path: Of the file.
        splits: By any names.

    Raises:
        StoreError: Not a predictions file, or of none of the splits.
    """
    header = read_prediction_header(path)
    for name, split in splits.items():
        told = (split.manifest.category, split.manifest.split, split.manifest.digest)
        if told == (header.category, header.split, header.data_digest):
            return name, _read(path, split)
    raise StoreError(
        f"{path}: expected predictions of one of {', '.join(splits)}, found those of "
        f"{header.category}/{header.split} with digest {header.data_digest[:12]}"
    )


def _read(path: Path, split: Split) -> Answers:
    count, joints = split.manifest.count, len(split.manifest.joints)
    with Predictions(path, split) as opened:
        rows = opened.rows(0, count)
        nothing = np.full((count, joints, 3), np.nan)
        label = hard_labels(rows["part"] if "part" in rows else rows["part_weight"])
        axis = rows.get("joint_axis", nothing).astype(float)
        length = np.linalg.norm(axis, axis=-1, keepdims=True)
        return Answers(
            header=opened.header,
            part=np.where(label < 0, UNLABELLED, label).astype(np.uint8),
            pivot=rows.get("joint_pivot", nothing).astype(float),
            axis=np.divide(axis, length, out=np.full_like(axis, np.nan), where=length > 0),
        )
