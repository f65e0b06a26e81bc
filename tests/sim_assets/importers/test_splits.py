# SPDX-License-Identifier: MIT
"""OP-Align's clouds: files in its layouts come back as the views that they were made of."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from scapo.categories import CATEGORIES
from scapo.store import Split, open_split
from sim_assets.describe.info import describe_split, find_splits
from sim_assets.importers import op_align_real
from sim_assets.importers.sets import import_set
from sim_assets.procedural import generate
from tests.helpers import boxes, foreign
from tests.helpers.foreign import View, light_set

QUARTER = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
H = np.sqrt(0.5)
EIGHTH = np.array([[H, 0, -H], [0, 1, 0], [H, 0, H]])
REAL = {
    "basket_output": ("basket", np.eye(3)),
    "drawer_output": ("drawer", np.eye(3)),
    "laptop_output": ("laptop", QUARTER),
    "suitcase_output": ("suitcase", QUARTER),
    "scissor_output": ("scissors", np.eye(3)),
}
LIGHT = {
    "laptop_h": ("laptop", EIGHTH),
    "safe": ("safe", np.eye(3)),
    "oven": ("oven", np.eye(3)),
    "washing_machine": ("washer", np.eye(3)),
    "eyeglasses": ("eyeglasses", np.eye(3)),
}
PUBLISHED = {
    "laptop_output": np.diag([-1.0, 1, -1]),
    "suitcase_output": np.diag([-1.0, 1, -1]),
    "basket_output": np.diag([-1.0, -1, 1]),
    "scissor_output": np.diag([1.0, -1, -1]),
    "eyeglasses": np.diag([1.0, -1, -1]),
    "laptop_h": np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]]),
}
"""Swap symmetries in the sets' own part frames (docs/protocol.md)."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_turn_makes_the_published_symmetry_ours(name: str):
    category, turn = (REAL | LIGHT)[name]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    symmetry = np.array(CATEGORIES[category].symmetry)
    np.testing.assert_allclose(turn @ symmetry @ turn.T, PUBLISHED[name], atol=1e-12)


def assert_is(view: View, folder: Path, split: str, points: int) -> dict[str, np.ndarray]:
    """Sample 0 of a split is the view, up to single precision; what it holds besides."""
    names = ("points", "part", "camera_T_part", "joint_pivot", "joint_axis", "joint_state")
    found = open_split(folder, split=split).arrays(*names, "visible", "camera", "instance")
    sample = {name: array[0] for name, array in found.items()}
    assert sample["points"].shape == (points, 3)
    np.testing.assert_allclose(sample["camera_T_part"], view.camera_T_part, atol=1e-5)
    np.testing.assert_allclose(sample["joint_pivot"], view.pivot, atol=1e-5)
    np.testing.assert_allclose(sample["joint_axis"], view.axis, atol=1e-5)
    return sample


@pytest.mark.parametrize("name", REAL)
def test_real(name: str, tmp_path: Path):
    category, turn = REAL[name]
    obj = generate(category, "train", 3, 0)
    view = foreign.view_of(obj, 0.6 * obj.upper, seed=1)
    place = f"{name}/test/hp_acn/60_box/input_2/1702990423.5.npz"
    record = foreign.real_record(view, turn)
    foreign.write_npz(record, tmp_path / "set" / place)
    made = import_set(
        "op-align-real", tmp_path / "set", tmp_path.with_name(f"{tmp_path.name}-out"), points=512
    )
    folder = tmp_path.with_name(f"{tmp_path.name}-out") / category / "test"
    assert made.written == [folder]
    assert (made.samples, made.refused) == (1, {})
    sample = assert_is(view, folder, "test", 512)
    # Every point is one of the view's, with its part; the two of the background are 255.
    for point, part in zip(sample["points"], sample["part"], strict=True):
        if part == 255:
            np.testing.assert_allclose(point, (0.01, -0.02, 0.9), atol=1e-6)
        else:
            gap = np.abs(view.points - point).max(1)
            assert gap.min() < 1e-6
            assert view.part[gap.argmin()] == part
    assert np.isnan(sample["joint_state"]).all()
    assert np.isnan(sample["visible"]).all()
    np.testing.assert_allclose(sample["camera"][:4], (600, 600, 320, 240), atol=3)
    np.testing.assert_allclose(sample["camera"][4:], (640, 480))
    manifest = open_split(folder, split="test").manifest
    assert [instance.id for instance in manifest.instances] == ["hp_acn"]
    assert manifest.instances[0].source == f"{name}/test/hp_acn/60_box/input_2"
    color = open_split(folder, split="test").arrays("color")["color"]
    assert color.shape == (1, 512, 3)
    assert color.std() > 50


def test_real_keeps_every_point_of_the_detection(tmp_path: Path):
    view = foreign.view_of(boxes.laptop(), [0.5], seed=1, count=400)
    record = foreign.real_record(view, QUARTER)
    kept = int((record["detection"] & record["pc"].any(1)).sum())
    foreign.write_npz(record, tmp_path / "laptop_output/train/a/b/input_2/1.npz")
    import_set("op-align-real", tmp_path, tmp_path.with_name(f"{tmp_path.name}-out"), points=kept)
    found = open_split(tmp_path.with_name(f"{tmp_path.name}-out")).arrays("points", "part")
    assert (found["part"] == 255).sum() == 2
    pc = record["pc"][record["detection"] & record["pc"].any(1)]
    np.testing.assert_allclose(found["points"][0], 0.1 * pc @ foreign.FLIP, atol=1e-6)


def test_camera_fit():
    rng = np.random.default_rng(0)
    column, row = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    z = rng.uniform(0.4, 1.2, (480, 640))
    points = np.stack([(column - 331) / 610 * z, (row - 238) / 605 * z, z], -1).reshape(-1, 3)
    valid = rng.random(len(points)) < 0.1
    camera = op_align_real.fit_camera(points, valid)
    np.testing.assert_allclose(camera, (610, 605, 331, 238, 640, 480), atol=1e-6)
    shuffled = rng.permutation(points)
    assert op_align_real.fit_camera(shuffled, valid) == op_align_real.NOMINAL
    assert op_align_real.fit_camera(points, np.zeros(len(points), bool)) == op_align_real.NOMINAL


ORDERS = {2: (1, 0), 3: (1, 0, 2)}


@pytest.mark.parametrize("name", LIGHT)
def test_light(name: str, tmp_path: Path):
    """The base is the second part of the file, as its last entry of 0 tells."""
    category, turn = LIGHT[name]
    obj = generate(category, "train", 3, 0)
    state = 0.6 * obj.upper
    view = foreign.view_of(obj, state, seed=2, count=1536)
    centre = view.points.mean(0)
    diagonal = CATEGORIES[category].diagonal
    order = ORDERS[len(obj.visuals)]
    record = foreign.light_record(view, turn, diagonal, order)
    foreign.write_pt(record, tmp_path / f"pc/partial/{name}/train/203.pt")
    made = import_set(
        "op-align-light", tmp_path / "pc", tmp_path.with_name(f"{tmp_path.name}-out"), points=1536
    )
    assert made.written == [tmp_path.with_name(f"{tmp_path.name}-out") / category / "train"]
    shift = np.eye(4)
    shift[:3, 3] = -centre
    moved = View(
        points=view.points - centre,
        part=view.part,
        camera_T_part=shift @ view.camera_T_part,
        pivot=view.pivot - centre,
        axis=view.axis,
    )
    sample = assert_is(moved, tmp_path.with_name(f"{tmp_path.name}-out"), "train", 1536)
    np.testing.assert_allclose(sample["points"], moved.points, atol=1e-6)
    np.testing.assert_array_equal(sample["part"], view.part)
    assert np.isnan(sample["visible"]).all()
    if category in ("laptop", "safe"):
        assert np.isnan(sample["joint_state"]).all()
    else:
        np.testing.assert_allclose(sample["joint_state"], state, atol=1e-5)
    (folder,) = find_splits(tmp_path.with_name(f"{tmp_path.name}-out"))
    described = describe_split(Split(folder))
    assert described.damage == ""
    assert re.search(r"^  \S.* visible +unknown$", described.text, re.MULTILINE)
    (instance,) = open_split(tmp_path.with_name(f"{tmp_path.name}-out")).manifest.instances
    assert instance.id == f"{name}-train-002"
    assert instance.source == f"partial/{name}/train"


def test_light_axes_are_turned_so_that_states_are_positive(tmp_path: Path):
    obj = generate("oven", "train", 3, 0)
    view = foreign.view_of(obj, 0.6 * obj.upper, seed=2, count=256)
    record = foreign.light_record(view, np.eye(3), 1.0, (0, 1))
    record["part_axis"] = -record["part_axis"]
    foreign.write_pt(record, tmp_path / "full/oven/train/0.pt")
    import_set("op-align-light", tmp_path, tmp_path.with_name(f"{tmp_path.name}-out"), points=64)
    found = open_split(tmp_path.with_name(f"{tmp_path.name}-out")).arrays(
        "joint_axis", "joint_state", "visible"
    )
    np.testing.assert_allclose(found["joint_axis"][0], view.axis, atol=1e-5)
    np.testing.assert_allclose(found["joint_state"][0], 0.6 * obj.upper, atol=1e-5)
    np.testing.assert_array_equal(found["visible"], 1)


def test_splits_instances_and_variants(tmp_path: Path):
    light_set(tmp_path / "a", {"full/laptop_h/train": 3, "full/laptop_h/test": 1})
    made = import_set("op-align-light", tmp_path / "a", tmp_path / "one", points=16)
    assert made.written == [tmp_path / "one/laptop/test", tmp_path / "one/laptop/train"]
    split = open_split(tmp_path / "one", "laptop", "train")
    assert split.arrays("instance")["instance"].tolist() == [0, 1, 1]
    ids = [instance.id for instance in split.manifest.instances]
    assert ids == ["laptop_h-train-000", "laptop_h-train-001"]
    split.verify()
    light_set(tmp_path / "a", {"partial/laptop_h/train": 1, "full/laptop_m/train": 1})
    made = import_set("op-align-light", tmp_path / "a", tmp_path / "more", points=16)
    names = {path.relative_to(tmp_path / "more").as_posix() for path in made.written}
    assert names == {
        "laptop/test",
        "full-laptop_h/laptop/train",
        "partial-laptop_h/laptop/train",
        "full-laptop_m/laptop/train",
    }


def shard_bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_points_depend_on_the_files_name_alone(tmp_path: Path):
    """The same set elsewhere gives the same bytes, and a sample does not change with the others."""
    for place in ("a", "b/c"):
        light_set(tmp_path / place, {"full/laptop_h/train": 3})
        import_set("op-align-light", tmp_path / place, tmp_path / "out" / place, points=16)
    folders = [tmp_path / "out" / place / "laptop/train" for place in ("a", "b/c")]
    assert shard_bytes(folders[0]) == shard_bytes(folders[1])
    before = open_split(folders[0]).arrays("points")["points"]
    assert np.abs(before[0] - before[1]).max() > 1e-3  # the same cloud, drawn anew
    (tmp_path / "a/full/laptop_h/train/99.pt").unlink()
    import_set("op-align-light", tmp_path / "a/full", tmp_path / "out/a", points=16)
    after = open_split(folders[0]).arrays("points")["points"]
    np.testing.assert_array_equal(after, before[1:])
    assert sorted(path.name for path in folders[0].parent.iterdir()) == ["train"]


def test_more_than_a_shard_and_too_few_points(tmp_path: Path):
    light_set(tmp_path, {"full/laptop_h/train": 70})
    made = import_set(
        "op-align-light", tmp_path, tmp_path.with_name(f"{tmp_path.name}-out"), points=200
    )
    assert made.samples == 70
    split = open_split(tmp_path.with_name(f"{tmp_path.name}-out"))
    assert [shard.count for shard in split.manifest.shards] == [64, 6]
    split.verify()
    points = split.arrays("points")["points"][69]
    assert len(np.unique(points, axis=0)) < 128  # with replacement


def test_other_data_are_never_replaced(tmp_path: Path):
    out = tmp_path / "out"
    light_set(tmp_path / "set", {"full/laptop_h/train": 1})
    place = out / "laptop/train"
    place.mkdir(parents=True)
    import_set("op-align-light", tmp_path / "set", out, points=8)
    (place / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match="expected nothing, or data from op-align-light"):
        import_set("op-align-light", tmp_path / "set", out, points=8)
    assert (place / "manifest.json").read_text() == "{}"
