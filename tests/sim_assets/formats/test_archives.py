# SPDX-License-Identifier: MIT
"""`.npy`, `.npz` and `.pt` files: read like numpy and torch read them, or refused in one line."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sim_assets.formats import archives
from sim_assets.formats.archives import read_npy, read_npz, read_pt
from sim_assets.formats.unpickle import UnpickleError
from tests.helpers.foreign import Calls, write_npz, write_pt

RECORD = {"pc": np.arange(6.0).reshape(2, 3), "mask": np.array([True, False])}


def test_npy(tmp_path: Path):
    path = tmp_path / "a.npy"
    for value in (RECORD["pc"], np.asfortranarray(RECORD["pc"]), np.array(["a", "b"])):
        np.save(path, value)
        np.testing.assert_array_equal(read_npy(path), value)
    np.save(path, {3: 1, 4: 0}, allow_pickle=True)  # type: ignore
    assert read_npy(path) == {3: 1, 4: 0}
    np.save(path, np.array([{"a": 1}, None], dtype=object), allow_pickle=True)
    assert read_npy(path).tolist() == [{"a": 1}, None]


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz(save: Any, tmp_path: Path):
    path = tmp_path / "a.npz"
    save(path, RECORD)
    found = read_npz(path)["arr_0"]
    assert list(found) == list(RECORD)
    np.testing.assert_array_equal(found["pc"], RECORD["pc"])
    assert found["mask"].dtype == bool
    save(path, **RECORD)
    np.testing.assert_array_equal(read_npz(path)["pc"], RECORD["pc"])


TENSORS = {
    "float": torch.arange(6.0).reshape(2, 3),
    "double": torch.tensor([1.5, -2.0], dtype=torch.float64),
    "half": torch.tensor([0.5, 3.0], dtype=torch.float16),
    "bfloat": torch.tensor([0.5, -3.0], dtype=torch.bfloat16),
    "long": torch.tensor([[1], [-2]]),
    "int": torch.tensor([7], dtype=torch.int32),
    "short": torch.tensor([7, -7], dtype=torch.int16),
    "char": torch.tensor([-7], dtype=torch.int8),
    "byte": torch.tensor([255], dtype=torch.uint8),
    "bool": torch.tensor([True, False]),
    "scalar": torch.tensor(2.5),
    "empty": torch.zeros(0, 3),
    "transposed": torch.arange(6.0).reshape(2, 3).T,
    "part": torch.arange(10)[3:7],
    "repeated": torch.tensor([1.0, 2.0]).expand(4, 2),
    "grad": torch.tensor([1.0], requires_grad=True),
}


def test_pt_is_what_torch_saved(tmp_path: Path):
    path = write_pt({"tensors": TENSORS, "more": [1, "two", None, np.arange(3)]}, tmp_path / "a.pt")
    found = read_pt(path)
    assert found["more"][:3] == [1, "two", None]
    assert found["more"][3].tolist() == [0, 1, 2]
    for name, tensor in TENSORS.items():
        wanted = tensor.detach()
        wanted = wanted.float().numpy() if name == "bfloat" else wanted.numpy()
        np.testing.assert_array_equal(found["tensors"][name], wanted, err_msg=name)
        assert found["tensors"][name].dtype == wanted.dtype, name


def test_whatever_runs_code_is_refused(tmp_path: Path):
    marker = tmp_path / "marker"
    evil = Calls(os.system, f"touch '{marker}'")
    with pytest.raises(UnpickleError, match=r"a\.npz: arr_0\.npy: .*posix\.system"):
        read_npz(write_npz({"pc": evil}, tmp_path / "a.npz"))
    with pytest.raises(UnpickleError, match=r"a\.pt: .*posix\.system"):
        read_pt(write_pt({"pc": torch.zeros(2), "more": [evil]}, tmp_path / "a.pt"))
    np.save(tmp_path / "a.npy", {1: evil}, allow_pickle=True)  # type: ignore
    with pytest.raises(UnpickleError, match=r"a\.npy: .*posix\.system"):
        read_npy(tmp_path / "a.npy")
    assert not marker.exists()


@pytest.mark.parametrize(
    ("value", "culprit"),
    [
        (torch.nn.Linear(2, 2), "torch.nn.modules.linear.Linear"),
        (torch.nn.Parameter(torch.zeros(2)), "torch._utils._rebuild_parameter"),
        (torch.zeros(2).to_sparse(), "torch._utils._rebuild_sparse_tensor"),
        (torch.zeros(2, dtype=torch.complex64), "torch.ComplexFloatStorage"),
        ({"device": torch.device("cpu")}, "torch.device"),
    ],
)
def test_other_things_of_torch_are_named(value: object, culprit: str, tmp_path: Path):
    with pytest.raises(UnpickleError, match=culprit.replace(".", r"\.")):
        read_pt(write_pt(value, tmp_path / "a.pt"))


def rezipped(path: Path, change: dict[str, bytes | None]) -> Path:
    """The archive with members replaced, added or (None) left out, whatever their folder."""
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
    top = next(iter(members)).split("/")[0]
    members |= {f"{top}/{name}": data for name, data in change.items() if data is not None}
    for name in [name for name, data in change.items() if data is None]:
        del members[f"{top}/{name}"]
    with zipfile.ZipFile(path, "w") as new:
        for name, data in members.items():
            new.writestr(name, data)
    return path


PT_DAMAGE = {
    "no pickle": ({"data.pkl": None}, "one data.pkl in a torch file, found 0"),
    "two pickles": ({"more/data.pkl": b"N."}, "found 2"),
    "no storage": ({"data/0": None}, "data/0', found none"),
    "short storage": ({"data/0": b"abcd"}, "a storage of 6 elements, found 1"),
    "big endian": ({"byteorder": b"big"}, "little-endian"),
    "broken pickle": ({"data.pkl": b"\x80\x02}q"}, "whole pickle"),
}


@pytest.mark.parametrize("name", PT_DAMAGE)
def test_damaged_torch_files(name: str, tmp_path: Path):
    change, message = PT_DAMAGE[name]
    path = rezipped(write_pt({"pc": torch.arange(6.0)}, tmp_path / "a.pt"), change)
    with pytest.raises(UnpickleError, match=message) as caught:
        read_pt(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_tensor_that_reaches_past_its_storage(tmp_path: Path):
    path = write_pt({"pc": torch.arange(6.0).reshape(2, 3)}, tmp_path / "a.pt")
    with zipfile.ZipFile(path) as archive:
        name = next(n for n in archive.namelist() if n.endswith("data.pkl"))
        data = archive.read(name)
    # Sizes 2, 3 and strides 3, 1 are one-byte integers of the pickle.
    assert b"K\x02K\x03\x86" in data
    forged = data.replace(b"K\x02K\x03\x86", b"K\x02K\xff\x86")
    with pytest.raises(UnpickleError, match="a storage of 258 elements, found 6"):
        read_pt(rezipped(path, {"data.pkl": forged}))


def test_no_such_file_and_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for read in (read_npy, read_npz, read_pt):
        with pytest.raises(UnpickleError, match="expected a readable file"):
            read(tmp_path / "none")
    path = write_npz(RECORD, tmp_path / "a.npz")
    monkeypatch.setattr(archives, "MAX_BYTES", 600)
    with pytest.raises(UnpickleError, match="at most 0 MiB"):
        read_npz(path)


def test_old_torch_files_and_no_archives(tmp_path: Path):
    path = tmp_path / "a.pt"
    torch.save({"pc": torch.zeros(2)}, path, _use_new_zipfile_serialization=False)  # noqa: TID251
    with pytest.raises(UnpickleError, match="expected a zip archive"):
        read_pt(path)
    path.write_bytes(b"PK\x03\x04 but nothing more")
    with pytest.raises(UnpickleError, match="whole zip archive"):
        read_pt(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(UnpickleError, match=r"expected arrays in a \.npz file"):
        read_npz(path)


def npy(value: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, value, allow_pickle=True)
    return file.getvalue()


NPY_DAMAGE = {
    "empty": (b"", "whole .npy file"),
    "other magic": (b"\x93NUMPZ\x01\x00", "whole .npy file"),
    "version 9": (npy(np.zeros(2)).replace(b"NUMPY\x01", b"NUMPY\x09"), "version 1 or 2"),
    "cut off": (npy(np.zeros(9))[:-8], "whole .npy file"),
    "huge shape": (npy(np.zeros(2)).replace(b"(2,), }    ", b"(2999999,),}"), "whole .npy file"),
    "code as header": (
        npy(np.zeros(2)).replace(b"{'descr': '<f8',", b"exit() or {  'x':"),
        "whole .npy file",
    ),
    "cut off pickle": (npy(np.array({1: 2}))[:-2], "whole pickle"),
    "pickle of no array": (npy(np.array({1: 2}))[:128] + b"].", "pickled array, found list"),
}


@pytest.mark.parametrize("name", NPY_DAMAGE)
def test_damaged_npy(name: str, tmp_path: Path):
    data, message = NPY_DAMAGE[name]
    path = tmp_path / "a.npy"
    path.write_bytes(data)
    with pytest.raises(UnpickleError, match=message) as caught:
        read_npy(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["npz", "pt"])
def test_truncated_anywhere(kind: str, tmp_path: Path):
    path = tmp_path / f"a.{kind}"
    if kind == "npz":
        write_npz(RECORD, path)
    else:
        write_pt({"pc": torch.zeros(3)}, path)
    whole = path.read_bytes()
    for end in range(0, len(whole) - 1, 37):
        path.write_bytes(whole[:end])
        with pytest.raises(UnpickleError):
            read_npz(path) if kind == "npz" else read_pt(path)


def test_a_tensor_of_more_elements_than_its_storage(tmp_path: Path):
    """Strides of 0 make gigabytes of a number; a few repeated ones are as torch saves them."""
    path = tmp_path / "a.pt"
    row = torch.arange(3.0)
    write_pt({"x": row.expand(4, 3)}, path)
    np.testing.assert_array_equal(read_pt(path)["x"], np.tile(np.arange(3), (4, 1)))
    write_pt({"x": row[:1].expand(1 << 27)}, path)
    assert path.stat().st_size < 3000
    with pytest.raises(UnpickleError, match="at most the 3 elements of its storage"):
        read_pt(path)
    np.save(tmp_path / "a.npy", np.zeros(3, "S0"))
    data = (tmp_path / "a.npy").read_bytes().replace(b"(3,)", b"(" + b"9" * 15 + b",)")
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(UnpickleError, match=r"a\.npy: expected a whole \.npy file"):
        read_npy(tmp_path / "a.npy")
