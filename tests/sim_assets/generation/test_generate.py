# SPDX-License-Identifier: MIT
"""Splits on disk: the same bytes whoever makes them, and one failure costs one object."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from scapo.store import SAMPLES, Split, open_split, read, write
from scapo.store.manifest import read_manifest, shards_digest
from sim_assets import generate_samples
from sim_assets.__main__ import main
from sim_assets.generation.assets import ProceduralAsset
from sim_assets.generation.generate import Made, Running, generate, make_split
from sim_assets.generation.ledger import FINISHED, PLAN, GenerateError, Ledger
from sim_assets.generation.plan import Request
from sim_assets.generation.request import make_request, versions
from sim_assets.generation.shard import ShardDone
from sim_assets.objects import ArticulatedObject
from sim_assets.options import DataOptions
from tests.helpers.boxes import laptop

FULL = DataOptions(protocol="full", points=64, count=30, instances=5)
"""Needs no renderer."""
VERSIONS = {"scapo": "test"}
HERE = Running(workers=0)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trap:
    """An asset that fails in a given way when it is loaded in a worker, from the n-th time on."""

    name: str
    how: str
    counter: Path
    after: int = 1
    """Loads that go well first: one for the plan."""

    def load(self) -> ArticulatedObject:
        with self.counter.open("a") as file:
            file.write(f"{self.name}\n")
        loads = self.counter.read_text().split().count(self.name)
        if self.how and loads > self.after:
            if self.how == "die" or (self.how == "die once" and loads == self.after + 1):
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "die once":
                return laptop(self.name)
            if self.how == "hang":
                time.sleep(600)
            raise ValueError(f"{self.name}: expected to be good, found {self.how}")
        return laptop(self.name)


def traps(tmp_path: Path, hows: list[str], after: int = 1) -> list[Trap]:
    counter = tmp_path / "loads"
    return [
        Trap(name=f"object{i}", how=how, counter=counter, after=after) for i, how in enumerate(hows)
    ]


def plain(count: int, instances: int, **changes) -> Request:
    request, _ = make_request("laptop", replace(FULL, count=count, instances=instances, **changes))
    return request


def test_workers_do_not_change_the_bytes_and_streaming_gives_the_same(tmp_path):
    options = DataOptions(count=36, instances=4, points=256, image_size=128)
    request, assets = make_request("laptop", options)
    made: list[Made] = []
    for workers in (0, 2):
        folder = tmp_path / str(workers) / "laptop" / "train"
        found = versions(request.settings.backend)
        made.append(generate(request, assets, folder, found, Running(workers=workers)))
    assert content(made[0].folder) == content(made[1].folder)
    split = open_split(tmp_path / "0", "laptop", "train")
    split.verify()
    assert split.manifest.count == 36
    assert made[0].failed == {}
    data = split.arrays("points", "part", "camera_T_part", "joint_state", "visible", "instance")
    streamed = list(generate_samples("laptop", count=36, instances=4, points=256, image_size=128))
    assert len(streamed) == 36
    for i, sample in enumerate(streamed):
        assert sample.key.index == i
        assert sample.key.instance == split.manifest.instances[data["instance"][i]].id
        assert np.array_equal(sample.observation.points.numpy(), data["points"][i])
        part, pose = sample.labels.part, sample.labels.camera_T_part
        assert part is not None
        assert pose is not None
        assert np.array_equal(part.numpy(), data["part"][i])
        assert np.array_equal(pose.numpy(), data["camera_T_part"][i])
        assert np.array_equal(sample.visible.numpy(), data["visible"][i])
    check_plan_digest_of_the_other_backend(made[0], tmp_path)


def test_every_object_is_shown_where_rounding_up_would_leave_some_out(tmp_path):
    """Streamed too; a shard that was cut otherwise, as by older versions, is made anew."""
    options = replace(FULL, count=70, instances=25)  # by threes 24 would do
    request, assets = make_request("laptop", options)
    made = generate(request, assets, tmp_path / "split", VERSIONS, HERE)
    split = Split(made.folder)
    shown = split.arrays("instance")["instance"]
    assert shown.tolist() == [i // 2 % 25 for i in range(70)]
    names = [record.id for record in split.manifest.instances]
    streamed = [s.key.instance for s in generate_samples("laptop", **asdict(options))]
    assert streamed == [names[index] for index in shown]
    before, shard = content(made.folder), made.folder / split.manifest.shards[0].file
    arrays, header = read(shard, SAMPLES)
    header["options"]["samples_per_instance"] = 3
    changed = replace(split.manifest.shards[0], sha256=write(shard, arrays, header))
    shards = (changed, *split.manifest.shards[1:])
    other = replace(split.manifest, shards=shards, digest=shards_digest(shards))
    (made.folder / "manifest.json").write_text(other.to_json())
    (made.folder / shards[1].file).unlink()
    assert generate(request, assets, made.folder, VERSIONS, HERE).kept == 0
    assert content(made.folder) == before


def check_plan_digest_of_the_other_backend(made: Made, tmp_path: Path) -> None:
    """Ray casting another number of points plans the same objects, states and cameras."""
    options = DataOptions(count=36, instances=4, points=64, image_size=128, backend="raycast")
    request, assets = make_request("laptop", options)
    other = generate(request, assets, tmp_path / "cast", versions("raycast"), HERE)
    assert other.manifest.plan_digest == made.manifest.plan_digest
    assert other.manifest.digest != made.manifest.digest


def test_a_finished_split_is_left_alone_and_another_is_refused(tmp_path):
    request, assets = make_request("laptop", FULL)
    folder = tmp_path / "split"
    first = generate(request, assets, folder, VERSIONS, HERE)
    before = content(folder)
    times = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    again = generate(request, assets, folder, VERSIONS, HERE)
    assert content(folder) == before
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == times
    assert again.kept == len(again.manifest.shards)
    assert again.manifest == read_manifest(folder / "manifest.json")
    assert again.manifest.digest == first.manifest.digest
    for change, message in (
        ({"points": 128}, "points 64, found points 128"),
        ({"seed": 2}, "seed 1, found seed 2"),
        ({"count": 31}, "count 30, found count 31"),
    ):
        other, others = make_request("laptop", replace(FULL, **change))
        with pytest.raises(GenerateError, match=message):
            generate(other, others, folder, VERSIONS, HERE)
    assert content(folder) == before
    check_damage_is_repaired(request, assets, folder, before)


def check_damage_is_repaired(request, assets, folder: Path, before: dict[str, bytes]) -> None:
    shard = folder / "00000.safetensors"
    shard.write_bytes(shard.read_bytes()[:-1] + b"!")
    (folder / ".0123456789abcdef.tmp").write_bytes(b"cut off")
    generate(request, assets, folder, VERSIONS, HERE)
    assert content(folder) == before


def test_foreign_and_broken_folders_are_refused(tmp_path):
    request, assets = make_request("laptop", FULL)
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "00000.safetensors").write_bytes(b"")
    with pytest.raises(GenerateError, match=r"an empty folder, found 00000\.safetensors"):
        generate(request, assets, foreign, VERSIONS, HERE)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "manifest.json").write_text("{")
    with pytest.raises(GenerateError, match="delete the folder to make it anew"):
        generate(request, assets, broken, VERSIONS, HERE)
    (tmp_path / "file").write_text("")
    with pytest.raises(GenerateError, match="expected a folder to write to"):
        generate(request, assets, tmp_path / "file", VERSIONS, HERE)
    begun = tmp_path / "begun"
    begun.mkdir()
    (begun / PLAN).write_text("[]")
    with pytest.raises(GenerateError, match=r"\.plan\.json: expected format"):
        generate(request, assets, begun, VERSIONS, HERE)


@pytest.mark.slow
def test_objects_that_die_hang_or_fail_cost_themselves_only(tmp_path):
    """Of five objects one kills its worker, one hangs, one fails and one cannot be read at all."""
    assets = traps(tmp_path, ["", "die", "hang", "raise", "", "raise"])
    assets[5] = replace(assets[5], after=0)
    request = plain(30, 6)
    folder = tmp_path / "split"
    running = Running(workers=2, timeout=4)
    made = generate(request, assets, folder, VERSIONS, running)
    assert made.failed == {
        "object1": "its process was ended by SIGKILL",
        "object2": "no sign of life for 4 s",
        "object3": "object3: expected to be good, found raise",
        "object5": "object5: expected to be good, found raise",
    }
    facts = made.manifest.statistics
    assert (facts["objects_failed"], facts["objects_refused"], facts["samples_lost"]) == (3, 1, 18)
    split = Split(folder)
    split.verify()
    assert split.manifest.count == 12
    assert [record.id for record in split.manifest.instances] == [f"object{i}" for i in range(5)]
    assert np.unique(split.arrays("instance")["instance"]).tolist() == [0, 4]
    assert {path.name for path in folder.iterdir()} == {
        "card.md",
        "croissant.json",
        "manifest.json",
        *(shard.file for shard in split.manifest.shards),
    }
    with pytest.raises(GenerateError, match="expected the objects of its manifest"):
        generate(request, [laptop_asset(i) for i in range(6)], folder, VERSIONS, HERE)


def test_a_worker_that_is_killed_changes_nothing(tmp_path):
    """Killed while it describes one object and while it renders another: the same bytes."""
    whole = generate(plain(20, 4), traps(tmp_path, [""] * 4), tmp_path / "whole", VERSIONS, HERE)
    (tmp_path / "loads").unlink()
    assets = traps(tmp_path, ["", "die once", "die once", ""])
    assets[1] = replace(assets[1], after=0)
    made = generate(plain(20, 4), assets, tmp_path / "killed", VERSIONS, Running(workers=2))
    assert made.failed == {}
    assert content(made.folder) == content(whole.folder)
    loads = (tmp_path / "loads").read_text().split()
    assert [loads.count(asset.name) for asset in assets] == [
        3,
        4,
        3,
        2,
    ]  # a shard is done again whole


def test_what_was_refused_is_said_again_by_every_later_run(tmp_path):
    """Another object has taken its place, so the data set is whole; it is not silent."""
    assets = traps(tmp_path, ["", "die", "raise", "", ""], after=0)
    request = replace(plain(12, 2), instances=3)
    folder = tmp_path / "split"
    made = generate(request, assets, folder, VERSIONS, Running(workers=1))
    refused = {
        "object1": "its process was ended by SIGKILL",
        "object2": "object2: expected to be good, found raise",
    }
    assert made.failed == refused
    assert made.manifest.left_out == refused
    before = content(folder)
    good = [replace(asset, how="") for asset in assets]
    for _ in range(2):
        again = generate(request, good, folder, VERSIONS, HERE)
        assert again.failed == refused
        assert again.kept == len(again.manifest.shards)
        assert content(folder) == before


def laptop_asset(index: int) -> ProceduralAsset:
    return ProceduralAsset(category="laptop", split="train", seed=9, index=index)


def test_lost_samples_are_made_up_for_when_started_again(tmp_path):
    assets = traps(tmp_path, ["", "raise", ""])
    request = plain(12, 3)
    folder = tmp_path / "split"
    made = generate(request, assets, folder, VERSIONS, HERE)
    assert made.manifest.count == 8
    good = [replace(asset, how="") for asset in assets]
    again = generate(request, good, folder, VERSIONS, HERE)
    assert again.failed == {}
    assert again.manifest.count == 12
    fresh = generate(request, good, tmp_path / "fresh", VERSIONS, HERE)
    assert content(folder) == content(fresh.folder)


def test_strict_stops_at_the_first(tmp_path):
    for after in (0, 1):
        assets = traps(tmp_path / str(after), ["raise", ""], after=after)
        (tmp_path / str(after)).mkdir()
        folder = tmp_path / f"split{after}"
        with pytest.raises(GenerateError, match="object0: expected to be good, found raise"):
            generate(plain(10, 2), assets, folder, VERSIONS, Running(workers=0, strict=True))
        assert not (folder / "manifest.json").exists()


def test_no_object_at_all_is_an_error(tmp_path):
    assets = traps(tmp_path, ["raise", "raise"], after=0)
    with pytest.raises(GenerateError, match="expected objects that can be read, found none"):
        generate(plain(10, 2), assets, tmp_path / "split", VERSIONS, HERE)


def test_more_objects_are_tried_until_there_are_enough(tmp_path):
    assets = traps(tmp_path, ["raise", "", "raise", "", ""], after=0)
    request = replace(plain(10, 2), instances=2)
    made = generate(request, assets, tmp_path / "split", VERSIONS, HERE)
    assert [record.id for record in made.manifest.instances] == ["object1", "object3"]
    assert set(made.failed) == {"object0", "object2"}
    assert made.manifest.count == 10


def test_interrupted_by_any_shard_it_is_taken_up_there_and_gives_the_same_bytes(
    tmp_path, monkeypatch, capsys
):
    """Ctrl-C once each of the first two of three shards is recorded, then to the end."""
    flags = ["generate", "laptop", "--protocol", "full", "--points", "64", "--workers", "0",
             "--count", "192", "--instances", "3", "--out", str(tmp_path)]  # fmt: skip
    recorded: list[str] = []

    def record(ledger: Ledger, shard: ShardDone) -> None:
        before(ledger, shard)
        recorded.append(shard.file)
        if len(recorded) < 3:
            raise KeyboardInterrupt

    before = Ledger.record
    monkeypatch.setattr(Ledger, "record", record)
    for _ in range(2):
        with pytest.raises(SystemExit, match="130"):
            main(flags)
        assert capsys.readouterr().err.splitlines()[-1].endswith("takes it up where it was")
        assert (tmp_path / "laptop/train" / PLAN).exists()
        assert not (tmp_path / "laptop/train/manifest.json").exists()
    with pytest.raises(SystemExit, match="0"):
        main(flags)
    assert recorded == [f"{i:05d}.safetensors" for i in range(3)]
    options = DataOptions(protocol="full", points=64, count=192, instances=3)
    whole = make_split("laptop", options, tmp_path / "whole", HERE)
    assert content(tmp_path / "laptop/train") == content(whole.folder)


@pytest.mark.slow
def test_interrupted_then_killed_then_finished_gives_the_same_bytes(tmp_path, repository):
    """Ctrl-C after the first shard, kill -9 after the third, then to the end."""
    options = DataOptions(protocol="full", points=512, count=600, instances=30)
    request, assets = make_request("laptop", options)
    found = versions(request.settings.backend)
    whole = generate(request, assets, tmp_path / "whole", found, HERE)
    folder = tmp_path / "laptop/train"
    process, errors = stop(tmp_path, repository, 1, signal.SIGINT)
    assert process.returncode == 130
    assert errors.splitlines()[-1].endswith("takes it up where it was")
    assert "Traceback" not in errors
    assert json.loads((folder / PLAN).read_text())["identity"]["count"] == 600
    process, _ = stop(tmp_path, repository, 3, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not (folder / "manifest.json").exists()
    made = generate(request, assets, folder, found, HERE)
    assert 2 <= made.kept < 10
    assert content(folder) == content(whole.folder)
    assert {PLAN, FINISHED}.isdisjoint(content(folder))


def stop(
    out: Path, repository: Path, shards: int, how: signal.Signals
) -> tuple[subprocess.Popen[bytes], str]:
    """Run the command, and stop its whole process group when so many shards are there."""
    command = [
        sys.executable,
        "-m",
        "sim_assets",
        "generate",
        "laptop",
        "--protocol",
        "full",
        "--points",
        "512",
        "--count",
        "600",
        "--instances",
        "30",
        "--workers",
        "1",
    ]
    process = subprocess.Popen(
        [*command, "--out", str(out)],
        cwd=repository,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    folder = out / "laptop/train"
    while process.poll() is None and len(list(folder.glob("0*.safetensors"))) < shards:
        time.sleep(0.01)
    os.killpg(process.pid, how)
    return process, process.communicate(timeout=60)[1].decode()
