# SPDX-License-Identifier: MIT
"""Clouds and depth images from files, by their suffix."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num, UInt8

from bench.infer.cloud import Cloud, InputError, check_count, check_sensor, made_fit
from bench.infer.depth import DEPTH_SUFFIXES, companions, is_companion, read_depth
from bench.infer.pcd import read_pcd

CLOUD_SUFFIXES = (".ply", ".pcd", ".npz")
SUFFIXES = (*CLOUD_SUFFIXES, *DEPTH_SUFFIXES)
VERTICES = re.compile(rb"(?m)^element vertex (\d{1,18})\s*$")
HEADER = 1 << 16
"""Bytes within which the header of a .ply file must end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """What a file does not say itself; numbers that cannot be are an InputError."""

    scale: float | None = None
    """Metres in the unit of the input."""
    intrinsics: str | None = None
    """Of a depth image: fx,fy,cx,cy or a file."""
    mask: Path | None = None
    """Of a depth image: which pixels show the object."""
    sensor: tuple[float, float, float] | None = None
    """Centre of the camera in the cloud's frame, metres."""
    up: tuple[float, float, float] | None = None
    """Against gravity, in the cloud's frame."""

    def __post_init__(self) -> None:
        """Refuse numbers that no unit and no place can be."""
        if self.scale is not None and not (isfinite(self.scale) and self.scale > 0):
            raise InputError(f"--scale: expected a finite number above 0, found {self.scale:g}")
        for name, place in (("sensor", self.sensor), ("up", self.up)):
            if place is not None and not all(map(isfinite, place)):
                found = " ".join(f"{value:g}" for value in place)
                raise InputError(f"--{name}: expected 3 finite numbers, found {found}")
        if self.up is not None and not any(self.up):
            raise InputError("--up: expected a direction, found 0 0 0")


def find_inputs(paths: Sequence[Path]) -> list[Path]:
    """The files, and those of the folders among them that can be read, by name.

    Raises:
        InputError: Nothing there.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        files = sorted(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES)
        inside = [one for one in files if one.is_file() and not is_companion(one)]
        if not inside:
            raise InputError(f"{path}: expected files {' '.join(SUFFIXES)}, found none")
        found += inside
    return found


@np.errstate(all="ignore")  # numbers that are none are left out, and counted in `warnings`
def read_input(path: Path, options: ReadOptions) -> Cloud:
    """The object's cloud of one file.

    Raises:
        InputError: What is wrong with it.
        OSError: It cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: expected one of {' '.join(SUFFIXES)}, found {suffix or 'none'}")
    if not path.is_file():
        raise InputError(f"{path}: expected a file, found none")
    read = _read_depth if suffix in DEPTH_SUFFIXES else _read_cloud
    cloud = read(path, options)
    return cloud if options.up is None else replace(cloud, up=np.array(options.up, np.float64))


def _read_depth(path: Path, options: ReadOptions) -> Cloud:
    if options.sensor is not None:
        raise InputError(
            f"{path}: expected a cloud with --sensor, found a depth image, which is in its "
            "camera's frame"
        )
    beside = companions(path)
    mask = options.mask or beside.mask
    return read_depth(path, options.intrinsics or beside.intrinsics, mask, options.scale)


def _read_cloud(path: Path, options: ReadOptions) -> Cloud:
    if options.mask is not None or options.intrinsics is not None:
        raise InputError(
            f"{path}: expected a depth image with --mask and --intrinsics, found a cloud"
        )
    suffix, sensor = path.suffix.lower(), None
    if suffix == ".ply":
        points, color = _read_ply(path)
    elif suffix == ".pcd":
        found = read_pcd(path)
        points, color, sensor = found.points, found.color, found.sensor
    else:
        points, color, sensor = _read_npz(path)
    if options.sensor is not None:
        sensor = np.array(options.sensor, np.float64)
    elif sensor is not None:
        sensor = sensor * (options.scale or 1.0)
    cloud = made_fit(str(path), points, color, options.scale)
    return check_sensor(replace(cloud, sensor=sensor))


def _read_ply(path: Path) -> tuple[Num[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"] | None]:
    import trimesh

    with path.open("rb") as file:
        head = file.read(HEADER)
        said = VERTICES.search(head)
        if not head.startswith(b"ply") or said is None:
            raise InputError(f"{path}: expected a PLY header with vertices, found none")
        count = int(said[1])
        check_count(str(path), count)
        file.seek(0)
        try:
            loaded: Any = trimesh.load(file, file_type="ply", process=False)
            points = np.asarray(loaded.vertices if count else np.zeros((0, 3)))
        except Exception as error:  # whatever the reader meets in a broken file
            words = f"{type(error).__name__}: {error}"
            raise InputError(f"{path}: expected a readable PLY file, found {words}") from error
    if points.shape != (count, 3):
        raise InputError(f"{path}: expected {count} vertices, found {len(points)}")
    color = getattr(loaded, "colors", None)
    if color is None and getattr(getattr(loaded, "visual", None), "kind", "") == "vertex":
        color = loaded.visual.vertex_colors
    given = color is not None and len(color) == count
    return points, np.asarray(color)[:, :3].astype(np.uint8) if given else None


def _read_npz(
    path: Path,
) -> tuple[Num[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"] | None, np.ndarray | None]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
            arrays = {
                name: _array(path, archive, name)
                for name in ("points", "color", "sensor")
                if name in names
            }
    except InputError:
        raise
    except Exception as error:  # whatever zip, zlib and numpy meet in a broken file
        words = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: expected a readable .npz file, found {words}") from error
    points, color, sensor = (arrays.get(name) for name in ("points", "color", "sensor"))
    if points is None or points.ndim != 2 or points.shape[1] != 3:
        there = ", ".join(names[:9]) or "none"
        found = there if points is None else f"one of shape {points.shape}"
        raise InputError(f"{path}: expected an array points of shape (N, 3), found {found}")
    if color is not None and color.shape != points.shape:
        raise InputError(f"{path}: color: expected shape {points.shape}, found {color.shape}")
    if sensor is not None and (sensor.shape != (3,) or not np.isfinite(sensor).all()):
        raise InputError(f"{path}: sensor: expected 3 finite numbers, found {sensor.shape}")
    if color is not None and color.dtype.kind == "f":  # in [0, 1], or [0, 255]
        color = np.nan_to_num(color * (1.0 if (color > 1).any() else 255.0)).clip(0, 255)
    return points, None if color is None else color.astype(np.uint8), sensor


def _array(path: Path, archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """An array of numbers, its size looked at before it is unpacked: a small file may hold much."""
    with archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else (
            np.lib.format.read_array_header_2_0
        )  # fmt: skip
        shape, _, kind = read(file)
    if kind.kind not in "fiu":
        raise InputError(f"{path}: {name}: expected numbers, found {kind}")
    check_count(str(path), shape[0] if shape else 0)
    if int(np.prod(shape, dtype=object)) > 3 * max(shape[0] if shape else 1, 1):
        raise InputError(f"{path}: {name}: expected three numbers a row, found shape {shape}")
    with archive.open(f"{name}.npy") as file:  # no further than the array: what follows may be much
        return np.lib.format.read_array(file, allow_pickle=False)
