# SPDX-License-Identifier: MIT
"""Point Cloud Data files (PCL, version 0.7), ascii, binary and binary_compressed.

The libraries that read them pull in a good deal for what is a header and a table.
"""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from bench.infer.cloud import InputError, check_count

HEADER = 1 << 16
"""Bytes within which a header must end."""
DATA = re.compile(rb"(?m)^DATA[ \t]+(\w+)[ \t]*\r?\n")
KINDS = {"F": "f", "U": "u", "I": "i"}
XYZ = ("x", "y", "z")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    names: tuple[str, ...]
    types: tuple[np.dtype, ...]
    """Of each field; a field of several values is an array."""
    count: int
    viewpoint: tuple[float, ...]
    """x y z of the sensor, and its rotation as w x y z."""
    data: str

    def table(self) -> np.dtype:
        names = [f"{number} {name}" for number, name in enumerate(self.names)]
        return np.dtype(list(zip(names, self.types, strict=True)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PcdCloud:
    """What a file holds, in its own unit."""

    points: Float[np.ndarray, "N 3"]
    color: UInt8[np.ndarray, "N 3"] | None
    sensor: Float[np.ndarray, 3] | None
    """None where the file says the origin."""


def read_pcd(path: Path) -> PcdCloud:
    """Points, colours and the sensor's place.

    Raises:
        InputError: No PCD file, one without x y z, or one that ends too soon.
    """
    data = path.read_bytes()
    found = DATA.search(data, 0, HEADER)
    if found is None:
        raise InputError(f"{path}: expected a PCD header with a line DATA, found none")
    header = _header(path, data[: found.start()], found[1].decode())
    check_count(str(path), header.count)
    columns = _columns(path, header, memoryview(data)[found.end() :])
    missing = [name for name in XYZ if name not in columns]
    if missing:
        raise InputError(
            f"{path}: expected fields x y z, found {' '.join(header.names)[:200] or 'none'}"
        )
    points = np.stack([columns[name].astype(np.float64) for name in XYZ], 1)
    place = np.array(header.viewpoint[:3])
    return PcdCloud(
        points=points,
        color=_color(columns),
        sensor=place if place.any() else None,
    )


def _header(path: Path, text: bytes, data: str) -> _Header:
    words = {}
    for line in text.decode("ascii", "replace").splitlines():
        name, *values = line.split() or [""]
        words.setdefault(name.upper(), values)
    try:
        names = tuple(words["FIELDS"])
        counts = [int(value) for value in words.get("COUNT", ["1"] * len(names))]
        kinds = zip(words["TYPE"], words["SIZE"], counts, strict=True)
        types = tuple(np.dtype((f"<{KINDS[k]}{int(size)}", c) if c > 1 else f"<{KINDS[k]}{size}")
                      for k, size, c in kinds)  # fmt: skip
        height = words.get("HEIGHT", ["1"])[0]
        count = int(words["POINTS"][0] if "POINTS" in words else words["WIDTH"][0]) * (
            1 if "POINTS" in words else int(height)
        )
        view = tuple(float(value) for value in words.get("VIEWPOINT", ["0"] * 7))
        odd = [n for n, c in zip(names, counts, strict=True) if c < 1 or (c > 1 and n in XYZ)]
        if len(types) != len(names) or count < 0 or odd:
            raise ValueError("fields, types and counts that do not fit")
        if len(view) < 3 or not np.isfinite(view).all():
            raise ValueError(f"VIEWPOINT {' '.join(words['VIEWPOINT'])}")
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected a PCD header with FIELDS, SIZE, TYPE and POINTS, found {error}"
        ) from error
    return _Header(names=names, types=types, count=count, viewpoint=view, data=data)


def _columns(path: Path, header: _Header, body: memoryview) -> dict[str, np.ndarray]:
    table = header.table()
    needed = header.count * table.itemsize
    if header.data == "ascii":
        return _ascii(path, header, body)
    if header.data == "binary":
        if len(body) < needed:
            raise InputError(f"{path}: expected {needed} bytes of points, found {len(body)}")
        rows = np.frombuffer(body, table, header.count)
        names = rows.dtype.names or ()
        return {name.split(" ", 1)[1]: rows[name] for name in reversed(names)}
    if header.data != "binary_compressed":
        raise InputError(
            f"{path}: expected DATA ascii, binary or binary_compressed, found {header.data!r}"
        )
    sizes = np.frombuffer(body[:8], "<u4") if len(body) >= 8 else np.zeros(2, int)
    packed, plain = int(sizes[0]), int(sizes[1])
    if plain != needed or len(body) < 8 + packed:
        raise InputError(
            f"{path}: expected {needed} bytes of points packed into {packed}, found {plain} in "
            f"{max(len(body) - 8, 0)}"
        )
    flat = np.frombuffer(unpacked(bytes(body[8 : 8 + packed]), plain, str(path)), np.uint8)
    columns, first = {}, 0  # one field after the other, not one point after the other
    for name, kind in zip(header.names, header.types, strict=True):
        size = kind.itemsize * header.count
        columns.setdefault(name, flat[first : first + size].view(kind.base))
        first += size
    return columns


def _ascii(path: Path, header: _Header, body: memoryview) -> dict[str, np.ndarray]:
    widths = [int(np.prod(kind.shape, dtype=int)) for kind in header.types]
    starts = np.cumsum([0, *widths[:-1]])
    where = {name: int(i) for name, i in reversed(list(zip(header.names, starts, strict=True)))}
    wanted = [name for name in ("x", "y", "z", "rgb", "rgba") if name in where]
    if header.count == 0 or not wanted:
        return {name: np.zeros(0) for name in wanted}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty table
            columns = np.loadtxt(
                io.BytesIO(body), np.float64, usecols=[where[name] for name in wanted], ndmin=2,
                max_rows=header.count, unpack=True,
            )  # fmt: skip
    except ValueError as error:
        raise InputError(f"{path}: expected rows of numbers, found {error}") from error
    found = columns.shape[-1] if columns.size else 0
    if found < header.count:
        raise InputError(f"{path}: expected {header.count} points, found {found}")
    return dict(zip(wanted, columns, strict=True))


def _color(columns: dict[str, np.ndarray]) -> UInt8[np.ndarray, "N 3"] | None:
    """Packed as 0x00RRGGBB in an integer, or the bits of a float; in ascii as a number."""
    packed = columns.get("rgb", columns.get("rgba"))
    if packed is None or packed.ndim != 1:
        return None
    if packed.dtype == np.float64:  # of an ascii file, or a field that nobody writes
        whole = np.isfinite(packed).all() and (packed == np.floor(packed)).all()
        bits = packed.astype(np.uint32) if whole and (packed >= 0).all() else None
        bits = packed.astype("<f4").view("<u4") if bits is None else bits
    elif packed.dtype.itemsize == 4:
        bits = np.ascontiguousarray(packed).view("<u4")
    else:
        return None
    return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], 1).astype(np.uint8)


def unpacked(data: bytes, size: int, where: str) -> bytearray:
    """LZF: literals, and copies of what has come before.

    Args:
        data: Packed.
        size: Of the result.
        where: For errors.

    Raises:
        InputError: Copies of what is not there, or another size.
    """
    out, i = bytearray(), 0
    try:
        while i < len(data) and len(out) <= size:
            control = data[i]
            i += 1
            if control < 32:
                out += data[i : i + control + 1]
                i += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[i]
                i += 1
            back = ((control & 31) << 8 | data[i]) + 1
            i += 1
            start, length = len(out) - back, length + 2
            if start < 0:
                raise IndexError
            piece = bytes(out[start : start + length])
            out += (piece * (length // len(piece) + 1))[:length]  # into itself: it repeats
    except IndexError:
        raise InputError(f"{where}: expected packed points, found a broken stream") from None
    if len(out) != size:
        raise InputError(f"{where}: expected {size} bytes when unpacked, found {len(out)}")
    return out
