# SPDX-License-Identifier: MIT
"""Folders of models: which file stands for a model, its id, its split."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sim_assets.models.library import (
    SPLITS,
    find,
    hash_split,
    instance_id,
    select,
    source_root,
    undivided,
)
from sim_assets.models.validate import AssetError

FIRST = ["test", "train", "train", "test"]
"""Must never change: a model's split is the same in every version."""


def touch(root: Path, *names: str) -> list[Path]:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return [root / name for name in names]


def names(paths: list[Path], root: Path) -> list[str]:
    return [path.relative_to(root).as_posix() for path in paths]


def test_one_urdf_per_model(tmp_path: Path):
    touch(
        tmp_path,
        "b/mobility.urdf",
        "b/mobility_repo.urdf",
        "b/other.urdf",
        "a/x/robot.urdf",
        "a/x/robot_cvx.urdf",
        "c/cup_fixed.urdf",
        "d/cup.urdf",
        "d/cup_cvx.urdf",
        "d/mug.urdf",
        "e/notes.txt",
        ".hidden/mobility.urdf",
        "f/.mobility.urdf",
        "g/MODEL.URDF",
    )
    expected = ["a/x/robot.urdf", "b/mobility.urdf", "c/cup_fixed.urdf", "d/cup.urdf"]
    assert names(find(tmp_path), tmp_path) == [*expected, "d/mug.urdf", "g/MODEL.URDF"]
    assert find(tmp_path / "b/other.urdf") == [tmp_path / "b/other.urdf"]


def test_links_to_folders_are_not_followed(tmp_path: Path):
    touch(tmp_path, "a/mobility.urdf")
    (tmp_path / "a/again").symlink_to(tmp_path)
    assert names(find(tmp_path), tmp_path) == ["a/mobility.urdf"]


def test_nothing_to_find(tmp_path: Path):
    with pytest.raises(AssetError, match="none"):
        find(tmp_path)
    with pytest.raises(AssetError, match="nothing"):
        find(tmp_path / "absent")
    with pytest.raises(AssetError, match="a file"):
        find(touch(tmp_path, "a.txt")[0])


def test_ids_are_safe_and_distinct(tmp_path: Path):
    paths = touch(
        tmp_path,
        "one/mobility.urdf",
        "a b/mobility.urdf",
        "a_b/mobility.urdf",
        "a-b/c/mobility.urdf",
        "a/b-c/mobility.urdf",
        "a/b/c/mobility.urdf",
        "ü/mobility.urdf",
        "flat/cup.urdf",
        "flat/mug.urdf",
        "top.urdf",
    )
    ids = [instance_id(path, tmp_path) for path in paths]
    assert len(set(ids)) == len(ids)
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+", word) for word in ids)
    assert ids[0] == "one"
    assert ids[-2] == "flat-mug"
    assert ids[-1] == tmp_path.name or ids[-1].startswith(tmp_path.name[:20])


def test_few_models_are_not_divided(tmp_path: Path):
    paths = touch(tmp_path, *(f"{k}/mobility.urdf" for k in range(9)))
    for split in SPLITS:
        assert select(paths, split, tmp_path) == paths
    assert undivided(tmp_path) == 9
    touch(tmp_path, "9/mobility.urdf")
    assert undivided(tmp_path) == 0


def test_many_models_are_divided_by_hash(tmp_path: Path):
    paths = touch(tmp_path, *(f"model{k}/mobility.urdf" for k in range(400)))
    parts = {split: select(paths, split, tmp_path) for split in SPLITS}
    assert sorted(parts["train"] + parts["val"] + parts["test"]) == sorted(paths)
    shares = [len(parts[split]) / 400 for split in SPLITS]
    assert shares == pytest.approx([0.7, 0.1, 0.2], abs=0.06)
    # The rest of the set has no say.
    assert select(paths[:50], "train", tmp_path) == [p for p in paths[:50] if p in parts["train"]]
    assert [hash_split(f"model{k}") for k in range(4)] == FIRST


def test_own_splits_are_kept(tmp_path: Path):
    paths = touch(tmp_path, "oven/train/a/mobility.urdf", "oven/test/b/mobility.urdf")
    assert select(paths, "train", tmp_path) == paths[:1]
    assert select(paths, "test", tmp_path) == paths[1:]
    with pytest.raises(AssetError, match="none of 2"):
        select(paths, "val", tmp_path)
    assert undivided(tmp_path) == 0
    alone = touch(tmp_path / "train", "c/mobility.urdf")
    assert select(alone, "test", tmp_path / "train") == alone


def test_a_packages_folder_of_urdfs_belongs_to_the_package(tmp_path: Path):
    package, other = touch(tmp_path, "cabinet/urdf/cabinet.urdf", "set/urdf/one/mobility.urdf")
    inner = package.parent
    assert source_root(inner) == source_root(package) == inner.parent.resolve()
    assert source_root(inner.parent) == inner.parent
    # Models in folders of their own: nothing above the source is theirs.
    assert source_root(other.parents[1]) == other.parents[1]
    assert instance_id(package, source_root(inner)) == "cabinet"
