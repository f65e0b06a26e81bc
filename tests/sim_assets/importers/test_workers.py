# SPDX-License-Identifier: MIT
"""Sets read in a worker: one that dies, hangs or is no file costs itself alone."""

from __future__ import annotations

import os
import pickle  # noqa: TID251 - writes what the reader under test has to face
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scapo.parallel.pool import Pool
from sim_assets.importers.clouds import CloudFile
from sim_assets.importers.sets import Reading, import_set
from sim_assets.importers.splits import SplitWriter, import_split
from tests.helpers import boxes, foreign
from tests.helpers.struck_set import Struck


def made(folder: Path, source: Path, workers: int) -> tuple[dict[str, bytes], dict[str, str]]:
    """The split's bytes, and what could not be used."""
    writer = SplitWriter(
        folder=folder, category="laptop", split="train", points=8, set_name="struck", variant=""
    )
    refused: dict[str, str] = {}

    def on_file(file: CloudFile, reason: str) -> None:
        if reason:
            refused[file.name] = reason

    with Pool[Any, Any](workers, timeout=3) as pool:
        import_split(Struck, writer, Struck.find(source), pool, on_file)  # type: ignore[arg-type]
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}, refused


@pytest.mark.slow
def test_a_worker_that_is_killed_or_stopped_changes_nothing(tmp_path: Path):
    for number in range(5):
        (tmp_path / f"{number}.txt").write_text(f"file {number}")
    whole, refused = made(tmp_path / "whole", tmp_path, 0)
    assert refused == {}
    (tmp_path / "1.left").write_text("SIGKILL")
    (tmp_path / "3.left").write_text("SIGSTOP")
    (tmp_path / "5.txt").write_text("file 5")
    (tmp_path / "5.left").write_text("SIGKILL " * 9)
    struck, refused = made(tmp_path / "struck", tmp_path, 1)
    assert refused == {"5.txt": "its process was ended by SIGKILL"}
    shards = [name for name in whole if name.endswith(".safetensors")]
    assert shards
    assert all(struck[name] == whole[name] for name in shards)  # in the same order, too


@pytest.mark.timeout(120)
def test_files_that_are_none_cost_themselves_alone(tmp_path: Path):
    folder = tmp_path / "pc/full/laptop_h/train"
    foreign.light_set(tmp_path / "pc/full", {"laptop_h/train": 1})
    os.mkfifo(folder / "1.pt")
    (folder / "2.pt").symlink_to("/dev/zero")
    (folder / "3.pt").symlink_to("3.pt")
    (folder / "4.pt").touch()
    os.truncate(folder / "4.pt", 1 << 40)
    value: Any = 1
    for _ in range(60):
        value = (value, value)
    (folder / "5.pt").write_bytes(b"PK" + pickle.dumps(value))
    reading = Reading(workers=1)
    made = import_set(
        "op-align-light", tmp_path / "pc", tmp_path / "out", points=8, reading=reading
    )
    assert made.samples == 1
    reasons = {Path(name).stem: reason for name, reason in made.refused.items()}
    assert set(reasons) == set("12345")
    assert "a pipe, a socket or a device" in reasons["1"]
    assert "a pipe, a socket or a device" in reasons["2"]
    assert "at most 1024 MiB" in reasons["4"]


def test_models_with_odd_records_cost_themselves_alone(tmp_path: Path):
    for number in range(5):
        foreign.shape2motion(boxes.laptop(), tmp_path / "set", "Laptop", f"{number:04d}")
    top = tmp_path / "set/MDV02/Laptop"
    motion = top / "0001/motion_attributes.json"
    text = motion.read_text()
    motion.write_text(text.replace("0.0", "9" * 401, 1))
    label = top / "0002/sfs_idx_to_dof_name_idx.npy"
    labels = np.load(label, allow_pickle=True)[()]
    np.save(label, {**labels, next(iter(labels)): 10**400}, allow_pickle=True)  # type: ignore
    mesh = top / "0003/summary.obj"
    mesh.write_text(mesh.read_text() + "f 1 2 " + "9" * 400 + "\n")
    (top / "0004/summary.obj").unlink()
    os.mkfifo(top / "0004/summary.obj")
    os.rename(top / "0000", top / ("n" * 250))  # noqa: PTH104
    made = import_set(
        "shape2motion", tmp_path / "set", tmp_path / "out", reading=Reading(workers=1)
    )
    assert len(made.written) == 1
    assert len(made.written[0].parent.name) < 100
    assert {Path(name).name for name in made.refused} == {"0001", "0002", "0003", "0004"}
    for name, file in (("0001", motion), ("0002", label), ("0003", mesh)):
        (reason,) = (why for what, why in made.refused.items() if what.endswith(name))
        assert file.name in reason
        assert "expected" in reason
