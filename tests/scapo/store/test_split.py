# SPDX-License-Identifier: MIT
"""Splits on disk: found in every layout, read whole, refused where shards and manifest differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scapo import store
from scapo.store import Split, StoreError, find_split, open_split
from tests.helpers.splits import POINTS, edit_manifest, sample_arrays, write_split


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_split(tmp_path / "train", counts=(3, 1, 4))


def test_arrays_are_the_shards_in_order(folder: Path) -> None:
    split = Split(folder)
    found = split.arrays("points", "part", "instance")
    assert list(found) == ["points", "part", "instance"]
    for name, array in found.items():
        each = [sample_arrays("laptop", n, i)[name] for i, n in enumerate((3, 1, 4))]
        np.testing.assert_array_equal(array, np.concatenate(each))
    assert split.arrays() == {}


def test_shards_hold_all_tensors_or_those_asked_for(folder: Path) -> None:
    split = Split(folder)
    assert [set(arrays) for arrays in split.shards()] == [set(sample_arrays("laptop", 1, 0))] * 3
    assert [list(arrays) for arrays in split.shards(("part",))] == [["part"]] * 3
    assert split.shapes(2)["points"] == (2, POINTS, 3)


def test_a_split_without_samples_has_arrays_of_length_0(tmp_path: Path) -> None:
    split = Split(write_split(tmp_path, counts=()))
    arrays = split.arrays("points", "part")
    assert arrays["points"].shape == (0, POINTS, 3)
    assert arrays["part"].dtype == np.uint8


def test_a_tensor_that_is_not_there_is_named_with_its_shard(folder: Path) -> None:
    with pytest.raises(StoreError) as caught:
        Split(folder).arrays("points", "color")
    path = folder / "00000.safetensors"
    assert str(caught.value) == f"{path}: expected tensor 'color', found none"


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("points", np.zeros((2, POINTS, 3), np.float32), r"expected shape \(3, 8, 3\), found \(2"),
        ("points", np.zeros((3, 9, 3), np.float32), r"expected shape \(3, 8, 3\), found \(3, 9"),
        ("points", np.zeros((3, POINTS, 3)), "expected dtype float32, found float64"),
        ("part", np.full((3, POINTS), 2, np.uint8), r"sample 0\[0\]: expected an index below 2"),
        ("joint_axis", np.zeros((3, 1, 3), np.float32), r"sample 0\[0\]: expected a unit vector"),
    ],
)
def test_shards_that_are_not_as_the_manifest_says_are_refused(
    tmp_path: Path, name: str, array: np.ndarray, message: str
) -> None:
    split = Split(write_split(tmp_path, change={name: array}))
    with pytest.raises(StoreError, match=rf"00000.safetensors: tensor '{name}'.*{message}"):
        split.arrays(name)
    with pytest.raises(StoreError, match=message):
        list(split.shards())


def test_a_shard_of_another_split_is_refused(tmp_path: Path) -> None:
    train = write_split(tmp_path / "train")
    other = write_split(tmp_path / "test", split="test")
    (other / "00001.safetensors").replace(train / "00001.safetensors")
    with pytest.raises(StoreError, match=r"00001.safetensors: split: expected 'train', found 'te"):
        Split(train).arrays("points")


def test_a_file_of_another_format_in_the_place_of_a_shard_is_refused(folder: Path) -> None:
    path = folder / "00001.safetensors"
    store.write(path, sample_arrays("laptop", 1, 1), {"format": store.PREDICTIONS})
    with pytest.raises(StoreError, match=r"expected format 'scapo-samples/1', found 'scapo-pred"):
        Split(folder).arrays("points")


def test_verify_finds_changed_and_missing_shards(folder: Path) -> None:
    split = Split(folder)
    split.verify()
    path = folder / "00001.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(StoreError, match=r"00001.safetensors: expected sha256 \w+, found \w+"):
        split.verify()
    path.unlink()
    with pytest.raises(StoreError, match=r"00001.safetensors: expected a shard of the manifest"):
        split.verify()
    with pytest.raises(StoreError, match=r"00001.safetensors: expected a file, found none"):
        split.arrays("points")


def test_a_broken_manifest_is_a_store_error(folder: Path) -> None:
    edit_manifest(folder, count=9)
    with pytest.raises(StoreError, match=r"manifest.json: expected count 9, found 8 in shards"):
        Split(folder)


@pytest.mark.parametrize(
    ("place", "category"),
    [
        (".", None),
        (".", "laptop"),
        ("train", None),
        ("train", "laptop"),
        ("laptop/train", None),
        ("laptop/train", "laptop"),
        ("sim-art-1/laptop/train", None),
        ("sim-art-1/laptop/train", "laptop"),
    ],
)
@pytest.mark.parametrize("name", ["data", "a folder [1] *? 数据"])
def test_a_split_is_found_in_every_layout(
    tmp_path: Path, place: str, category: str | None, name: str
) -> None:
    top = tmp_path / name
    folder = write_split(top / place)
    write_split(top / place / ".." / "test", split="test")
    assert find_split(top, category, "train").resolve() == folder.resolve()
    assert open_split(str(top), category).manifest.category == "laptop"


def test_the_nearer_split_is_taken(tmp_path: Path) -> None:
    for place in ("laptop/train", "benchmark/laptop/train"):
        write_split(tmp_path / place)
    assert find_split(tmp_path, "laptop", "train") == tmp_path / "laptop" / "train"


def test_several_splits_that_fit_are_named(tmp_path: Path) -> None:
    for category in ("laptop", "safe"):
        write_split(tmp_path / category / "train", category)
    with pytest.raises(StoreError) as caught:
        find_split(tmp_path, None, "train")
    message = "expected one */train, found laptop/train, safe/train"
    assert str(caught.value) == f"{tmp_path}: {message}"
    assert find_split(tmp_path, "safe", "train") == tmp_path / "safe" / "train"
    for benchmark in ("one", "two"):
        write_split(tmp_path / benchmark / "oven" / "train", "oven")
    with pytest.raises(StoreError, match=r"expected one oven/train, found one/oven/train, two/ov"):
        find_split(tmp_path, "oven", "train")


def test_what_is_there_is_said_where_nothing_fits(tmp_path: Path) -> None:
    for place in ("laptop/train", "laptop/test", "set/safe/train"):
        category, split = Path(place).parts[-2:]
        write_split(tmp_path / place, category, split)
    there = "laptop/test, laptop/train, set/safe/train"
    for category, split, wanted in (
        ("oven", "train", "oven/train"),
        ("laptop", "val", "laptop/val"),
        (None, "val", r"\*/val"),
        ("safe", "test", "safe/test"),
        ("", "", r"\*/"),
        ("..", "train", r"\.\./train"),
    ):
        with pytest.raises(StoreError, match=rf"expected {wanted}/manifest.json, found {there};"):
            find_split(tmp_path, category, split)


def test_a_split_in_a_folder_of_another_name_is_not_taken_for_it(tmp_path: Path) -> None:
    write_split(tmp_path / "test", split="train")
    with pytest.raises(StoreError, match=r"expected \*/test/manifest.json, found test;"):
        find_split(tmp_path, None, "test")
    with pytest.raises(StoreError, match=r"`scapo-data generate safe --split val --out .*` makes"):
        find_split(tmp_path, "safe", "val")


def test_an_empty_a_missing_and_no_folder(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"expected laptop/train/manifest.json, found none;"):
        find_split(tmp_path, "laptop", "train")
    with pytest.raises(StoreError, match=r"gone: expected .* found none; `scapo-data generate"):
        find_split(tmp_path / "gone", "laptop", "train")
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"file: expected a folder of samples, found a file$"):
        open_split(tmp_path / "file", "laptop")


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, "\x00", '{"format": 1}', "3"])
def test_a_broken_manifest_is_reported_as_such_not_as_missing(tmp_path: Path, text: str) -> None:
    folder = write_split(tmp_path / "laptop" / "train")
    (folder / "manifest.json").write_text(text)
    with pytest.raises(StoreError, match=r"laptop/train.*manifest.json"):
        open_split(tmp_path, "laptop")
