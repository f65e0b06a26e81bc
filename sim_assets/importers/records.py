# SPDX-License-Identifier: MIT
"""JSON records and OBJ meshes of other people's sets, every value checked where it is read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sim_assets.models.validate import (
    MAX_COORDINATE,
    MAX_FACES,
    MAX_MESH_BYTES,
    read_file,
    read_number,
    refuse,
)

MAX_JSON_BYTES = 16 << 20
MAX_DIGITS = 18
"""Of an integer."""

Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """Triangles in the set's coordinates."""

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]


def read_json(path: Path) -> Any:  # noqa: ANN401
    """A JSON file of sane size.

    Raises:
        AssetError: Missing, too large, not JSON.
    """
    data = read_file(path, MAX_JSON_BYTES)
    try:
        return json.loads(data.decode("utf-8-sig"), parse_int=_integer)
    except RecursionError as error:
        raise refuse(path, "JSON", "values nested too deeply") from error
    except ValueError as error:
        raise refuse(path, "JSON", str(error)) from error


def _integer(digits: str) -> int:
    """An integer of JSON that arrays can hold."""
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


def member(path: Path, record: object, key: str, kind: type | tuple[type, ...]) -> Any:  # noqa: ANN401
    """`record[key]`, of the right kind.

    Raises:
        AssetError: Naming file, key and what was found.
    """
    if not isinstance(record, dict):
        raise refuse(path, "an object", f"{record!r:.80}")
    value = record.get(key)
    if not isinstance(value, kind) or isinstance(value, bool):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        names = " or ".join(one.__name__ for one in kinds)
        found = "none" if key not in record else f"{value!r:.80}"
        raise refuse(path, f"{key!r} as {names}", found)
    return value


def vector(path: Path, record: object, key: str) -> Vector:
    """Three finite numbers, which may be written as text.

    Raises:
        AssetError: Naming file, key and what was found.
    """
    value = member(path, record, key, list)
    try:
        numbers = np.array([read_number(item) for item in value])
    except ValueError as error:
        raise refuse(path, f"{key!r} as three numbers", f"{value!r:.80}") from error
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise refuse(path, f"{key!r} as three finite numbers", f"{value!r:.80}")
    return numbers


def direction(path: Path, record: object, key: str) -> Vector:
    """A vector brought to length 1.

    Raises:
        AssetError: As `vector`, or its length is 0.
    """
    value = vector(path, record, key)
    length = float(np.linalg.norm(value))
    if length < 1e-9:
        raise refuse(path, f"{key!r} with a length", f"{value}")
    return value / length


def read_obj(path: Path) -> Mesh:
    """Vertices and triangles of a Wavefront OBJ; all other lines are left alone.

    Raises:
        AssetError: Unreadable, other numbers than three a line, indices out of range, no triangle.
    """
    text = read_file(path, MAX_MESH_BYTES).decode("utf-8", errors="replace")
    if text.count("\nf ") > MAX_FACES:
        raise refuse(path, f"at most {MAX_FACES} triangles", "more")
    lines = [line.split() for line in text.splitlines()]
    try:
        rows = [[read_number(word) for word in line[1:4]] for line in lines if line[:1] == ["v"]]
        corners = [[_index(word) for word in line[1:]] for line in lines if line[:1] == ["f"]]
    except ValueError as error:
        raise refuse(path, "lines 'v x y z' and 'f i j k'", str(error)) from error
    if not rows or not corners or len(corners) > MAX_FACES:
        raise refuse(path, "a mesh with triangles", f"{len(rows)} vertices, {len(corners)} faces")
    if {len(row) for row in rows} != {3} or {len(row) for row in corners} != {3}:
        raise refuse(path, "three numbers for each vertex and face", "another number")
    vertices, faces = np.array(rows), np.array(corners, np.int64)
    faces = np.where(faces < 0, faces + len(vertices), faces - 1)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise refuse(path, f"vertex indices from 1 to {len(vertices)}", "others")
    if not (np.abs(vertices) < MAX_COORDINATE).all():
        raise refuse(path, f"finite coordinates below {MAX_COORDINATE:g}", "others")
    return Mesh(vertices=vertices, faces=faces)


def _index(word: str) -> int:
    """The vertex of a face's corner `vertex/texture/normal`."""
    digits = word.split("/")[0]
    if len(digits) > MAX_DIGITS or not digits.isascii() or "_" in digits:
        raise ValueError(f"could not read {digits!r:.40} as an index")
    return int(digits)


def part_of(mesh: Mesh, chosen: Int[np.ndarray, " K"]) -> Mesh:
    """Some of a mesh's triangles, with the vertices that they use."""
    used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    return Mesh(vertices=mesh.vertices[used], faces=faces.reshape(-1, 3))
