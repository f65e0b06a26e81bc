# SPDX-License-Identifier: MIT
"""What is said of a model that was read, and which models are not taken for a category."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scapo.store import open_split
from sim_assets.generation.assets import UrdfAsset, recover
from sim_assets.inspect.check import Options, check, check_one
from sim_assets.models.account import check_speaks, sentences
from sim_assets.models.reader import read
from sim_assets.models.validate import AssetError
from sim_assets.procedural import generate as make
from tests.helpers.programs import run
from tests.helpers.urdfs import cabinet

FLAT = ("--protocol", "full", "--points", 64, "--workers", 0, "--count", 4)


def flap(folder: Path) -> Path:
    """The cabinet with a door that is not called one."""
    return cabinet(folder, ('name="door"', 'name="flap"'), ('link="door"', 'link="flap"'))


def test_joint_size_and_repairs_are_said(tmp_path: Path):
    urdf = cabinet(tmp_path, ('version="1.0"', 'version="0.0"'))
    thing = read(urdf, "safe")
    joint, size, repair = sentences(thing)
    assert joint == "joint hinge (door)"
    assert size == "size 0.52 x 0.4 x 0.6 m, as given"
    assert repair == "repaired: The XML version '0.0' was read as '1.0'"


def test_the_size_says_how_it_was_chosen(tmp_path: Path):
    """By the caller, or, of a model 100 times too large for its category, by the category."""
    urdf = cabinet(tmp_path / "a")
    assert sentences(read(urdf, "safe", scale=0.5))[1] == "size 0.26 x 0.2 x 0.3 m, 0.5 m a unit"
    large = cabinet(tmp_path / "b", ('xyz="-0.26 0.2 0"', 'xyz="-260 0.2 0"'))
    thing = read(large, "safe")
    assert np.linalg.norm(thing.extents()) == pytest.approx(thing.category.diagonal)
    assert sentences(thing)[1].endswith("a unit, the category's nominal diagonal of 0.65 m")


def test_made_objects_have_no_account():
    thing = make("oven", "train", 1, 0)
    assert thing.origin.account is None
    assert sentences(thing) == ()
    check_speaks(Path("made"), thing)


def test_a_model_that_does_not_speak_of_the_category_is_refused(tmp_path: Path):
    urdf = flap(tmp_path)
    message = r"speaks of the category 'oven' \(door, oven\), found body, flap \(--any-model takes"
    with pytest.raises(AssetError, match=message):
        UrdfAsset(urdf=urdf, root=tmp_path, category="oven").load()
    thing = UrdfAsset(urdf=urdf, root=tmp_path, category="oven", any_model=True).load()
    assert sentences(thing)[0] == "joint hinge (flap)"
    assert check_one(urdf, tmp_path, Options(category="oven")).status == "refused"
    taken = check_one(urdf, tmp_path, Options(category="oven", any_model=True))
    assert (taken.status, taken.account[0]) == ("accepted", "joint hinge (flap)")
    assert check_one(urdf, tmp_path, Options()).status == "accepted"


@pytest.mark.parametrize(
    "change",
    [
        ('robot name="cabinet"', 'robot name="my_oven"'),
        ('joint name="hinge"', 'joint name="DoorHinge"'),
        ('link name="body"', 'link name="oven-body"'),
    ],
)
def test_any_of_its_names_may_speak(tmp_path: Path, change: tuple[str, str]):
    urdf = flap(tmp_path)
    text = urdf.read_text().replace(*change)
    if "oven-body" in change[1]:
        text = text.replace('parent link="body"', 'parent link="oven-body"')
    urdf.write_text(text)
    assert check_one(urdf, tmp_path, Options(category="oven")).status == "accepted"


def test_semantics_speak_where_links_do_not(tmp_path: Path):
    """As PartNet-Mobility has it: links have numbers, `semantics.txt` says what they are."""
    urdf = flap(tmp_path)
    urdf.write_text(urdf.read_text().replace('name="cabinet"', 'name="partnet_1"'))
    semantics = tmp_path / "semantics.txt"
    semantics.write_text("body heavy box_body\nflap hinge rotation_lid\n")
    assert check_one(urdf, tmp_path, Options(category="oven")).status == "refused"
    semantics.write_text("body heavy oven_body\nflap hinge rotation_door\n")
    result = check_one(urdf, tmp_path, Options(category="oven"))
    assert result.account[0] == "joint hinge (flap: rotation_door)"


def test_generate_says_what_it_took_and_leaves_out_what_does_not_belong(tmp_path: Path, capsys):
    cabinet(tmp_path / "models/good")
    flap(tmp_path / "models/other")
    source = ("--source", tmp_path / "models")
    assert run("generate", "oven", "--out", tmp_path / "a", *source, *FLAT) == 1
    text = capsys.readouterr().out
    assert "taken good: joint hinge (door); size 0.52 x 0.4 x 0.6 m, as given" in text
    assert "left out other: " in text
    assert "speaks of the category 'oven'" in text
    (instance,) = open_split(tmp_path / "a", "oven").manifest.instances
    assert (instance.id, instance.account[0]) == ("good", "joint hinge (door)")
    assert run("generate", "oven", "--out", tmp_path / "b", *source, *FLAT, "--any-model") == 0
    assert "taken other: joint hinge (flap)" in capsys.readouterr().out
    split = open_split(tmp_path / "b", "oven")
    assert [row.id for row in split.manifest.instances] == ["good", "other"]
    assert split.manifest.options["any_model"] is True
    assert recover(split.manifest, 1, tmp_path / "models").instance == "other"
    assert "--any-model" in (split.folder / "card.md").read_text()


def test_check_prints_it(tmp_path: Path, capsys):
    cabinet(tmp_path)
    assert run("check", tmp_path, "--category", "oven", "--workers", 1) == 0
    assert "joint hinge (door); size 0.52 x 0.4 x 0.6 m, as given" in capsys.readouterr().out


def test_of_the_real_models_no_scissors_taps_or_carts_become_ovens(shared_dir: Path):
    results = check(shared_dir / "assets", Options(category="oven"), workers=2)
    taken = {result.path.split("/")[0] for result in results if result.status != "refused"}
    refused = {
        result.path.split("/")[0]: result.reason for result in results if result.status == "refused"
    }
    assert {"oven", "dishwasher", "microwave", "fridge"} <= taken
    for name in ("scissors", "faucet", "cart", "eyeglasses", "stapler", "bucket", "box", "laptop"):
        assert name not in taken
        assert "speaks of the category 'oven'" in refused[name]
    ovens = [result for result in results if result.path.startswith("oven/")]
    assert len(ovens) == 3
    for result in ovens:
        assert result.account[0] == "joint joint_0 (link_0: door)"
        assert result.account[1].endswith("the category's nominal diagonal of 1.05 m")
