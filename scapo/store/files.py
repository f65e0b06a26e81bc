# SPDX-License-Identifier: MIT
"""One safetensors file: arrays and a header, written atomically, the same input to the same bytes.

The header is ONE metadata entry, `scapo`, holding sorted JSON: several entries are written in
random order, which would break byte identity.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import secrets
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from scapo.store.json_records import parse_json
from scapo.store.schema import StoreError

SAMPLES = "scapo-samples/1"
PREDICTIONS = "scapo-predictions/1"
CHECKPOINT = "scapo-checkpoint/1"
MAX_VALUES = 1 << 27
"""Numbers that are read at once, half a gigabyte of float32: a sparse file may say terabytes."""
MAX_HASHED = 4 << 30
"""Bytes of a file whose digest is asked for."""

Arrays = dict[str, np.ndarray]
Header = dict[str, Any]


def require_suffix(path: Path, suffix: str) -> None:
    """Refuse a file to be written whose name does not say what will be in it.

    Raises:
        StoreError: Another suffix, or nothing before it.
    """
    if not path.name.endswith(suffix) or path.name == suffix:
        raise StoreError(f"{path}: expected a name that ends in {suffix}, found {path.name!r}")


def canonical_json(value: object) -> str:
    """Sorted, compact JSON: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_bytes(data: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path) -> str:
    """SHA-256 of a file's bytes in hex, read in pieces.

    Raises:
        StoreError: It is larger than any that is read here: a sparse file may have terabytes.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_HASHED:
            raise StoreError(f"{path}: expected at most {MAX_HASHED} bytes, found {size}")
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write through a temporary name in the same folder, flushed to disk before the rename.

    Raises:
        OSError: It cannot be written; the file it names is `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:  # a full disk is reported without a name, or with the temporary one
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):  # usually gone; else the first error is the one to report
            temporary.unlink()


def remove_half_written(folder: Path) -> None:
    """Remove what `write_bytes` left in a folder, where nobody writes now, when it was killed."""
    for path in folder.glob(f".{'[0-9a-f]' * 16}.tmp"):
        path.unlink(missing_ok=True)


def write(path: Path | str, arrays: Mapping[str, np.ndarray], header: Header) -> str:
    """Write arrays and header atomically; the same input gives the same bytes.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = write(f"{folder}/a.safetensors", {"x": np.eye(2)}, {"format": "mine/1"})
    ...     arrays, header = read(f"{folder}/a.safetensors", "mine/1")
    >>> arrays["x"].tolist(), header
    ([[1.0, 0.0], [0.0, 1.0]], {'format': 'mine/1'})

    Returns:
        The SHA-256 of the file.

    Raises:
        StoreError: A header that is not JSON, or an array of a type that the format lacks.
    """
    # Not ascontiguousarray, which makes vectors of scalars.
    ordered = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    if "__metadata__" in ordered:
        raise StoreError(f"{path}: expected a tensor name, found '__metadata__', the header's own")
    try:
        entry = canonical_json(header)
    except (TypeError, ValueError) as error:
        raise StoreError(f"{path}: expected a header of JSON values, found {error}") from error
    try:
        data = save(ordered, metadata={"scapo": entry})
    except SafetensorError as error:
        kinds = ", ".join(f"{name} {array.dtype}" for name, array in ordered.items())
        raise StoreError(f"{path}: expected numbers or bools, found {kinds}: {error}") from error
    write_bytes(path, data)
    return sha256_bytes(data)


def _open(path: Path) -> Any:  # noqa: ANN401 - safetensors ships no types
    return safe_open(path, "numpy")


def read_header(path: Path | str, expected: str | None = None) -> Header:
    """The header alone.

    Args:
        path: A safetensors file.
        expected: The header's `format`, None for any.

    Raises:
        StoreError: No such file, not safetensors, no `scapo` entry, or another format.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "none"
        raise StoreError(f"{path}: expected a file, found {found}")
    try:
        with _open(path) as file:
            metadata: dict[str, str] = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise StoreError(f"{path}: expected a safetensors file, found {error}") from error
    if "scapo" not in metadata:
        raise StoreError(
            f"{path}: expected the metadata entry 'scapo', found {sorted(metadata) or 'none'}"
        )
    try:
        header: object = parse_json(metadata["scapo"])
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: expected JSON in the header, found {error}") from error
    if not isinstance(header, dict):
        raise StoreError(f"{path}: expected a JSON object, found {type(header).__name__}")
    fields = cast("Header", header)
    if expected is not None and fields.get("format") != expected:
        raise StoreError(f"{path}: expected format {expected!r}, found {fields.get('format')!r}")
    return fields


def read(
    path: Path | str, expected: str | None = None, names: tuple[str, ...] | None = None
) -> tuple[Arrays, Header]:
    """Arrays (all, or those of `names` that are there) and header.

    Raises:
        StoreError: As `read_header`, or a tensor cannot be read as numpy; more than `MAX_VALUES`.
    """
    header = read_header(path, expected)
    arrays: Arrays = {}
    try:
        with _open(Path(path)) as file:
            wanted = [name for name in file.keys() if names is None or name in names]  # noqa: SIM118
            values = sum(math.prod(file.get_slice(name).get_shape()) for name in wanted)
            if values > MAX_VALUES:
                raise StoreError(f"{path}: expected at most {MAX_VALUES} numbers, found {values}")
            arrays = {name: file.get_tensor(name) for name in wanted}
    except (SafetensorError, TypeError, AttributeError, OSError) as error:
        raise StoreError(f"{path}: expected numpy-readable tensors, found {error}") from error
    # Where ml_dtypes was imported numpy reads its types too, but only there.
    odd = [str(array.dtype) for array in arrays.values() if array.dtype.kind == "V"]
    if odd:
        raise StoreError(f"{path}: expected numpy-readable tensors, found {odd[0]}")
    return arrays, header


def tensor_names(path: Path) -> set[str]:
    """The names of a file's tensors.

    Raises:
        StoreError: No such file, or not safetensors.
    """
    try:
        with _open(path) as file:
            return set(file.keys())
    except (SafetensorError, OSError) as error:
        raise StoreError(f"{path}: expected a safetensors file, found {error}") from error


def require(path: Path, names: Iterable[str], there: Iterable[str]) -> None:
    """Refuse a file without one of the tensors `names`.

    Raises:
        StoreError: Naming file and tensor.
    """
    missing = [name for name in names if name not in set(there)]
    if missing:
        raise StoreError(f"{path}: expected tensor {missing[0]!r}, found none")
