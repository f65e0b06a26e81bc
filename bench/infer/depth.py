# SPDX-License-Identifier: MIT
"""The object of a depth image: intrinsics, depth in metres, mask, and its points.

Beside `NAME.png` may lie `NAME.mask.png`, and `NAME.json`, `NAME.yaml`, `intrinsics.json` or
`intrinsics.yaml` with the camera; they are used where no flag says otherwise. `NAME.rgb.png` may
lie there too and is not looked at.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees, isfinite
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float

from bench.infer.cloud import Cloud, InputError, made_fit
from bench.infer.cluster import nearest_object
from scapo.geometry.camera import Intrinsics, back_project

DEPTH_SUFFIXES = (".png", ".tif", ".tiff")
CAMERA_SUFFIXES = (".json", ".yaml", ".yml")
MOST_PIXELS = 64_000_000
MILLIMETRES = 0.001
"""Scale of an image of whole numbers that does not say otherwise."""
NEAREST, FARTHEST = 0.02, 50.0
"""Metres between which the middle of an image's depths lies."""
FIELD_OF_VIEW = (5.0, 170.0)
"""Degrees, of either side of an image."""
MOST_STRETCH = 1.5
"""Of fx and fy: pixels are about square."""
OPENCV = re.compile(r"\A%YAML:.*|!!opencv-[\w-]+")
"""What its FileStorage writes beside YAML."""
SIZES = (("width", "image_width"), ("height", "image_height"))
"""What files of cameras call the sides of their image."""
MATRICES = ("K", "k", "cam_K", "camera_matrix", "intrinsic_matrix", "intrinsics")


@dataclass(frozen=True, slots=True, kw_only=True)
class Companions:
    """What lies beside a depth image."""

    mask: Path | None
    intrinsics: str | None


def companions(path: Path) -> Companions:
    """Mask and camera of a depth image, by their names."""
    mask = path.with_name(f"{path.stem}.mask.png")
    cameras = [path.with_name(f"{stem}{suffix}")
               for stem in (path.stem, "intrinsics") for suffix in CAMERA_SUFFIXES]  # fmt: skip
    camera = next((str(one) for one in cameras if one.is_file()), None)
    return Companions(mask=mask if mask.is_file() else None, intrinsics=camera)


def is_companion(path: Path) -> bool:
    """Whether a file is a mask or a colour image by its name."""
    return path.name.endswith((".mask.png", ".rgb.png"))


def read_depth(path: Path, intrinsics: str | None, mask: Path | None, scale: float | None) -> Cloud:
    """The object's points.

    Args:
        path: Of an image of whole numbers (PNG, TIFF) or of floats (TIFF); 0 and NaN: not seen.
        intrinsics: fx,fy,cx,cy in pixels, or a JSON or YAML file.
        mask: Of an image of the same size, 0 where the object is not; None: it is looked for.
        scale: Metres in its unit; None: 0.001 for whole numbers, 1 for floats.

    Raises:
        InputError: What is wrong with which of them.
    """
    depth = depth_in_metres(path, scale)
    if intrinsics is None:
        raise InputError(f"{path}: expected --intrinsics fx,fy,cx,cy or a file beside it, found "
                         "none")  # fmt: skip
    camera = read_intrinsics(intrinsics, depth.shape[1], depth.shape[0])
    seen = np.isfinite(depth) & (depth > 0)
    if not seen.any():
        raise InputError(f"{path}: expected depths above 0, found none")
    middle = float(np.median(depth[seen]))
    if not NEAREST < middle < FARTHEST:
        raise InputError(
            f"{path}: expected depths of {NEAREST} to {FARTHEST} m, found {middle:.3g} m in the "
            "middle; --scale says how many metres its unit has"
        )
    if mask is None:
        shown, words = nearest_object(np.where(seen, depth, 0.0), camera)
    else:
        shown, words = read_mask(mask, depth.shape) & seen, ()
    if not shown.any():
        raise InputError(f"{mask or path}: expected pixels of the object with a depth, found none")
    points = back_project(np.where(seen, depth, 0.0), shown, camera)
    return made_fit(str(path), points.astype(np.float64), None, 1.0).warned(*words)


def _pixels(path: Path, what: str) -> np.ndarray:
    """The values of an image with one channel.

    Raises:
        InputError: No image, a large one, one of colours.
    """
    from PIL import Image

    if not path.is_file():
        raise InputError(
            f"{path}: expected {what}, found {'a folder' if path.is_dir() else 'none'}"
        )
    try:
        with warnings.catch_warnings(), Image.open(path, formats=("PNG", "TIFF")) as image:
            if image.width * image.height > MOST_PIXELS:
                size = f"{image.width} x {image.height}"
                raise InputError(f"{path}: expected at most {MOST_PIXELS:,} pixels, found {size}")
            warnings.simplefilter("ignore")  # of tags that nobody asks about
            # Of a palette the colours are meant: its numbers may stand for them in any order.
            return np.asarray(image.convert("RGB") if image.mode == "P" else image)
    except InputError:
        raise
    except Exception as error:  # whatever the reader meets in a broken file
        raise InputError(f"{path}: expected {what}, found {error}") from error


def depth_in_metres(path: Path, scale: float | None) -> Float[np.ndarray, "H W"]:
    """Depths of an image.

    Raises:
        InputError: No depth image.
    """
    values = _pixels(path, "a readable depth image")
    wide = values.dtype.kind == "f" or (values.dtype.kind in "iu" and values.dtype.itemsize > 1)
    if values.ndim != 2 or not wide:
        raise InputError(
            f"{path}: expected a depth image of 16 bits or floats and one channel, found "
            f"{values.dtype} of shape {values.shape}"
        )
    usual = 1.0 if values.dtype.kind == "f" else MILLIMETRES
    return values.astype(np.float64) * (usual if scale is None else scale)


def read_mask(path: Path, shape: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    """Where an image is not 0, in any channel but transparency.

    Raises:
        InputError: Another size, or no image.
    """
    values = _pixels(path, "a readable mask")
    if values.shape[:2] != tuple(shape):
        raise InputError(
            f"{path}: expected a mask of the depth image's size, {shape[1]} x {shape[0]}, found "
            f"{values.shape[1]} x {values.shape[0]}"
        )
    if values.ndim == 3:
        values = values[..., : 1 if values.shape[-1] == 2 else 3].any(-1)  # grey with alpha, RGB(A)
    return np.asarray(values, bool)


def read_intrinsics(text: str, width: int, height: int) -> Intrinsics:
    """The camera of an image of this size.

    Raises:
        InputError: No four numbers and no such file, or no camera of this image.
    """
    values = _numbers(text) if "," in text else _from_file(Path(text), (width, height))
    fx, fy, cx, cy = values
    where = f"--intrinsics {text}"
    if not all(isfinite(value) for value in values) or min(fx, fy) <= 0:
        raise InputError(f"{where}: expected finite fx, fy > 0, cx, cy, found {values}")
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise InputError(
            f"{where}: expected a principal point in the image of {width} x {height}, found "
            f"{cx:g}, {cy:g}: of another resolution, or in another order than fx,fy,cx,cy?"
        )
    views = [degrees(2 * np.arctan(size / 2 / f)) for size, f in ((width, fx), (height, fy))]
    low, high = FIELD_OF_VIEW
    if not all(low < view < high for view in views) or not (
        1 / MOST_STRETCH < fx / fy < MOST_STRETCH
    ):
        raise InputError(
            f"{where}: expected about square pixels and a field of view of {low:g} to {high:g} "
            f"degrees for {width} x {height}, found {views[0]:.3g} x {views[1]:.3g}"
        )
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def _numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(value) for value in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 4:
        raise InputError(f"--intrinsics {text}: expected four numbers fx,fy,cx,cy or a file")
    return values


def _from_file(path: Path, size: tuple[int, int]) -> tuple[float, ...]:
    """From the names that calibrations use: a matrix K (rows; Open3D's columns), or fx, fy, ..."""
    import yaml  # also reads JSON

    if not path.is_file():
        raise InputError(f"--intrinsics {path}: expected fx,fy,cx,cy or a file, found neither")
    try:
        text = path.read_text(encoding="utf-8")[: 1 << 20]
        record = yaml.safe_load(OPENCV.sub("", text))
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON or YAML, found {_problem(error)}") from error
    named = cast("Mapping[str, Any]", record) if isinstance(record, Mapping) else {}
    _check_size(path, named, size)
    for name in MATRICES:
        if name not in named:
            continue
        found = _matrix(named[name])
        if found is not None:
            matrix = found.T if name == "intrinsic_matrix" else found
            return tuple(float(x) for x in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
        named = named[name] if isinstance(named[name], Mapping) else named
    names = [("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy")]
    values = [next((named[n] for n in options if n in named), None) for options in names]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        whole = all(any(n in named for n in options) for options in names)
        found = f"the values {values}" if whole else f"{list(named)[:9]}"
        raise InputError(f"{path}: expected a matrix K or numbers fx, fy, cx, cy, found {found}")
    return tuple(float(cast("float", value)) for value in values)


def _check_size(path: Path, named: Mapping[str, Any], size: tuple[int, int]) -> None:
    """Refuse the camera of an image of another width or height, where the file says them.

    Raises:
        InputError: It does.
    """
    said = [next((named[name] for name in names if name in named), None) for names in SIZES]
    pairs = zip(said, size, strict=True)
    if any(isinstance(one, int | float) and one != side for one, side in pairs):
        found = " x ".join("?" if one is None else str(one) for one in said)
        raise InputError(
            f"{path}: expected the camera of an image of {size[0]} x {size[1]}, found that of one "
            f"of {found}"
        )


def _problem(error: Exception) -> str:
    """What a parser says, in a line: of YAML the problem and its place, without the text around."""
    from yaml import MarkedYAMLError

    if not isinstance(error, MarkedYAMLError) or error.problem_mark is None:
        return str(error)
    mark = error.problem_mark
    return f"{error.problem} in line {mark.line + 1}, column {mark.column + 1}"


def _matrix(value: object) -> np.ndarray | None:
    """Nine numbers in rows, flat, or as `data` of a record; None where it is something else."""
    inner = value["data"] if isinstance(value, Mapping) and "data" in value else value
    try:
        numbers = np.asarray(inner, np.float64)
    except (TypeError, ValueError):
        return None
    return numbers.reshape(3, 3) if numbers.size == 9 else None
