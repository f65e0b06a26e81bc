# SPDX-License-Identifier: MIT
"""Links, names and numbers out of the ordinary among good models: each costs itself alone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sim_assets.generation.assets import folder_assets
from sim_assets.inspect.check import check
from sim_assets.models.library import MAX_ID, find, instance_id, select
from sim_assets.models.validate import AssetError, read_number, refuse
from sim_assets.options import DataOptions, SplitName
from tests.helpers.urdfs import cabinet

LONG = "n" * 250


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """Two good models, and eight entries that are none or odd."""
    folder = tmp_path / "models"
    for name in ("good", "other", LONG):
        cabinet(folder / name)
    cabinet(Path(os.fsdecode(os.fsencode(folder) + b"/\xff\xfe")))
    (tmp_path / "outside.urdf").write_text("<robot/>")
    for name, target in (
        ("dangling", "none.urdf"),
        ("circle", "cabinet.urdf"),
        ("outside", tmp_path / "outside.urdf"),
        ("device", "/dev/zero"),
        ("inside", folder / "good/cabinet.urdf"),
    ):
        (folder / name).mkdir()
        (folder / name / "cabinet.urdf").symlink_to(target)
    (folder / "pipe").mkdir()
    os.mkfifo(folder / "pipe/cabinet.urdf")
    (folder / "folder/cabinet.urdf").mkdir(parents=True)
    return folder


def test_the_others_go_on(odd: Path):
    results = {result.path.split("/")[0]: result for result in check(odd)}
    refused = {name for name, result in results.items() if result.status == "refused"}
    assert refused == {"dangling", "circle", "outside", "device", "pipe", "\\udcff\\udcfe"}
    assert {name for name in results if name not in refused} == {"good", "other", "inside", LONG}
    for result in results.values():
        assert (result.path + result.reason).isprintable()
        assert (result.path + result.reason).encode()


def test_they_have_names_of_their_own(odd: Path):
    found = find(odd)
    names = [instance_id(urdf, odd) for urdf in found]
    assert len(set(names)) == len(names) == 10
    assert all(len(name) <= MAX_ID and name.isascii() for name in names)
    assert instance_id(odd / "good/cabinet.urdf", odd) == "good"
    assert sum(len(select(found, split, odd)) for split in ("train", "val", "test")) == 10
    splits: tuple[SplitName, ...] = ("train", "val", "test")
    for split in splits:
        options = DataOptions(source=str(odd), split=split)
        for asset in folder_assets("oven", options):
            if asset.name not in ("good", "other", "inside") and not asset.name.startswith("nnn"):
                with pytest.raises(AssetError, match="expected"):
                    asset.load()


@pytest.mark.parametrize("word", ["1_0", "\u0661", "0x1", "", "1 0", None, True, [], 10**400])
def test_what_is_no_number(word: object):
    with pytest.raises(ValueError, match=r"."):
        read_number(word)


@pytest.mark.parametrize("word", ["1.5", "-2e-3", "+.5", "3.", 7, 0.25])
def test_what_is_one(word: str | float):
    assert read_number(word) == float(word)


def test_a_refusal_is_one_short_line():
    error = refuse(Path("a\nb"), "x" * 10_000, "\x1b[2J" + "y" * 10_000)
    assert len(str(error)) < 1500
    assert str(error).isprintable()
