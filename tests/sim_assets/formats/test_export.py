# SPDX-License-Identifier: MIT
"""Exported data, read back by plain libraries and compared with the shards tensor by tensor."""

from __future__ import annotations

import io
import json
import sys
import tarfile
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from safetensors import safe_open

from sim_assets.formats.export import ExportFormat, export
from tests.helpers.made import sample_arrays, write_split
from tests.helpers.pages import code_blocks
from tests.helpers.programs import run

FORMATS = get_args(ExportFormat)
SPLITS = ("clean/eyeglasses/test-ood", "clean/eyeglasses/train", "sensor/laptop/train")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three splits of several shards, one with colours and a tensor that we do not know."""
    root = tmp_path_factory.mktemp("data")
    for number, name in enumerate(SPLITS):
        part, category, split = name.split("/")
        arrays = sample_arrays(category, 7, 24, seed=number)
        if part == "sensor":
            rng = np.random.default_rng(0)
            arrays["color"] = rng.integers(0, 255, (7, 24, 3)).astype(np.uint8)
            arrays["extra"] = rng.integers(0, 1, (7, 24)).astype(np.uint8)
        write_split(root / part, category, split, arrays, shard_size=3)
    return root


def stored(folder: Path) -> dict[str, np.ndarray]:
    """The tensors of a split, by safetensors alone."""
    files: list[dict[str, np.ndarray]] = []
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, "numpy") as file:
            files.append({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    return {name: np.concatenate([file[name] for file in files]) for name in files[0]}


def read_npz(folder: Path) -> dict[str, np.ndarray]:
    files = [np.load(path) for path in sorted(folder.glob("*.npz"))]
    return {name: np.concatenate([file[name] for file in files]) for name in files[0].files}


def read_webdataset(folder: Path) -> dict[str, np.ndarray]:
    """Grouped as WebDataset does: a sample is a run of members alike up to the first dot."""
    samples: list[dict[str, Any]] = []
    for path in sorted(folder.glob("*.tar")):
        with tarfile.open(path) as file:
            for member in file:
                key, _, extension = member.name.partition(".")
                content = file.extractfile(member)
                assert content is not None
                assert (member.mtime, member.uid, member.uname) == (0, 0, "")
                if not samples or samples[-1]["key"] != key:
                    samples.append({"key": key})
                if extension == "json":
                    samples[-1] |= json.loads(content.read())
                else:
                    array = np.load(io.BytesIO(content.read()))
                    samples[-1][extension.removesuffix(".npy")] = array
    return {name: np.stack([np.asarray(sample[name]) for sample in samples]) for name in samples[0]}


def read_parquet(folder: Path) -> dict[str, np.ndarray]:
    """By pandas, shapes from the file's metadata."""
    pd = pytest.importorskip("pandas")
    pq = pytest.importorskip("pyarrow.parquet")
    tables = []
    for path in sorted(folder.glob("*.parquet")):
        shapes = json.loads(pq.read_schema(path).metadata[b"scapo"])["shapes"]
        rows = pd.read_parquet(path)
        values = {name: rows[name].to_numpy() for name in rows}
        nested = {name: np.stack(values[name]).reshape(-1, *s) for name, s in shapes.items() if s}
        tables.append({**values, **nested})
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


READERS = {"npz": read_npz, "webdataset": read_webdataset, "parquet": read_parquet}


@pytest.mark.parametrize("form", FORMATS)
def test_every_tensor_and_key_comes_back(data: Path, tmp_path: Path, form: str, capsys):
    if form == "parquet":
        pytest.importorskip("pyarrow")
    out = tmp_path / "out"
    assert run("export", data, "--format", form, "--out", out) == 0
    text = capsys.readouterr().out
    assert f"written to {out}" in text
    for name in SPLITS:
        assert f"{name}: 7 samples in 3 files" in text
        before, after = stored(data / name), READERS[form](out / name)
        _, category, split = name.split("/")
        for tensor, array in before.items():
            found = after.pop(tensor)
            assert found.dtype == array.dtype, tensor
            np.testing.assert_array_equal(found, array)
        assert after.pop("index").tolist() == list(range(7))
        assert after.pop("key").tolist() == [f"{category}-{split}-{i:07d}" for i in range(7)]
        named = [f"made-{i}" for i in before["instance"]]
        assert after.pop("instance_id").tolist() == named
        assert set(after) <= {"category", "split"}
        manifest = (data / name / "manifest.json").read_bytes()
        assert (out / name / "manifest.json").read_bytes() == manifest


@pytest.mark.parametrize("form", FORMATS)
def test_the_readme_that_comes_with_it_works(data: Path, tmp_path: Path, form: str, monkeypatch):
    """Its example is run, in the exported folder."""
    if form == "parquet":
        pytest.importorskip("pyarrow")
        pytest.importorskip("pandas")
    folder = data / "sensor"
    export(folder, [folder / "laptop/train"], tmp_path / "out", form)  # type: ignore[arg-type]
    text = (tmp_path / "out/README.md").read_text()
    (block,) = code_blocks(text, "python")
    monkeypatch.chdir(tmp_path / "out")
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    points = stored(folder / "laptop/train")["points"]
    expected = points[0] if form == "webdataset" else points[:3]
    np.testing.assert_array_equal(names["points"], expected)


@pytest.mark.parametrize("form", FORMATS)
def test_the_same_data_give_the_same_bytes(data: Path, tmp_path: Path, form: str):
    if form == "parquet":
        pytest.importorskip("pyarrow")
    folder = data / SPLITS[0]
    contents = []
    for name in ("a", "b"):
        assert run("export", folder, "--format", form, "--out", tmp_path / name) == 0
        files = sorted(path for path in (tmp_path / name).rglob("*") if path.is_file())
        contents.append({path.relative_to(tmp_path / name): path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    assert Path("eyeglasses/test-ood/manifest.json") in contents[0]


def test_only_an_export_is_replaced(data: Path, tmp_path: Path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    flags = ("--format", "npz", "--out", out)
    assert run("export", data, *flags) == 1
    assert "expected nothing, or what this program wrote" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    assert run("export", data, *flags) == 0
    assert run("export", data / "sensor", *flags) == 0
    assert not (out / "clean").exists()


def test_damaged_data_leave_nothing(data: Path, tmp_path: Path, capsys):
    split = write_split(tmp_path / "d", "laptop", "train", sample_arrays("laptop", 4, 8))
    path = split.folder / "00000.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    assert run("export", tmp_path / "d", "--format", "npz", "--out", tmp_path / "out") == 1
    assert "expected sha256" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_parquet_says_that_pyarrow_is_missing(data: Path, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert run("export", data, "--format", "parquet", "--out", tmp_path / "out") == 1
    assert "expected pyarrow, found none (pip install 'scapo[export]')" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", [".", "export", "clean/eyeglasses/x", "../link/x", ".."])
def test_an_export_lies_outside_of_the_data(place: str, tmp_path: Path, capsys):
    """Its manifests would be taken for splits of the data set."""
    root = tmp_path / "data"
    write_split(root, "laptop", "train", sample_arrays("laptop", 3, 16))
    (tmp_path / "link").symlink_to(root)
    before = sorted(root.rglob("*"))
    assert run("export", root, "--format", "npz", "--out", root / place) == 1
    assert "expected a place outside the source" in capsys.readouterr().err.replace("\n", " ")
    assert sorted(root.rglob("*")) == before
