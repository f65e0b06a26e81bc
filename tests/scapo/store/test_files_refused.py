# SPDX-License-Identifier: MIT
"""Files, headers and arrays that are refused, each naming what was expected and found."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from scapo.store.files import read, read_header, require, sha256_file, write
from scapo.store.schema import StoreError

HEADER = {"format": "scapo-test/1", "list": [1, 2.5, None], "text": "Größe 尺"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.safetensors"


@pytest.mark.parametrize(
    ("header", "found"),
    [
        ({"a": float("nan")}, "Out of range float"),
        ({"a": np.int64(1)}, "int64 is not JSON"),
        ({"a": {1, 2}}, "set is not JSON"),
    ],
)
def test_headers_that_are_not_json_are_refused(
    path: Path, header: dict[str, object], found: str
) -> None:
    with pytest.raises(StoreError, match=rf"a.safetensors: expected a header of JSON .*{found}"):
        write(path, {"a": np.ones(1)}, header)
    assert not path.exists()


@pytest.mark.parametrize("array", [np.array(["a"]), np.array([1j, 2]), np.array([None])])
def test_arrays_of_other_types_are_refused(path: Path, array: np.ndarray) -> None:
    message = f"a.safetensors: expected numbers or bools, found x {array.dtype}"
    with pytest.raises(StoreError, match=message):
        write(path, {"x": array}, HEADER)
    with pytest.raises(StoreError, match="found '__metadata__'"):
        write(path, {"__metadata__": np.ones(1)}, HEADER)


def _good(path: Path) -> bytes:
    write(path, {"a": np.arange(100.0)}, HEADER)
    return path.read_bytes()


BROKEN: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "header cut": lambda data: data[:40],
    "data cut": lambda data: data[:-1],
    "trailing bytes": lambda data: data + b"x",
    "length of the header": lambda data: b"\xff" * 8 + data[8:],
    "garbage": lambda data: np.random.default_rng(0).bytes(2000),
    "pickle": lambda data: np.ones(3).dumps(),
    "zip": lambda data: b"PK\x03\x04" + bytes(100),
    "text": lambda data: b'{"format": "scapo-test/1"}' * 10,
}


@pytest.mark.parametrize("kind", BROKEN)
def test_files_of_another_kind_are_refused(path: Path, kind: str) -> None:
    path.write_bytes(BROKEN[kind](_good(path)))
    for function in (read, read_header):
        with pytest.raises(
            StoreError, match=r"a.safetensors: expected a safetensors file, found .+"
        ):
            function(path)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"none.safetensors: expected a file, found none"):
        read(tmp_path / "none.safetensors")
    with pytest.raises(StoreError, match="expected a file, found a folder"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "expected the metadata entry 'scapo', found none"),
        ({"format": "pt"}, r"expected the metadata entry 'scapo', found \['format'\]"),
        ({"scapo": "{"}, "expected JSON in the header, found Expecting"),
        ({"scapo": "[1]"}, "expected a JSON object, found list"),
        ({"scapo": "[" * 100_000}, "expected JSON in the header, found maximum recursion"),
        ({"scapo": "{}"}, "expected format 'scapo-test/1', found None"),
        (
            {"scapo": '{"format": "scapo-test/2"}'},
            "expected format 'scapo-test/1', found 'scapo-test/2'",
        ),
    ],
)
def test_other_headers_are_refused(
    path: Path, metadata: dict[str, str] | None, message: str
) -> None:
    save_file({"a": torch.ones(2)}, path, metadata=metadata)
    with pytest.raises(StoreError, match=rf"a.safetensors: {message}"):
        read(path, "scapo-test/1")


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float8_e4m3fn])
def test_types_that_numpy_lacks_are_refused(path: Path, dtype: torch.dtype) -> None:
    save_file({"a": torch.ones(2).to(dtype)}, path, metadata={"scapo": "{}"})
    with pytest.raises(StoreError, match=r"a.safetensors: expected numpy-readable tensors"):
        read(path)
    pytest.importorskip("ml_dtypes")  # which teaches numpy such types
    with pytest.raises(StoreError, match=r"a.safetensors: expected numpy-readable tensors"):
        read(path)


def test_require_names_the_first_missing_tensor(path: Path) -> None:
    require(path, ("a",), ("a", "b"))
    with pytest.raises(StoreError, match=r"a.safetensors: expected tensor 'c', found none"):
        require(path, ("a", "c", "d"), ("a", "b"))


def test_tensors_of_terabytes_are_refused_unread(path: Path) -> None:
    """A sparse file of no blocks; what is not asked for may be there."""
    write(path, {"x": np.ones(2, np.float32)}, HEADER)
    data = path.read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    head = json.loads(data[8 : 8 + size])
    end = 8 + (1 << 38)
    head["huge"] = {"dtype": "F32", "shape": [1 << 36], "data_offsets": [8, end]}
    text = json.dumps(head).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + size :])
    os.truncate(path, 8 + len(text) + end)
    with pytest.raises(StoreError, match=r"a\.safetensors: expected at most \d+ numbers, "):
        read(path)
    assert read(path, names=("x",))[0]["x"].tolist() == [1.0, 1.0]


def test_a_sparse_file_of_terabytes_has_no_digest(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)
    with pytest.raises(StoreError, match=r"a\.safetensors: expected at most 4294967296 bytes"):
        sha256_file(path)
