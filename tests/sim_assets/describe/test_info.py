# SPDX-License-Identifier: MIT
"""Histograms and joint states in words."""

from __future__ import annotations

import hashlib
import re

import numpy as np
import pytest

from scapo.store import Split
from sim_assets.__main__ import main
from sim_assets.describe.info import describe_split, describe_state, histogram, histograms
from tests.helpers import made

VIEWS = ("azimuth", "elevation", "distance")
NUMBER = re.compile(r"-?[\d.]+")


def test_a_histogram_in_one_line():
    values = np.concatenate([np.zeros(8), np.ones(4)])
    line = histogram("name", values, "m")
    assert line.startswith("name ")
    assert "0 █" in line
    assert "▄ 1 m, mean 0.3333" in line
    assert "5 deg, mean 5" in histogram("constant", np.full(3, 5.0), "deg")


def test_states_in_words():
    assert describe_state(np.pi / 2, "revolute") == "90°"
    assert describe_state(0.123, "prismatic") == "12 cm"
    assert describe_state(float("nan"), "revolute") == "–"


def test_views_are_told_of_clouds_that_are_not_in_the_cameras_frame(tmp_path):
    """The same views, moved with their cameras."""
    arrays = made.sample_arrays("laptop", 6, 16)
    motion = np.eye(4, dtype=np.float32)
    motion[:3, :3] = made.rotations(np.random.default_rng(1), 1)[0]
    motion[:3, 3] = 3, -1, 7
    there = dict(arrays)
    there["camera_T_part"] = motion @ arrays["camera_T_part"]
    there["sensor"] = np.tile(motion[:3, 3], (6, 1))
    told = [
        histograms(made.write_split(tmp_path / name, "laptop", "test", one))
        for name, one in (("here", arrays), ("there", there))
    ]
    here, there = (
        [float(x) for line in lines if line.startswith(VIEWS) for x in NUMBER.findall(line)]
        for lines in told
    )
    assert len(here) == 3 * len(VIEWS)
    assert there == pytest.approx(here, abs=0.1)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("points", lambda a: a.astype(np.float16), "'points': expected dtype float32"),
        ("points", lambda a: a * np.nan, "'points', sample 0[0][0]: expected a finite number"),
        ("joint_axis", lambda a: 2 * a, "'joint_axis', sample 0[0]: expected a unit vector"),
        ("joint_pivot", lambda a: a[:, :, :2], "'joint_pivot': expected shape (4, 1, 3)"),
        ("camera", None, "expected tensor 'camera', found none"),
    ],
)
def test_tensors_that_no_sample_has_are_damage(name, change, message, tmp_path, capsys):
    """The manifest and its hashes agree with the shard: whoever wrote it meant it."""
    arrays = made.sample_arrays("laptop", 4, 16)
    before = arrays.pop(name)
    if change is not None:
        arrays[name] = change(before)
    made.write_split(tmp_path, "laptop", "test", arrays)
    with pytest.raises(SystemExit) as ended:
        main(["info", str(tmp_path)])
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert message in said.err
    assert said.err.count("\n") == 1
    assert "DAMAGED" in said.out
    assert "all whole" not in said.out


def test_a_digest_of_other_shards_is_told(tmp_path):
    """Another writer may have digests of his own; one of ours that is stale names other data."""
    split = made.make_data(tmp_path, count=4, points=16)
    shas = "\n".join(shard.sha256 for shard in split.manifest.shards)
    digest = hashlib.sha256(shas.encode()).hexdigest()
    path = split.folder / "manifest.json"
    text = path.read_text()
    path.write_text(text.replace(split.manifest.digest, digest))
    assert f"digest     {digest}\n" in describe_split(Split(split.folder)).text
    path.write_text(text.replace(split.manifest.digest, "0" * 64))
    told = describe_split(Split(split.folder))
    assert f"digest     {'0' * 64}, which is not over these shards" in told.text
    assert told.damage == ""


def test_a_damaged_split_costs_itself_alone(tmp_path, capsys):
    made.make_data(tmp_path, count=4, train=3, points=16)
    manifest = tmp_path / "laptop/test/manifest.json"
    manifest.unlink()
    manifest.symlink_to("nowhere")
    with pytest.raises(SystemExit) as ended:
        main(["info", str(tmp_path)])
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert "found a link" in said.err
    assert "(1 of 2 splits are damaged)" in said.err
    lines = said.out.splitlines()
    damaged = [line for line in lines if line.startswith("DAMAGED")]
    assert len(damaged) == 1
    assert "laptop/test/manifest.json: expected a file of its own, found a link" in damaged[0]
    assert any("split train" in line for line in lines)
    assert any("all whole" in line for line in lines)
