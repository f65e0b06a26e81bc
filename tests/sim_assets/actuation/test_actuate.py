# SPDX-License-Identifier: MIT
"""`scapo-data actuate`: the truth opens what a turned axis does not; a failure costs one object."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scapo.parallel.pool import Outcome, Pool
from scapo.store import Split, StoreError, open_split
from scapo.store.actuations import read_actuations
from scapo.store.predictions import Header, write_predictions
from sim_assets.__main__ import main
from sim_assets.actuation import actuate as room
from sim_assets.actuation.actuate import NO_ANSWER, actuate, left_out, summary
from sim_assets.generation.generate import Running, make_split
from sim_assets.options import DataOptions

pytest.importorskip("sapien")

HERE = Running(workers=0)
COUNT = {"oven": 4, "eyeglasses": 2, "drawer": 2}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("data")
    for name, count in COUNT.items():
        options = DataOptions(protocol="full", points=64, count=count, instances=2, split="val")
        make_split(name, options, out, HERE)
    return out


def turned(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Axes turned about lines at right angles to them, so that their angle is known."""
    across = np.cross(axis, np.random.default_rng(5).normal(size=axis.shape))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.radians(degrees)
    return (np.cos(angle) * axis + np.sin(angle) * across).astype(np.float32)


def predicted(split: Split, path: Path, **changed: np.ndarray) -> Path:
    """The truth as a prediction, some tensors changed."""
    arrays = split.arrays("part", "joint_pivot", "joint_axis")
    header = Header(
        method="mine", variant="v", category=split.manifest.category, split="val", seed=3,
        data_digest=split.manifest.digest, supervision=("pose",),
    )  # fmt: skip
    write_predictions(path, header, {**arrays, **changed})
    return path


@pytest.mark.parametrize("name", COUNT)
def test_the_truth_moves_every_joint_and_an_axis_across_it_none(name, data, tmp_path):
    split = open_split(data, name, "val")
    axis = split.arrays("joint_axis")["joint_axis"]
    path = predicted(split, tmp_path / "p.safetensors", joint_axis=-2 * axis)  # a line's direction
    rows = actuate(path, data, tmp_path / "true.csv", running=HERE)
    assert len(rows) == COUNT[name] * axis.shape[1]
    assert all(row.success for row in rows)
    assert {row.towards for row in rows} <= {"open", "closed"}
    path = predicted(split, tmp_path / "p.safetensors", joint_axis=turned(axis, 90))
    rows = actuate(path, data, tmp_path / "turned.csv", running=HERE)
    assert not any(row.success for row in rows)
    assert f"0.0 % (0 of {len(rows)} joints)" in summary(rows)[0]


def test_what_is_written_is_what_was_found_and_the_same_again(data, tmp_path):
    split = open_split(data, "oven", "val")
    path = predicted(split, tmp_path / "p.safetensors")
    rows = actuate(path, data, tmp_path / "a.csv", running=HERE)
    found = read_actuations(tmp_path / "a.csv")
    assert [(r.sample, r.joint, r.instance) for r in found] == [
        (r.sample, r.joint, r.instance) for r in rows
    ]
    first = found[0]
    assert (first.method, first.variant, first.seed, first.supervision) == ("mine", "v", 3, "pose")
    degrees = np.degrees(split.arrays("joint_state")["joint_state"][0, 0])
    if first.towards == "closed":
        assert first.travel == pytest.approx(degrees, rel=1e-4)
    assert first.needed == pytest.approx(min(30.0, (first.travel or 0) / 2), rel=1e-4)
    actuate(path, data, tmp_path / "few.csv", limit=2, running=HERE)
    assert read_actuations(tmp_path / "few.csv") == found[:2]


def test_objects_that_are_pulled_in_another_order_change_nothing(data, tmp_path, monkeypatch):
    """As several workers may end: the last object first."""

    class Backwards(Pool[Any, Any]):
        def run(self, *args: Any, **options: Any) -> Iterator[Outcome[Any, Any]]:
            yield from reversed(list(super().run(*args, **options)))

    path = predicted(open_split(data, "oven", "val"), tmp_path / "p.safetensors")
    rows = actuate(path, data, tmp_path / "a.csv", running=HERE)
    assert len({row.instance for row in rows}) == 2
    monkeypatch.setattr(room, "open_pool", lambda *_, **__: Backwards(0))
    actuate(path, data, tmp_path / "b.csv", running=HERE)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.slow
def test_workers_change_nothing(data, tmp_path):
    path = predicted(open_split(data, "oven", "val"), tmp_path / "p.safetensors")
    for workers in (0, 2):
        actuate(path, data, tmp_path / f"{workers}.csv", running=Running(workers=workers))
    assert (tmp_path / "0.csv").read_bytes() == (tmp_path / "2.csv").read_bytes()


def test_joints_are_told_by_the_labels_of_their_parts(data, tmp_path):
    split = open_split(data, "eyeglasses", "val")
    arrays = split.arrays("part", "joint_pivot", "joint_axis")
    other = np.array([0, 2, 1], np.uint8)[arrays["part"]]
    changed = {name: arrays[name][:, ::-1].copy() for name in ("joint_pivot", "joint_axis")}
    path = predicted(split, tmp_path / "p.safetensors", part=other, **changed)
    assert all(row.success for row in actuate(path, data, tmp_path / "o.csv", running=HERE))


def test_no_answer_is_a_failure_and_a_lost_object_is_left_out(data, tmp_path, capsys):
    split = open_split(data, "oven", "val")
    arrays = split.arrays("joint_pivot", "joint_axis")
    arrays["joint_axis"][0] = np.nan
    path = predicted(split, tmp_path / "p.safetensors", **arrays)
    rows = actuate(path, data, tmp_path / "o.csv", limit=1, running=HERE)
    assert [(row.success, row.reason, row.moved) for row in rows] == [(False, NO_ANSWER, None)]
    manifest = split.folder / "manifest.json"
    text = manifest.read_text()
    try:
        manifest.write_text(text.replace(split.manifest.instances[1].sha256, "0" * 64))
        with pytest.raises(SystemExit) as ended:
            main(["actuate", str(path), "--data", str(data), "--out", str(tmp_path / "l.csv"),
                  "--workers", "0"])  # fmt: skip
    finally:
        manifest.write_text(text)
    assert ended.value.code == 1
    printed = capsys.readouterr().out
    assert "left out object 1: " in printed
    rows = read_actuations(tmp_path / "l.csv")
    assert len(rows) == COUNT["oven"]
    assert list(left_out(rows)) == ["object 1"]


def test_one_missing_joint_fails_alone(data, tmp_path):
    split = open_split(data, "eyeglasses", "val")
    axis = split.arrays("joint_axis")["joint_axis"]
    axis[0, 1, 2] = np.nan
    path = predicted(split, tmp_path / "p.safetensors", joint_axis=axis)
    rows = actuate(path, data, tmp_path / "o.csv", limit=1, running=HERE)
    assert [(row.success, row.reason) for row in rows] == [(True, ""), (False, NO_ANSWER)]


def test_what_cannot_be_pulled_at_is_said_in_a_line(data, tmp_path):
    split = open_split(data, "oven", "val")
    path = predicted(split, tmp_path / "p.safetensors")
    with pytest.raises(ValueError, match=r"out: expected a file FILE\.csv, found"):
        actuate(path, data, tmp_path / "o.txt", running=HERE)
    with pytest.raises(ValueError, match="limit: expected 1 or more, found 0"):
        actuate(path, data, tmp_path / "o.csv", limit=0, running=HERE)
    arrays = {"part": split.arrays("part")["part"]}
    header = Header(method="m", variant="", category="oven", split="val", seed=1,
                    data_digest=split.manifest.digest, supervision=())  # fmt: skip
    write_predictions(path, header, arrays)
    with pytest.raises(StoreError, match="expected tensor 'joint_axis', found none"):
        actuate(path, data, tmp_path / "o.csv", running=HERE)
