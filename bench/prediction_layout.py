# SPDX-License-Identifier: MIT
"""Which tensors a predictions file may hold, and which values an answer may have (CONTRACT 3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Num

from bench.compat import RECORD
from scapo.data import UNLABELLED
from scapo.store import Split, StoreError

_FLOAT = ("F32",)
_HALF_OR_FLOAT = ("F16", "F32")
_NUMBER = ("F16", "F32", "F64")

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R^T - I and of the last row minus 0 0 0 1."""
WEIGHT_TOLERANCE = {np.dtype(np.float16): 4e-3, np.dtype(np.float32): 1e-3}
"""Of the sum of a point's weights; half precision keeps 11 bits of each."""


def check_tensors(where: str, file: Any, split: Split) -> dict[str, Any]:  # noqa: ANN401
    """The slices of an open safetensors file after checking names, dtypes and shapes.

    Raises:
        StoreError: A tensor is missing, unknown, of another type or shape.
    """
    count, n = split.manifest.count, split.manifest.points
    p, j = len(split.manifest.parts), len(split.manifest.joints)
    layout: dict[str, tuple[tuple[str, ...], tuple[int | None, ...]]] = {
        "part": (("U8",), (count, n)),
        "part_weight": (_HALF_OR_FLOAT, (count, n, p)),
        "camera_T_part": (_FLOAT, (count, p, 4, 4)),
        "joint_pivot": (_FLOAT, (count, j, 3)),
        "joint_axis": (_FLOAT, (count, j, 3)),
        "joint_state": (_FLOAT, (count, j)),
        "canonical_points": (_FLOAT, (count, None, 3)),
        **{f"record_{name}": (_NUMBER, (count, *_record_shape(name, j))) for name in RECORD},
        "record_expand": (_NUMBER, (count,)),
        "record_center": (_NUMBER, (count, 3)),
    }
    slices: dict[str, Any] = {}
    for name in file.keys():  # noqa: SIM118 - an open file, not a dict
        item = file.get_slice(name)
        expected = layout.get(name)
        if expected is None and name.startswith("confidence_"):
            expected = (_HALF_OR_FLOAT, (count, *item.get_shape()[1:]))
        if expected is None:
            raise StoreError(
                f"{where}: expected tensors {', '.join(layout)} or confidence_*, found {name!r}"
            )
        _check_tensor(f"{where}: tensor {name!r}", item, *expected)
        slices[name] = item
    if ("part" in slices) == ("part_weight" in slices):
        found = "both" if "part" in slices else f"{', '.join(sorted(slices)) or 'no tensor'}"
        raise StoreError(
            f"{where}: expected one of the tensors 'part' and 'part_weight', found {found}"
        )
    return slices


def _record_shape(name: str, joints: int) -> tuple[int, ...]:
    if name == "R_select":
        return (3, 3)
    if name == "T_select":
        return (3,)
    return (joints, 2) if name.endswith("angl") else (joints, 3)


def _check_tensor(
    where: str,
    item: Any,  # noqa: ANN401
    dtypes: tuple[str, ...],
    shape: tuple[int | None, ...],
) -> None:
    found, dtype = tuple(item.get_shape()), item.get_dtype()
    if dtype not in dtypes:
        raise StoreError(f"{where}: expected dtype {' or '.join(dtypes)}, found {dtype}")
    fits = len(found) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, found, strict=True)
    )
    if not fits or 0 in found[1:]:
        wanted = tuple("*" if want is None else want for want in shape)
        raise StoreError(f"{where}: expected shape {wanted}, found {found}")


def check_rows(
    where: str, name: str, array: np.ndarray, first: int, parts: int
) -> tuple[np.ndarray, int]:
    """A block of one tensor after checking its values, and how many samples have no answer.

    Args:
        where: File and tensor, for the message.
        name: Of the tensor.
        array: Rows of consecutive samples.
        first: Index of the first of them, for the message.
        parts: P.

    Raises:
        StoreError: A value that no answer can have, naming the sample.
    """
    if name == "part":
        return _check_labels(where, array, first, parts)
    flat = array.reshape(len(array), -1)
    missing = np.isnan(flat).all(1)
    finite = np.isfinite(flat).all(1)
    _refuse(
        np.asarray(~(finite | missing)),
        where,
        first,
        "finite values or a row of NaN alone",
        lambda i: "some NaN" if np.isnan(flat[i]).any() else "an infinite value",
    )
    known = np.flatnonzero(finite)
    if name == "part_weight":
        _check_weights(where, array, known, first)
    if name == "camera_T_part":
        _check_poses(where, array, known, first)
    return array, int(missing.sum())


def _refuse(
    wrong: Bool[np.ndarray, " B"],
    where: str,
    first: int,
    expected: str,
    found: Callable[[int], str],
) -> None:
    if wrong.any():
        index = int(wrong.argmax())
        raise StoreError(
            f"{where}: sample {first + index}: expected {expected}, found {found(index)}"
        )


def _check_labels(
    where: str, array: Num[np.ndarray, "B N"], first: int, parts: int
) -> tuple[np.ndarray, int]:
    """255 says that the point belongs to no part; a row of nothing else is no answer."""
    none = array == UNLABELLED
    outside = (array >= parts) & ~none
    _refuse(
        outside.any(1),
        where,
        first,
        f"labels 0..{parts - 1} or {UNLABELLED}",
        lambda i: str(int(array[i][outside[i]][0])),
    )
    part = array.astype(np.int16)
    part[none] = -1
    return part, int(none.all(1).sum())


def _check_weights(where: str, array: np.ndarray, known: np.ndarray, first: int) -> None:
    weights = array.astype(np.float32, copy=False)
    tolerance = WEIGHT_TOLERANCE[array.dtype]
    wrong = np.zeros(len(array), bool)
    total = sum(weights[..., k] for k in range(weights.shape[-1]))
    lowest = weights.min(axis=(1, 2))
    wrong[known] = lowest[known] < -tolerance
    _refuse(wrong, where, first, "weights of 0 or more", lambda i: f"{lowest[i]:.4g}")
    error = np.abs(total - np.float32(1)).max(1)
    wrong[known] = error[known] > tolerance
    _refuse(
        wrong,
        where,
        first,
        f"weights of a point to sum to 1 within {tolerance}",
        lambda i: f"an error of {error[i]:.4g}",
    )


def _check_poses(where: str, array: np.ndarray, known: np.ndarray, first: int) -> None:
    rotation = array[known][..., :3, :3].astype(np.float64)
    product = rotation @ np.swapaxes(rotation, -1, -2)
    off = np.abs(product - np.eye(3)).max((-1, -2))
    worst = np.zeros(len(array))
    worst[known] = np.where(np.linalg.det(rotation) > 0, off, 2.0).max(1)
    _refuse(
        worst > ROTATION_TOLERANCE,
        where,
        first,
        f"rotations with R R^T = I within {ROTATION_TOLERANCE} and det R = 1",
        lambda i: f"an error of {worst[i]:.4g}" if worst[i] != 2 else "a reflection",
    )
    last = np.zeros(len(array))
    last[known] = np.abs(array[known][..., 3, :] - np.array([0, 0, 0, 1])).max((-1, -2))
    _refuse(
        last > ROTATION_TOLERANCE,
        where,
        first,
        "a last row 0 0 0 1",
        lambda i: f"an error of {last[i]:.4g}",
    )
