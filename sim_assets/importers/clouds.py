# SPDX-License-Identifier: MIT
"""What the readers of foreign clouds share: one labelled cloud, and the frames of OP-Align's sets.

Their camera looks along -z with y up (OpenGL); ours along z with y down. Their part frames differ
from ours by a constant turn, chosen so that the swap symmetry that is published for their frames is
that of our object frame: `turned` applies it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from scapo.categories import Category
from scapo.geometry.matrices import rotation_error
from sim_assets.models.validate import AssetError, refuse

OPENCV_T_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
SKEW = 0.02
"""How far a rotation's rows may be from right angles; it is then brought to the nearest one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudFile:
    """One file of a set, which is one sample."""

    path: Path
    name: str
    """Below the set's folder, the same wherever that lies: seeds the choice of points."""
    category: str
    """Ours."""
    split: str
    instance: str
    variant: str = ""
    """Tells data apart that are of one category and split, such as full and partial clouds."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawCloud:
    """All points of one sample; camera frame, metres."""

    points: Float[np.ndarray, "N 3"]
    part: UInt8[np.ndarray, " N"]
    """255: background."""
    color: UInt8[np.ndarray, "N 3"] | None
    camera_T_part: Float[np.ndarray, "P 4 4"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    state: Float[np.ndarray, " J"]
    """NaN: unknown."""
    visible: Float[np.ndarray, " P"]
    """NaN: unknown."""
    camera: tuple[float, float, float, float, float, float]


def shaped(path: Path, record: Any, key: str, shape: tuple[int | str, ...]) -> np.ndarray:  # noqa: ANN401
    """`record[key]` as an array of numbers with this shape; letters match any length.

    Raises:
        AssetError: Naming file, key, what was expected and what was found.
    """
    if not isinstance(record, dict):
        raise refuse(path, "a dict of arrays", type(record).__name__)
    if key not in record:
        raise refuse(path, f"the key {key!r}", ", ".join(sorted(map(str, record))) or "none")
    array = np.asarray(record[key])
    wanted = f"{key!r} as numbers of shape ({', '.join(map(str, shape))})"
    fits = len(array.shape) == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "biuf":
        raise refuse(path, wanted, f"{array.dtype} of shape {array.shape}")
    return array


def finite(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    """The array in float64.

    Raises:
        AssetError: It has NaN or infinite numbers.
    """
    if not np.isfinite(array).all():
        raise refuse(path, f"finite numbers in {key!r}", "others")
    return array.astype(np.float64)


def labels(path: Path, key: str, array: np.ndarray, top: int) -> np.ndarray:
    """Whole numbers from 0 to `top`.

    Raises:
        AssetError: Others.
    """
    values = finite(path, key, array)
    if (values != np.round(values)).any() or values.min() < 0 or values.max() > top:
        found = f"{values.min():g} to {values.max():g}"
        raise refuse(path, f"whole numbers from 0 to {top} in {key!r}", found)
    return values.astype(np.int64)


def rigid(
    path: Path,
    key: str,
    rotation: Float[np.ndarray, "P 3 3"],
    translation: Float[np.ndarray, "P 3"],
) -> Float[np.ndarray, "P 4 4"]:
    """Poses from rotations, brought to the nearest exact one, and translations.

    Raises:
        AssetError: A matrix is no rotation.
    """
    wrong = rotation_error(rotation) > SKEW
    if wrong.any():
        part = int(np.argmax(wrong))
        raise refuse(path, f"a rotation of part {part} in {key!r}", f"{rotation[part].tolist()}")
    left, _, right = np.linalg.svd(rotation)
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3] = left @ right
    poses[:, :3, 3] = translation
    return poses


def units(path: Path, key: str, axes: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
    """Directions brought to length 1.

    Raises:
        AssetError: One has none.
    """
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    if (lengths < 1e-6).any():
        raise refuse(path, f"directions with a length in {key!r}", f"{axes.tolist()}")
    return axes / lengths


def turned(
    poses: Float[np.ndarray, "P 4 4"], theirs_R_ours: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "P 4 4"]:
    """OpenGL poses of their part frames as OpenCV poses of ours."""
    turn = np.eye(4)
    turn[:3, :3] = theirs_R_ours
    return OPENCV_T_OPENGL @ poses @ turn


def flipped(rows: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Points or directions of an OpenGL camera in our camera frame."""
    return rows * np.array([1.0, -1.0, -1.0])


def check_counts(path: Path, category: Category, parts: int, joints: int) -> None:
    """A category has its parts and joints.

    Raises:
        AssetError: Another number.
    """
    wanted = len(category.parts), len(category.joints)
    if (parts, joints) != wanted:
        expected = f"{wanted[0]} parts and {wanted[1]} joints of {category.name!r}"
        raise refuse(path, expected, f"{parts} and {joints}")


def find_files(path: Path, ending: str) -> list[Path]:
    """Files below a path with this ending, hidden ones left alone, sorted.

    Raises:
        AssetError: No such folder, or none in it.
    """
    if not path.is_dir():
        raise refuse(path, "a folder", "a file" if path.exists() else "nothing")
    found = [
        file
        for file in path.rglob(f"*{ending}")
        if not file.is_dir() and not any(p.startswith(".") for p in file.relative_to(path).parts)
    ]
    if not found:
        raise refuse(path, f"{ending} files in the folder", "none")
    return sorted(found)


def misplaced(path: Path, layout: str) -> AssetError:
    """The refusal of a file that is not where its set has files."""
    return refuse(path, f"a place like {layout}", "another")
