# SPDX-License-Identifier: MIT
"""The truth of a split in blocks of bounded size, whatever the size of its shards."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open

from scapo.store import SAMPLES, Split, StoreError, read_header
from scapo.store.definitions import known_category
from scapo.store.files import require
from scapo.store.manifest import Manifest
from scapo.store.schema import ALIKE, TENSORS, UNLABELLED, check_samples

BLOCK = 1024
"""Samples in memory at a time."""

NAMES = tuple(name for name in TENSORS if name != "camera")
"""What scoring reads of every shard."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alike:
    """The turns of the true object that look as it does (docs/ambiguity.md)."""

    turns: Bool[np.ndarray, "B 24"]
    camera_T_base: Float[np.ndarray, "B 24 4 4"]
    state: Float[np.ndarray, "B 24 J"]
    part: Int[np.ndarray, "B 24 P"]
    """The true part in whose place part p of the turned object is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Consecutive samples of one split. Camera frame, metres, radians."""

    first: int
    points: Float[np.ndarray, "B N 3"]
    part: Int[np.ndarray, "B N"]
    """-1 = background or unlabelled."""
    camera_T_part: Float[np.ndarray, "B P 4 4"]
    joint_pivot: Float[np.ndarray, "B J 3"]
    joint_axis: Float[np.ndarray, "B J 3"]
    joint_state: Float[np.ndarray, "B J"]
    visible: Float[np.ndarray, "B P"]
    instance: Int[np.ndarray, " B"]
    scale: Float[np.ndarray, " B"]
    """Metres of one unit `r4`: 4 x the mean distance of the cloud's points from their centroid."""
    alike: Alike | None = None
    """None where the data do not say."""

    def __len__(self) -> int:
        return len(self.instance)


def symmetry(manifest: Manifest) -> Float[np.ndarray, "3 3"] | None:
    """The rotation of the object frame that exchanges the parts, None where there is none."""
    known = known_category(manifest)
    if known is None or known.symmetry is None:
        return None
    return np.array(known.symmetry, np.float64)


def revolute(manifest: Manifest) -> np.ndarray:
    """Which joints turn, (J,) bool."""
    return np.array([joint.kind == "revolute" for joint in manifest.joints])


def blocks(split: Split, size: int = BLOCK) -> Iterator[Truth]:
    """The split's samples in order, at most `size` at a time.

    Raises:
        StoreError: A shard is missing, or not what the manifest and the layout say.
    """
    for shard in split.manifest.shards:
        path = split.folder / shard.file
        split.check_header(path, read_header(path, SAMPLES))
        try:
            with safe_open(path, "numpy") as file:
                there = set(file.keys())
                names = (*NAMES, *(ALIKE if there & {*ALIKE} else ()))
                require(path, names, there)
                slices = {name: file.get_slice(name) for name in names}
                for start in range(0, shard.count, size):
                    last = start + size >= shard.count  # with all that there is: check_samples
                    rows = {n: x[start : None if last else start + size] for n, x in slices.items()}
                    count = min(size, shard.count - start)
                    check_samples(path, rows, split.manifest, shard.first + start, count)
                    yield truth_of(path, shard.first + start, rows)
        except SafetensorError as error:
            raise StoreError(f"{path}: expected readable tensors, found {error}") from error


def truth_of(path: Path, first: int, rows: dict[str, np.ndarray]) -> Truth:
    """Samples as they are on disk, from `first` on, as float64 with their scale.

    Raises:
        StoreError: Points that are all the same.
    """
    points = rows["points"]
    centred = points - points.mean(1, keepdims=True, dtype=np.float64).astype(np.float32)
    radius = np.sqrt(np.einsum("bnc,bnc->bn", centred, centred)).mean(1, dtype=np.float64)
    if not radius.all():
        raise StoreError(
            f"{path}: sample {first + int(radius.argmin())}: expected points that differ, "
            "found mean radius 0"
        )
    part = rows["part"].astype(np.int16)
    part[part == UNLABELLED] = -1
    wide = {
        name: rows[name].astype(np.float64)
        for name in ("camera_T_part", "joint_pivot", "joint_axis", "joint_state", "visible")
    }
    return Truth(
        first=first,
        points=points,
        part=part,
        instance=rows["instance"].astype(np.int64),
        scale=4 * radius,
        alike=_alike(rows) if "alike" in rows else None,
        **wide,
    )


def _alike(rows: dict[str, np.ndarray]) -> Alike:
    return Alike(
        turns=rows["alike"] == 1,
        camera_T_base=rows["alike_base"].astype(np.float64),
        state=rows["alike_state"].astype(np.float64),
        part=rows["alike_part"].astype(np.int64),
    )
