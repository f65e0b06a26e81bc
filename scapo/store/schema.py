# SPDX-License-Identifier: MIT
"""What a shard of samples holds, tensor by tensor, and the check that it does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from scapo.geometry.matrices import is_rigid
from scapo.store.json_records import StoreError
from scapo.store.manifest import Manifest

__all__ = ["LAYOUT", "UNLABELLED", "StoreError", "check_samples", "check_shape", "sample_shapes"]

UNLABELLED = 255
"""Part index of background and unlabelled points on disk; -1 in memory."""

TOLERANCE = 1e-3
"""Of unit axes and of rotation matrices."""

LAYOUT: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "points": ("float32", ("N", 3)),
    "color": ("uint8", ("N", 3)),
    "part": ("uint8", ("N",)),
    "camera_T_part": ("float32", ("P", 4, 4)),
    "joint_pivot": ("float32", ("J", 3)),
    "joint_axis": ("float32", ("J", 3)),
    "joint_state": ("float32", ("J",)),
    "visible": ("float32", ("P",)),
    "camera": ("float32", (6,)),
    "instance": ("int32", ()),
    "sensor": ("float32", (3,)),
    "alike": ("uint8", (24,)),
    "alike_base": ("float32", (24, 4, 4)),
    "alike_state": ("float32", (24, "J")),
    "alike_part": ("uint8", (24, "P")),
}
"""dtype and shape of one sample's tensors; on disk the samples of a shard are stacked. `color` is
optional, and so are `sensor`, the camera's centre in metres where clouds are not in its frame, and
the four of ambiguity (docs/ambiguity.md)."""
ALIKE = ("alike", "alike_base", "alike_state", "alike_part")
"""The tensors of ambiguity, all there or none."""
OPTIONAL = ("color", "sensor")
TENSORS = tuple(name for name in LAYOUT if name not in (*OPTIONAL, *ALIKE))
"""What every shard has."""


@runtime_checkable
class Shaped(Protocol):
    """Anything with a shape: numpy or torch."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the dimensions."""
        ...


def sample_shapes(manifest: Manifest, count: int) -> dict[str, tuple[int, ...]]:
    """Expected shape of each tensor for `count` samples."""
    length = {"N": manifest.points, "P": len(manifest.parts), "J": len(manifest.joints)}
    return {
        name: (count, *(length[dim] if isinstance(dim, str) else dim for dim in dims))
        for name, (_, dims) in LAYOUT.items()
    }


def check_shape(
    path: Path, name: str, array: Shaped, expected: tuple[int | None, ...] | None
) -> None:
    """Refuse an array of another shape; None matches any length.

    Raises:
        StoreError: Naming file, tensor, expected and found shape.
    """
    if expected is None:
        return
    fits = len(expected) == len(array.shape) and all(
        want in (None, have) for want, have in zip(expected, array.shape, strict=True)
    )
    if not fits:
        shape = tuple("*" if want is None else want for want in expected)
        raise StoreError(
            f"{path}: tensor {name!r}: expected shape {shape}, found {tuple(array.shape)}"
        )


def check_samples(
    path: Path, arrays: Mapping[str, np.ndarray], manifest: Manifest, first: int, count: int
) -> None:
    """Refuse a shard's tensors unless dtypes, shapes and values are possible; extra ones pass.

    Args:
        path: Of the shard, for the message.
        arrays: Its tensors, or some of them.
        manifest: Of the split.
        first: Number of the shard's first sample, for the message.
        count: Of its samples.

    Raises:
        StoreError: Naming file, tensor, sample, what was expected and what was found.
    """
    shapes = sample_shapes(manifest, count)
    for name, array in arrays.items():
        if name not in LAYOUT:
            continue
        if array.dtype != LAYOUT[name][0]:
            raise StoreError(
                f"{path}: tensor {name!r}: expected dtype {LAYOUT[name][0]}, found {array.dtype}"
            )
        check_shape(path, name, array, shapes[name])
        turns = name in ("alike", "alike_part")
        expected, bad = (_impossible_turns if turns else _impossible)(name, array, manifest)
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            place = f"sample {first + at[0]}" + "".join(f"[{i}]" for i in at[1:])
            found = np.array2string(np.asarray(array[at]), precision=4, separator=", ").replace(
                "\n", ""
            )
            raise StoreError(
                f"{path}: tensor {name!r}, {place}: expected {expected}, found {found}"
            )


def _impossible_turns(name: str, array: np.ndarray, manifest: Manifest) -> tuple[str, np.ndarray]:
    """As `_impossible`, of the turns that look alike."""
    del manifest
    index = np.arange(array.shape[-1])
    if name == "alike":  # no turn at all always looks alike
        return "0 or 1, and 1 for the first turn", (array > 1) | ((index == 0) & (array != 1))
    return "every part once", np.asarray((np.sort(array, -1) != index).any(-1))


def _impossible(name: str, array: np.ndarray, manifest: Manifest) -> tuple[str, np.ndarray]:
    """What each value must be, and a mask over the leading dimensions of those that are not."""
    if name == "part":
        top = len(manifest.parts)
        return f"an index below {top} or {UNLABELLED}", (array >= top) & (array != UNLABELLED)
    if name == "instance":
        top = len(manifest.instances)
        return f"an index below {top}", (array < 0) | (array >= top)
    if name == "joint_state":  # scans of real objects have no rest to count it from
        return "a finite number, or NaN", np.isinf(array)
    if name == "visible":  # nor the surface that is not seen
        return "a share between 0 and 1, or NaN", (array < 0) | (array > 1 + TOLERANCE)
    if name == "joint_axis":
        with np.errstate(over="ignore"):
            norm = np.linalg.norm(array, axis=-1)
        return "a unit vector", ~(abs(norm - 1) < TOLERANCE)
    if name in ("camera_T_part", "alike_base"):
        return "a rigid motion", ~is_rigid(array, TOLERANCE)
    if name == "camera":
        lower = np.array([0, 0, -np.inf, -np.inf, 0, 0])
        wanted = "fx, fy, cx, cy, width, height with positive focal lengths and size"
        return wanted, ~np.all((array > lower) & np.isfinite(array), axis=-1)
    return "a finite number", ~np.isfinite(array)
