# SPDX-License-Identifier: MIT
"""`.npy`, `.npz` and `.pt` files of other people's data sets as plain arrays, without `pickle`.

What they hold of pickles goes through `unpickle`: arrays and plain containers, all else is refused
by name.
"""

from __future__ import annotations

import errno
import io
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from scapo.store.regular import read_regular
from sim_assets.formats.pickled import STORAGES, Admitted, Storage, shown
from sim_assets.formats.unpickle import UnpickleError, unpickle

MAX_BYTES = 1 << 30
"""Of a file, and of what its members unfold to: fifty times a 640 x 480 cloud with colours."""


def read_bytes(path: Path) -> bytes:
    """A file of sane size.

    Raises:
        UnpickleError: No such file, unreadable, or too large.
    """
    try:
        return read_regular(path, MAX_BYTES)
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise UnpickleError(
                f"{path}: expected at most {MAX_BYTES >> 20} MiB, found more"
            ) from error
        raise UnpickleError(f"{path}: expected a readable file, found {error.strerror}") from error


def read_npy(path: Path) -> Any:  # noqa: ANN401
    """The array of a `.npy` file; of one that holds a single pickled object, that object.

    Raises:
        UnpickleError: Not such a file, damaged, or more than data.
    """
    return _npy(read_bytes(path), path)


def read_npz(path: Path, data: bytes | None = None) -> dict[str, Any]:
    """The members of a `.npz` file by name, as `read_npy` gives them.

    Args:
        path: Of the file.
        data: Its bytes, where they have been read already.

    Raises:
        UnpickleError: Not such a file, damaged, or more than data.
    """
    members = _unzip(data if data is not None else read_bytes(path), path)
    arrays = {name: raw for name, raw in members.items() if name.endswith(".npy")}
    if not arrays:
        raise UnpickleError(f"{path}: expected arrays in a .npz file, found {sorted(members)[:5]}")
    return {name[: -len(".npy")]: _npy(raw, f"{path}: {name}") for name, raw in arrays.items()}


def read_pt(path: Path, data: bytes | None = None) -> Any:  # noqa: ANN401
    """What `torch.save` (1.6 or later) stored: tensors as arrays, in plain containers.

    Args:
        path: Of the file.
        data: Its bytes, where they have been read already.

    Raises:
        UnpickleError: Not such a file, damaged, or more than tensors of plain storages and
            containers.
    """
    members = _unzip(data if data is not None else read_bytes(path), path)
    tops = [name for name in members if name.rpartition("/")[2] == "data.pkl"]
    if len(tops) != 1:
        raise UnpickleError(f"{path}: expected one data.pkl in a torch file, found {len(tops)}")
    folder = tops[0][: -len("data.pkl")]
    order = members.get(f"{folder}byteorder", b"little").strip()
    if order != b"little":
        raise UnpickleError(f"{path}: expected a little-endian torch file, found {order!r:.20}")

    def storage(key: tuple[Any, ...]) -> Storage:
        """('storage', class, name of the member, device, number of elements)."""
        if len(key) != 5 or key[0] != "storage" or not isinstance(key[1], Admitted):
            raise UnpickleError(f"expected a storage, found {shown(key)}")
        if key[1].name not in STORAGES:
            raise UnpickleError(f"expected a plain storage, found {key[1].name}")
        if not isinstance(key[2], str):
            raise UnpickleError(f"expected the name of a storage, found {shown(key[2])}")
        member = f"{folder}data/{key[2]}"
        if member not in members:
            raise UnpickleError(f"expected the storage {member!r}, found none")
        return Storage(members[member], key[1].name)

    return unpickle(members[tops[0]], path, storage)


def _npy(raw: bytes, where: object) -> Any:  # noqa: ANN401
    """An array by numpy, which needs no pickle for numbers; objects by our own reader."""
    file = io.BytesIO(raw)
    try:
        version = npy.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise UnpickleError(f"{where}: expected a .npy file of version 1 or 2, found {version}")
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = header(file)
        if not dtype.hasobject:
            if dtype.itemsize == 0:
                raise ValueError(f"elements of {dtype}, which have no bytes")
            if math.prod(shape) * dtype.itemsize > len(raw):
                raise ValueError(f"{len(raw)} bytes for the shape {shape} of {dtype}")
            file.seek(0)
            return npy.read_array(file, allow_pickle=False)
    except UnpickleError:
        raise
    except (ValueError, TypeError, SyntaxError, OverflowError, MemoryError, EOFError) as error:
        line = " ".join(str(error).split())
        raise UnpickleError(f"{where}: expected a whole .npy file, found {line}") from error
    value = unpickle(raw[file.tell() :], where)
    if not isinstance(value, np.ndarray):
        raise UnpickleError(f"{where}: expected a pickled array, found {type(value).__name__}")
    return value[()] if shape == () and value.shape == () else value


def _unzip(data: bytes, path: Path) -> dict[str, bytes]:
    """Name -> bytes of every member, checksums verified."""
    if not data.startswith(b"PK"):
        raise UnpickleError(f"{path}: expected a zip archive, found {data[:4]!r}")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            infos = [info for info in archive.infolist() if not info.is_dir()]
            size = sum(info.file_size for info in infos)
            if size > MAX_BYTES:
                raise UnpickleError(f"{path}: expected at most {MAX_BYTES >> 20} MiB, found {size}")
            return {info.filename: archive.read(info) for info in infos}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        raise UnpickleError(f"{path}: expected a whole zip archive, found {error}") from error
    except (NotImplementedError, RuntimeError, ValueError) as error:
        if isinstance(error, UnpickleError):
            raise
        raise UnpickleError(f"{path}: expected a plain zip archive, found {error}") from error
