# SPDX-License-Identifier: MIT
"""A folder of models for the benchmark's part `real`: which are taken, as what, and how shown."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from scapo.store import open_split
from sim_assets.describe.card import remake
from sim_assets.generation.assets import recover
from sim_assets.generation.benchmark import IDS, IDS_FORMAT, RECORD, pieces, read_record
from sim_assets.generation.real import KINDS, category_of, real_models
from sim_assets.models.validate import AssetError
from tests.helpers.programs import run
from tests.helpers.urdfs import cabinet

pytestmark = pytest.mark.usefixtures("raycast")


def found(path: Path) -> dict[str, list[str]]:
    models = real_models(path).models
    return {name: [asset.name for asset in assets] for name, assets in models.items()}


@pytest.mark.parametrize(
    ("text", "category"),
    [
        ("Refrigerator", "safe"),
        ("WashingMachine", "washer"),
        ("StorageFurniture", "drawer"),
        ("Dishwasher", "oven"),
        ("Eyeglasses", "eyeglasses"),
        ("glasses_body", "eyeglasses"),
        ("Scissors", "scissors"),
        ("Box", None),
        ("bucket_body", None),
        ("partnet_15b5c54a8ddc84353a5acb1c5cbd19ff", None),
        ("", None),
    ],
)
def test_kinds(text: str, category: str | None):
    assert category_of(text) == category
    assert all(category_of(name) == name for name in KINDS)


def test_who_says_what_a_model_is(tmp_path: Path):
    """The index before the model, the model before its folder."""
    cabinet(tmp_path / "drawer/a", ('name="cabinet"', 'name="my_laptop"'))
    assert found(tmp_path / "drawer") == {"laptop": ["a"]}
    assert found(tmp_path) == {"drawer": ["drawer-a"]}
    (tmp_path / "drawer/a/semantics.txt").write_text("body heavy oven_body\ndoor hinge drawer\n")
    assert found(tmp_path) == {"oven": ["drawer-a"]}
    (tmp_path / "drawer/a/meta.json").write_text(json.dumps({"model_cat": "Microwave"}))
    assert found(tmp_path) == {"safe": ["drawer-a"]}
    (tmp_path / "index.csv").write_text("category,id\ndrawer,b\nwasher,a\n")
    assert found(tmp_path) == {"safe": ["drawer-a"]}  # a row of another folder
    cabinet(tmp_path / "washer/a")
    assert found(tmp_path) == {"safe": ["drawer-a"], "washer": ["washer-a"]}


def test_what_belongs_to_no_category_is_named(tmp_path: Path):
    cabinet(tmp_path / "tap/1", ('robot name="cabinet"', 'robot name="tap"'))
    models = real_models(tmp_path)
    assert models.models == {}
    assert models.others == {"tap-1": f"expected one of {', '.join(KINDS)}, found 'tap 1', 'tap'"}
    assert pieces(("val",), models) == pieces(("val",))
    with pytest.raises(AssetError, match=r"expected a folder or a \.urdf file, found nothing"):
        real_models(tmp_path / "none")


def test_the_command(tmp_path: Path, capsys):
    for name in ("one", "two"):
        cabinet(tmp_path / "models/oven" / name)
    cabinet(tmp_path / "models/oven/lost", ("body.obj", "lost.obj"))
    cabinet(tmp_path / "models/tap/1", ('robot name="cabinet"', 'robot name="tap"'))
    out = tmp_path / "data"
    flags = ("--out", out, "--backend", "raycast", "--workers", 1, "--real", tmp_path / "models")
    assert run("benchmark", "sim-art/2", *flags, "--only", "real") == 1
    text = capsys.readouterr().out
    assert "no category tap-1: expected one of laptop, " in text
    assert "1/1 real/oven/test" in text
    assert "taken oven-one: joint hinge (door); size " in text
    assert "left out oven-lost: oven/lost/cabinet.urdf: expected the mesh file" in text
    split = open_split(out / "real", "oven", "test")
    manifest = split.manifest
    arrays = split.arrays("instance", "camera", "camera_T_part")
    assert np.bincount(arrays["instance"]).tolist() == [20, 20]
    assert (arrays["camera"][:, 4:] == 256).all()
    assert [row.id for row in manifest.instances] == ["oven-one", "oven-two"]
    assert (manifest.seed, manifest.options["source"]) == (2, "urdf")
    command = "scapo-data benchmark sim-art/2 --real FOLDER --only real/oven --out OUT"
    assert remake(manifest) == command
    assert recover(manifest, 1, tmp_path / "models").instance == "oven-two"
    entry = read_record(out / RECORD)["splits"]["real/oven/test"]
    assert (entry["samples"], entry["objects"]) == (40, 2)
    assert set(entry["left_out"]) == {"oven-lost"}
    assert str(tmp_path) not in (out / RECORD).read_text()
    assert read_record(out / IDS, IDS_FORMAT)["splits"] == {
        "real/oven/test": ["oven-one", "oven-two"]
    }
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert run("benchmark", "sim-art/2", *flags, "--only", "real/oven") == 1
    assert "there already, whole" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_nothing_readable_is_said(tmp_path: Path, capsys):
    cabinet(tmp_path / "models/oven/lost", ("body.obj", "lost.obj"))
    flags = ("--out", tmp_path / "d", "--backend", "raycast", "--workers", 1)
    flags += ("--real", tmp_path / "models", "--only", "real")
    assert run("benchmark", "sim-art/2", *flags) == 1
    error = capsys.readouterr().err
    assert "oven: expected real models that can be read: oven/lost/cabinet.urdf" in error


def test_every_model_of_the_shared_folder_that_belongs_to_a_category(shared_dir: Path):
    """By category; none is left out but those that are no such thing."""
    models = real_models(shared_dir / "assets")
    by_folder = {
        (name, asset.name.split("-")[0])
        for name, assets in models.models.items()
        for asset in assets
    }
    wanted = {
        ("laptop", "laptop"),
        ("safe", "microwave"),
        ("safe", "fridge"),
        ("oven", "oven"),
        ("oven", "dishwasher"),
        ("eyeglasses", "eyeglasses"),
        ("drawer", "storage"),
        ("scissors", "scissors"),
    }
    assert {pair for pair in by_folder if pair[1] != "quirks"} == wanted
    assert {name.split("-")[0] for name in models.others} == {
        "box",
        "bucket",
        "cart",
        "faucet",
        "stapler",
    }
    for assets in models.models.values():
        for asset in assets:
            if not asset.name.startswith("quirks"):
                assert asset.load().instance == asset.name


@pytest.mark.slow
def test_every_such_model_goes_through(shared_dir: Path, tmp_path: Path, capsys):
    """The quirks that are broken, and nothing else, are left out, each with its reason."""
    flags = ("--out", tmp_path, "--backend", "raycast", "--real", shared_dir / "assets")
    assert run("benchmark", "sim-art/2", *flags, "--workers", 2, "--only", "real") == 1
    text = capsys.readouterr().out
    left = [line.split()[2] for line in text.splitlines() if line.startswith("left out")]
    assert left == ["quirks-7320_missing_meshes:", "quirks-12414_all_fixed:"]
    splits = read_record(tmp_path / RECORD)["splits"]
    assert {name: entry["samples"] for name, entry in splits.items()} == {
        "real/laptop/test": 20,
        "real/safe/test": 140,
        "real/oven/test": 100,
        "real/eyeglasses/test": 60,
        "real/drawer/test": 100,
        "real/scissors/test": 20,
    }


def test_odd_files_beside_models_are_left_alone(tmp_path: Path):
    """Pipes, tags without an end, a record that says nothing: the folder's name counts."""
    for name in ("meta.json", "semantics.txt"):
        cabinet(tmp_path / "oven" / name.partition(".")[0])
        os.mkfifo(tmp_path / "oven" / name.partition(".")[0] / name)
    cabinet(tmp_path / "oven/tags").write_text("<robot " * 500_000)
    os.mkfifo(tmp_path / "index.csv")
    begun = time.process_time()
    assert sorted(found(tmp_path)["oven"]) == ["oven-meta", "oven-semantics", "oven-tags"]
    assert time.process_time() - begun < 10
    (tmp_path / "index.csv").unlink()
    (tmp_path / "index.csv").write_text("category,id\noven," + "x" * 200_000 + "\n")
    with pytest.raises(AssetError, match=r"index\.csv: expected a table with category and id"):
        found(tmp_path)
