# SPDX-License-Identifier: MIT
"""The benchmark's data at a small scale: what is made, recorded, and taken up again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scapo.categories import CATEGORIES
from scapo.parallel.pool import Pool
from scapo.store import open_split
from sim_assets.generation import benchmark
from sim_assets.generation.benchmark import (
    IDS,
    IDS_FORMAT,
    OLD_COMMIT,
    RECORD,
    SIZES,
    Piece,
    Task,
    make_benchmark,
    pieces,
    read_record,
)
from sim_assets.generation.generate import Running
from tests.helpers.programs import run

pytestmark = pytest.mark.usefixtures("raycast")

TINY: benchmark.Sizes = {"train": (2, 4), "val": (1, 3), "test": (1, 2), "test-ood": (1, 2)}
HERE = Running(workers=0)


def tiny(*only: str) -> Task:
    return Task(only=only, backend="raycast", sizes=TINY)


def test_all_of_contract_4_is_there():
    every = pieces()
    assert len(every) == 15 * 4
    by_part = {
        part: {piece.category for piece in every if piece.part == part}
        for part in ("clean", "sensor", "complete")
    }
    assert by_part["clean"] == {"laptop", "safe", "eyeglasses", "oven", "washer"}
    assert by_part["sensor"] == {"basket", "drawer", "laptop", "scissors", "suitcase"}
    assert by_part["complete"] == by_part["clean"]
    assert SIZES == {"train": (100, 50), "val": (50, 20), "test": (50, 20), "test-ood": (40, 20)}
    wanted = {
        "clean": ("sim-art", "none", "exact"),
        "sensor": ("sim-art-sensor", "disparity", "imperfect"),
        "complete": ("sim-art-complete", "none", "exact"),
    }
    for piece in every:
        options = piece.options(SIZES, "sapien")
        instances, each = SIZES[piece.split]
        assert (options.instances, options.count) == (instances, instances * each)
        assert (options.seed, options.points, options.backend) == (2, 1024, "sapien")
        assert (options.preset, options.noise, options.mask) == wanted[piece.part]
        assert options.ambiguity == (piece.split in ("test", "test-ood"))


@pytest.mark.parametrize(
    ("only", "names"),
    [
        (("sensor/laptop/val",), ["sensor/laptop/val"]),
        (("laptop/val",), ["clean/laptop/val", "sensor/laptop/val", "complete/laptop/val"]),
        (("clean/oven",), [f"clean/oven/{split}" for split in SIZES]),
        (("drawer/test", "clean/oven/val"), ["clean/oven/val", "sensor/drawer/test"]),
    ],
)
def test_only(only, names):
    assert [piece.name for piece in pieces(only)] == names


@pytest.mark.parametrize("word", ["chair", "clean/drawer", "sensor/laptop/all", "real", ""])
def test_only_refuses_what_names_nothing(word):
    with pytest.raises(
        ValueError, match=r"only: expected parts \(clean, sensor, complete\), .* found"
    ):
        pieces((word,))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("benchmark")
    done = list(make_benchmark(out, tiny("laptop/train", "sensor/scissors/val"), HERE))
    assert [d.piece.name for d in done] == [
        "clean/laptop/train",
        "sensor/laptop/train",
        "sensor/scissors/val",
        "complete/laptop/train",
    ]
    return out


def test_the_record_says_what_is_there(made):
    record = read_record(made / RECORD)
    assert (record["benchmark"], record["seed"]) == ("sim-art/2", 2)
    entry = record["splits"]["sensor/laptop/train"]
    split = open_split(made / "sensor", "laptop", "train")
    assert entry["digest"] == split.manifest.digest
    assert entry["plan_digest"] == split.manifest.plan_digest
    shards = [split.folder / shard.file for shard in split.manifest.shards]
    assert entry["bytes"] == sum(path.stat().st_size for path in shards)
    assert (entry["samples"], entry["objects"]) == (8, 2)
    assert entry["seconds"] > 0
    assert record["total"]["samples"] == 8 + 8 + 8 + 3
    listed = read_record(made / IDS, IDS_FORMAT)
    assert listed["splits"]["sensor/scissors/val"] == ["scissors-val-2-00000"]
    assert set(listed["splits"]) == set(record["splits"])


def test_complete_clouds_are_whole_and_pair_with_the_clean_ones(made):
    """Same objects, states and places; the rotation is another, and all of the surface is there."""
    clean, whole = (open_split(made / part, "laptop", "train") for part in ("clean", "complete"))
    assert clean.manifest.plan_digest == whole.manifest.plan_digest
    assert [i.id for i in clean.manifest.instances] == [i.id for i in whole.manifest.instances]
    names = ("camera_T_part", "joint_state", "instance", "visible", "points", "part")
    a, b = clean.arrays(*names), whole.arrays(*names)
    np.testing.assert_array_equal(a["joint_state"], b["joint_state"])
    np.testing.assert_array_equal(a["instance"], b["instance"])
    base = [data["camera_T_part"][:, 0] for data in (a, b)]
    np.testing.assert_array_equal(base[0][:, :3, 3], base[1][:, :3, 3])
    assert np.abs(base[0][:, :3, :3] - base[1][:, :3, :3]).max((1, 2)).min() > 0.05
    assert (b["visible"] == 1).all()
    assert whole.manifest.options["protocol"] == "full"
    boxes = {}
    for name, data in (("seen", a), ("whole", b)):
        pose = data["camera_T_part"][np.arange(8)[:, None], data["part"]]
        local = data["points"] - pose[..., :3, 3]
        local = np.einsum("bnji,bnj->bni", pose[..., :3, :3], local)
        boxes[name] = np.ptp(local[:4].reshape(-1, 3), axis=0)  # of the first object, at rest
    assert (boxes["whole"] > boxes["seen"] - 0.01).all()


def test_the_sensor_part_has_the_camera_noise_and_foreign_points_of_the_contract(made):
    for name, split, low, high in (("laptop", "train", 0.5, 0.9), ("scissors", "val", 0.5, 0.9)):
        data = open_split(made / "sensor", name, split)
        arrays = data.arrays("points", "part", "camera_T_part", "camera")
        assert (arrays["camera"] == [600, 600, 320, 240, 640, 480]).all()
        distance = np.linalg.norm(arrays["camera_T_part"][:, 0, :3, 3], axis=-1)
        assert low <= distance.min() <= distance.max() <= high
        options = data.manifest.options
        assert options["noise"] == "disparity"
        assert options["mask"] == "imperfect"
        assert options["preset"] == "sim-art-sensor"
        labels = arrays["part"]
        assert set(np.unique(labels)) <= {0, 1, 255}
        assert (labels == 255).any()
        assert all(((labels == part).sum(1) >= 16).all() for part in (0, 1))
        steps = 351.3 / arrays["points"][..., 2].astype(float)
        assert (np.abs(steps - np.rint(steps)) < 1e-3).mean() > 0.9  # all but flying pixels
    clean = open_split(made / "clean", "laptop", "train")
    assert "preset" not in clean.manifest.options
    assert (clean.arrays("camera")["camera"][:, 4:] == 256).all()


def test_a_second_run_leaves_all_as_it_is_and_another_folder_gets_the_same(made, tmp_path):
    before = [(made / name).read_bytes() for name in (RECORD, IDS)]
    list(make_benchmark(made, tiny("sensor/scissors/val"), HERE))
    assert [(made / name).read_bytes() for name in (RECORD, IDS)] == before
    list(make_benchmark(tmp_path, tiny("sensor/scissors/val"), HERE))
    name = "sensor/scissors/val"
    again, first = (read_record(folder / RECORD)["splits"][name] for folder in (tmp_path, made))
    assert again["digest"] == first["digest"]
    for path in (made / name).iterdir():
        assert (tmp_path / name / path.name).read_bytes() == path.read_bytes()


def test_all_splits_are_made_by_the_same_workers(made, tmp_path, monkeypatch):
    started: list[Pool] = []
    start = Pool._start
    monkeypatch.setattr(Pool, "_start", lambda pool: started.append(pool) or start(pool))
    task = tiny("laptop/train", "sensor/scissors/val")
    done = list(make_benchmark(tmp_path, task, Running(workers=1)))
    assert (len(done), len(started)) == (4, 1)
    for item in done:
        for path in (made / item.piece.name).iterdir():
            assert (tmp_path / item.piece.name / path.name).read_bytes() == path.read_bytes()


def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "SIZES", TINY)
    flags = ("--out", tmp_path, "--backend", "raycast", "--workers", 0)
    assert run("benchmark", "sim-art/2", *flags, "--only", "sensor/scissors/test") == 0
    text = capsys.readouterr().out
    assert "1/1 sensor/scissors/test" in text
    assert "scissors/test: 2 samples of 1 objects" in text
    assert RECORD in text
    assert json.loads((tmp_path / RECORD).read_text())["total"]["samples"] == 2
    assert run("benchmark", "sim-art/2", *flags, "--only", "chair") == 2
    assert capsys.readouterr().err.startswith("scapo-data: only: expected parts")
    assert run("benchmark", "sim-art/3", *flags) == 2


def test_the_page_says_what_the_categories_are(repository):
    """docs/benchmark.md against the table of categories and of sizes."""
    text = (repository / "docs/benchmark.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    told = {row[0]: row[1:] for row in rows if len(row) == 6 and row[0] in CATEGORIES}
    assert set(told) == set(CATEGORIES)
    for name, category in CATEGORIES.items():
        travel = ", ".join(
            f"{np.degrees(joint.upper):g} deg" if joint.kind == "revolute" else f"{joint.upper:g} m"
            for joint in category.joints
        )
        window = category.window
        assert told[name] == [
            ", ".join(category.parts),
            travel,
            f"{window.azimuth[0]:g} to {window.azimuth[1]:g}",
            f"{window.elevation[0]:g} to {window.elevation[1]:g}",
            f"{category.diagonal:g}",
        ]
    for split, (objects, each) in SIZES.items():
        assert f"| `{split}` | {objects} x {each} |" in text
    total = sum(objects * each for objects, each in SIZES.values()) * len(pieces()) // len(SIZES)
    assert f"{total:,} clouds" in text


def test_the_old_benchmark_names_the_commit_that_makes_it(tmp_path, capsys):
    assert run("benchmark", "sim-art/1", "--out", tmp_path / "data") == 1
    error = capsys.readouterr().err
    assert error.startswith("scapo-data: benchmark: expected sim-art/2, found sim-art/1")
    assert f"git checkout {OLD_COMMIT}" in error
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "other"}'])
def test_a_foreign_record_is_refused(tmp_path, text):
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(ValueError, match=r"sim-art-2.json: expected"):
        read_record(tmp_path / RECORD)
    assert Piece(part="clean", category="oven", split="test").name == "clean/oven/test"
