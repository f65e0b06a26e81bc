# SPDX-License-Identifier: MIT
"""The torch data set: equal to the arrays on disk by any index, loader and number of workers."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import DataLoader, default_collate

from scapo import store
from scapo.store import samples as data
from scapo.store.files import sha256_file
from scapo.store.samples import OPTIONAL, TENSORS, SampleDataset, label, observe, observed
from scapo.store.schema import ALIKE, LAYOUT, StoreError
from tests.helpers.splits import POINTS, edit_manifest, sample_arrays, write_split

COUNTS = (3, 1, 4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_split(tmp_path / "train", "eyeglasses", counts=COUNTS)


@pytest.fixture
def samples(folder: Path) -> SampleDataset:
    return store.dataset(folder)


def expected_arrays() -> dict[str, np.ndarray]:
    """What the fixture wrote, as it must arrive."""
    each = [sample_arrays("eyeglasses", n, i) for i, n in enumerate(COUNTS)]
    whole = {name: np.concatenate([arrays[name] for arrays in each]) for name in each[0]}
    whole["part"] = np.where(whole["part"] == 255, -1, whole["part"].astype(np.int64))
    return {**whole, "index": np.arange(sum(COUNTS))}


def same(found: dict[str, Tensor], index: int | np.ndarray) -> None:
    expected = expected_arrays()
    assert set(found) == set(expected)
    for name, array in expected.items():
        assert found[name].numpy().dtype == array.dtype, name
        np.testing.assert_array_equal(found[name].numpy(), array[index], err_msg=name)


def test_the_folder_of_a_split_is_that_split(tmp_path: Path) -> None:
    for split, counts in (("train", (3,)), ("val", (2,))):
        write_split(tmp_path / "laptop" / split, split=split, counts=counts)
    assert len(store.dataset(tmp_path / "laptop" / "val")) == 2
    assert len(store.dataset(tmp_path / "laptop")) == len(store.dataset(tmp_path)) == 3
    with pytest.raises(StoreError, match=r"test/manifest\.json"):
        store.dataset(tmp_path / "laptop" / "val", split="test")


def test_items_are_the_samples_on_disk(samples: SampleDataset) -> None:
    assert len(samples) == 8
    for i in range(8):
        same(samples[i], i)
        same(samples[i - 8], i)
    same(samples[np.int32(5)], 5)
    same(samples[torch.tensor(5)], 5)
    with_part = samples[0]["part"]
    assert with_part.dtype == torch.int64
    assert with_part[-1] == -1
    assert int(with_part.max()) < 3


@pytest.mark.parametrize("index", [8, -9, 100])
def test_there_is_no_other_sample(samples: SampleDataset, index: int) -> None:
    with pytest.raises(IndexError, match=f"train: expected a sample below 8, found {index}"):
        samples[index]
    with pytest.raises(IndexError, match=f"found {index}"):
        samples.batch(torch.tensor([0, index]))


def test_iteration_ends(samples: SampleDataset) -> None:
    assert [int(item["index"]) for item in samples] == [*range(8)]


@pytest.mark.parametrize("indices", [[7, 0, 3, 3, 5, 2], [4], [*range(8)], [-1, 0, -8]])
def test_a_batch_keeps_the_order_asked_for(samples: SampleDataset, indices: list[int]) -> None:
    same(samples.batch(torch.tensor(indices)), np.array(indices))
    items = samples.__getitems__(indices)
    same(default_collate(items), np.array(indices))


def test_an_empty_batch(samples: SampleDataset) -> None:
    found = samples.batch(torch.zeros(0, dtype=torch.long))
    assert found["points"].shape == (0, POINTS, 3)
    assert found["index"].shape == (0,)
    assert samples.__getitems__([]) == []


def test_a_split_without_samples(tmp_path: Path) -> None:
    samples = store.dataset(write_split(tmp_path, counts=()))
    assert len(samples) == 0
    assert list(DataLoader(samples, batch_size=4)) == []
    with pytest.raises(IndexError, match="expected a sample below 0, found 0"):
        samples[0]
    assert samples.batch(torch.zeros(0, dtype=torch.long))["part"].shape == (0, POINTS)


@pytest.mark.parametrize("workers", [0, 2])
def test_loaders_give_each_sample_once_as_it_is_on_disk(folder: Path, workers: int) -> None:
    samples = store.dataset(folder)
    samples[0]  # a memory map open before the workers start stays behind
    loader = DataLoader(
        samples,
        batch_size=3,
        shuffle=True,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        generator=torch.Generator().manual_seed(0),
    )
    seen: list[int] = []
    for batch in loader:
        same(batch, batch["index"].numpy())
        seen += batch["index"].tolist()
    assert sorted(seen) == [*range(8)]
    assert seen != [*range(8)]


def test_changing_a_batch_changes_neither_the_file_nor_the_next(samples: SampleDataset) -> None:
    samples.batch(torch.arange(8))["points"].zero_()
    samples[0]["points"].zero_()
    same(samples.batch(torch.arange(8)), np.arange(8))


def test_each_shard_is_opened_once_and_only_when_asked_for(
    samples: SampleDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    original = data.safe_open

    def note(path: Path, framework: str) -> object:
        opened.append(path.name)
        return original(path, framework)

    monkeypatch.setattr(data, "safe_open", note)
    samples.batch(torch.tensor([0, 7, 1]))
    assert opened == ["00000.safetensors", "00002.safetensors"]
    samples.batch(torch.tensor([2, 6, 0]))
    assert len(opened) == 2
    copy.deepcopy(samples)[0]  # as a worker: opens its own
    assert opened[2:] == ["00000.safetensors"]


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="Linux lists memory maps there")
def test_shards_are_memory_mapped(folder: Path, samples: SampleDataset) -> None:
    path = str(folder / "00002.safetensors")
    samples[0]
    assert path not in Path("/proc/self/maps").read_text()
    samples[7]
    assert path in Path("/proc/self/maps").read_text()


def test_names_choose_the_tensors(folder: Path) -> None:
    assert set(TENSORS) == set(LAYOUT) - {*OPTIONAL, *ALIKE}
    assert observed(store.open_split(folder)) == TENSORS
    found = store.dataset(folder, names=("points", "part"))[0]
    assert set(found) == {"points", "part", "index"}
    with pytest.raises(StoreError, match=r"00000.safetensors: expected tensor 'color', found none"):
        store.dataset(folder, names=("points", "color"))[0]


def test_color_and_tensors_of_ones_own(tmp_path: Path) -> None:
    extra = {
        "color": np.arange(3 * POINTS * 3, dtype=np.uint8).reshape(3, POINTS, 3),
        "weight": np.array([0.5, 0.25, 2.0]),
    }
    extra["sensor"] = np.arange(9, dtype=np.float32).reshape(3, 3)
    folder = write_split(tmp_path, counts=(3,), change=extra)
    assert observed(store.open_split(folder)) == (*TENSORS, "color", "sensor")
    samples = store.dataset(folder, names=(*TENSORS, *extra))
    batch = samples.batch(torch.tensor([2, 0]))
    np.testing.assert_array_equal(batch["color"].numpy(), extra["color"][[2, 0]])
    assert batch["weight"].tolist() == [2.0, 0.5]
    seen = observe(batch)
    assert seen.color is not None
    np.testing.assert_allclose(seen.color.numpy(), extra["color"][[2, 0]] / 255, rtol=1e-6)
    assert seen.sensor is not None
    assert seen.sensor.tolist() == [[6.0, 7.0, 8.0], [0.0, 1.0, 2.0]]


@pytest.mark.parametrize("name", ["category", "split"])
def test_a_shard_of_another_data_set_is_refused(folder: Path, name: str) -> None:
    edit_manifest(folder, **{name: "other"})
    with pytest.raises(StoreError, match=rf"00000.safetensors: {name}: expected 'other', found"):
        store.dataset(folder, split="other" if name == "split" else "train")[0]


def test_impossible_values_are_refused_when_the_shard_is_opened(tmp_path: Path) -> None:
    axis = np.full((3, 2, 3), 0.1, np.float32)
    samples = store.dataset(write_split(tmp_path, "eyeglasses", change={"joint_axis": axis}))
    samples[4]
    with pytest.raises(StoreError, match=r"00000.safetensors: tensor 'joint_axis', sample 0\[0\]"):
        samples[1]


def test_a_cut_shard_is_refused(folder: Path) -> None:
    path = folder / "00001.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(StoreError, match=r"00001.safetensors: expected a safetensors file"):
        store.dataset(folder)[3]


def test_a_tensor_of_a_type_that_numpy_lacks_is_refused(folder: Path) -> None:
    path = folder / "00000.safetensors"
    tensors = load_file(path)
    header = {"scapo": store.canonical_json(store.read_header(path))}
    save_file({**tensors, "weight": torch.ones(3).bfloat16()}, path, header)
    shards = json.loads((folder / "manifest.json").read_text())["shards"]
    edit_manifest(folder, shards=[{**shards[0], "sha256": sha256_file(path)}, *shards[1:]])
    store.dataset(folder)[0]
    with pytest.raises(StoreError, match=r"00000.safetensors: expected numpy-readable tensors"):
        store.dataset(folder, names=("points", "weight"))[0]


def test_observations_and_labels_of_a_batch(samples: SampleDataset) -> None:
    batch = samples.batch(torch.arange(4))
    seen = observe(batch)
    assert seen.points is batch["points"]
    assert seen.color is None
    truth = label(batch)
    assert truth.part is batch["part"]
    assert truth.camera_T_part is batch["camera_T_part"]
    assert truth.joints is not None
    for name in ("pivot", "axis", "state"):
        assert getattr(truth.joints, name) is batch[f"joint_{name}"]
    single = label(samples[0])
    assert single.part is not None
    assert single.part.shape == (POINTS,)


def test_the_data_set_is_found_below_a_folder(tmp_path: Path) -> None:
    for category in ("laptop", "oven"):
        for split in ("train", "test"):
            write_split(tmp_path / category / split, category, split)
    samples = store.dataset(str(tmp_path), "oven", "test")
    assert samples.split.folder == tmp_path / "oven" / "test"
    assert data.dataset(tmp_path, "laptop").split.manifest.category == "laptop"
    with pytest.raises(StoreError, match=r"expected one \*/train, found laptop/train, oven/train"):
        store.dataset(tmp_path)
