# SPDX-License-Identifier: MIT
"""One file: round trips, equal bytes, atomic writes, and refusals that name what was found."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scapo.store.files import (
    canonical_json,
    read,
    require_suffix,
    sha256_file,
    write,
    write_bytes,
)
from scapo.store.schema import StoreError
from tests.conftest import REPOSITORY

HEADER = {"format": "scapo-test/1", "list": [1, 2.5, None], "text": "Größe 尺"}

DTYPES = ["bool", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.safetensors"


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(), (0,), (4,), (0, 3), (2, 3, 2)])
def test_round_trip_of_every_type_and_shape(path: Path, dtype: str, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    array = rng.integers(0, 100, shape)
    array = np.asarray(array % 2 if dtype == "bool" else array).astype(dtype)
    write(path, {"x": array}, HEADER)
    arrays, header = read(path)
    assert arrays["x"].dtype == array.dtype
    assert arrays["x"].shape == shape
    np.testing.assert_array_equal(arrays["x"], array)
    assert header == HEADER


def test_round_trip_of_extreme_numbers(path: Path) -> None:
    array = np.array([np.nan, np.inf, -np.inf, -0.0, 5e-324, 1.7e308])
    write(path, {"x": array}, HEADER)
    assert read(path)[0]["x"].tobytes() == array.tobytes()


def test_memory_order_and_byte_order_change_nothing(path: Path) -> None:
    plain = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    wide = np.zeros((2, 3, 8), np.float32)
    wide[..., ::2] = plain
    frozen = plain.copy()
    frozen.flags.writeable = False
    same = {
        "fortran": np.asfortranarray(plain),
        "view": np.ascontiguousarray(plain.swapaxes(0, 2)).swapaxes(0, 2),
        "strided": wide[..., ::2],
        "reversed": plain[::-1].copy()[::-1],
        "big-endian": plain.astype(">f4"),
        "read-only": frozen,
    }
    expected = write(path, {"x": plain}, HEADER)
    for name, array in same.items():
        assert write(path, {"x": array}, HEADER) == expected, name
        np.testing.assert_array_equal(read(path)[0]["x"], plain)


def test_names_select_tensors(path: Path) -> None:
    write(path, {"a": np.ones(2), "b": np.zeros(3)}, HEADER)
    assert list(read(path, names=("b", "c"))[0]) == ["b"]
    assert set(read(path)[0]) == {"a", "b"}
    assert read(path, names=())[0] == {}


def test_a_path_may_be_text_with_spaces_and_unicode(tmp_path: Path) -> None:
    path = tmp_path / "a folder [1]" / "Brille 眼镜.safetensors"
    sha256 = write(str(path), {"a": np.ones(2)}, HEADER)
    assert read(str(path), "scapo-test/1")[1] == HEADER
    assert sha256_file(path) == sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_header_is_one_sorted_metadata_entry(path: Path) -> None:
    write(path, {"a": np.ones(2)}, {"b": 1, "a": {"d": 2, "c": 3}})
    data = path.read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    metadata = json.loads(data[8 : 8 + size])["__metadata__"]
    assert metadata == {"scapo": '{"a":{"c":3,"d":2},"b":1}'}


PROGRAM = """
import os, signal, sys
import numpy as np
from scapo.store.files import write, write_bytes
names = list({"points", "part", "camera", "joint_axis", "joint_pivot", "visible", "instance"})
arrays = {name: np.arange(len(name), dtype="f4" if "j" in name else "u1") for name in names}
header = {name: name for name in {"format", "category", "split", "versions", "seed"}}
write(sys.argv[1] + "/equal", arrays, header)
print(*names, flush=True)
os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
write_bytes(sys.argv[1] + "/killed", b"half")
"""


@pytest.fixture(scope="module")
def other_process(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Where another process wrote `equal` and was killed writing `killed`; its order of names."""
    folder = tmp_path_factory.mktemp("other")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder)],
        env={**os.environ, "PYTHONHASHSEED": "3"},
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    return folder, done.stdout.split()


def test_equal_input_gives_equal_bytes_in_any_order_and_process(
    path: Path, other_process: tuple[Path, list[str]]
) -> None:
    folder, names = other_process
    kinds = {name: "f4" if "j" in name else "u1" for name in names}
    for order in (names, sorted(names), sorted(names, reverse=True)):
        arrays = {name: np.arange(len(name), dtype=kinds[name]) for name in order}
        header = {name: name for name in ("seed", "split", "versions", "format", "category")}
        assert write(path, arrays, header) == sha256_file(folder / "equal")


def test_a_writer_killed_before_the_rename_leaves_no_file(
    other_process: tuple[Path, list[str]],
) -> None:
    path = other_process[0] / "killed"
    assert not path.exists()
    left = {file.name for file in path.parent.iterdir()} - {"equal"}
    assert [Path(name).suffix for name in left] == [".tmp"]
    write_bytes(path, b"whole")  # and does not stand in the way of the next
    assert path.read_bytes() == b"whole"


@pytest.mark.parametrize("name", ["p.csv", "p", ".safetensors", "p.safetensors.txt"])
def test_a_name_that_does_not_say_what_is_in_the_file_is_refused(name: str) -> None:
    require_suffix(Path("p.safetensors"), ".safetensors")
    with pytest.raises(StoreError, match=f"expected a name that ends in .safetensors, .*{name}'"):
        require_suffix(Path("folder") / name, ".safetensors")


def test_canonical_json_ignores_the_order_of_keys() -> None:
    assert canonical_json({"b": 1, "a": [1.5, None]}) == canonical_json({"a": [1.5, None], "b": 1})
    assert canonical_json({"a": "é"}) == '{"a":"\\u00e9"}'


def test_writing_replaces_a_file_and_leaves_nothing_else(path: Path) -> None:
    write(path, {"a": np.ones(2)}, HEADER)
    write(path, {"a": np.zeros(3)}, HEADER)
    assert read(path)[0]["a"].shape == (3,)
    assert os.listdir(path.parent) == [path.name]  # noqa: PTH208 - hidden ones too


@pytest.mark.parametrize("failing", ["replace", "fsync"])
@pytest.mark.parametrize("before", [False, True])
def test_a_write_that_fails_leaves_what_was_there(
    path: Path, monkeypatch: pytest.MonkeyPatch, failing: str, before: bool
) -> None:
    if before:
        write_bytes(path, b"old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path if failing == "replace" else os, failing, fail)
    with pytest.raises(OSError, match="No space left"):
        write(path, {"a": np.ones(2)}, HEADER)
    assert os.listdir(path.parent) == ([path.name] if before else [])  # noqa: PTH208
    assert not before or path.read_bytes() == b"old"


def test_threads_that_write_the_same_file_leave_one_of_theirs(path: Path) -> None:
    contents = [bytes([i]) * 100_000 for i in range(8)]
    threads = [threading.Thread(target=write_bytes, args=(path, data)) for data in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_bytes() in contents
    assert list(path.parent.iterdir()) == [path]


def test_a_long_file_name_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 250)
    write_bytes(path, b"data")
    assert path.read_bytes() == b"data"


def test_the_first_error_is_the_one_reported(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> Callable[..., None]:
        def raise_(*_: object, **__: object) -> None:
            raise OSError(name)

        return raise_

    monkeypatch.setattr(Path, "replace", fail("first"))
    monkeypatch.setattr(os, "unlink", fail("second"))
    with pytest.raises(OSError, match="first"):
        write_bytes(path, b"data")


def test_a_file_in_the_place_of_the_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match="file"):
        write_bytes(tmp_path / "file" / "a", b"data")


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_reported(path: Path) -> None:
    path.parent.chmod(0o500)
    try:
        with pytest.raises(PermissionError):
            write_bytes(path, b"data")
    finally:
        path.parent.chmod(0o700)
