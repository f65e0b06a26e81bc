# SPDX-License-Identifier: MIT
"""`scapo-data import` as a user meets it: exit codes, what is printed, what is left alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from scapo.store import open_split
from sim_assets.__main__ import main
from sim_assets.importers import op_align_light
from tests.helpers import boxes, foreign
from tests.helpers.foreign import light_set, write_pt


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_the_command_names_what_it_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    light_set(tmp_path / "set", {"full/laptop_h/train": 3})
    command = ("import", "op-align-light", tmp_path / "set", "--out", tmp_path / "out")
    assert run(*command, "--points", 32) == 0
    assert "3 clouds in 1 splits" in capsys.readouterr().out
    broken = tmp_path / "set/full/laptop_h/train/100.pt"
    broken.write_bytes(broken.read_bytes()[:-100])
    stray = write_pt({}, tmp_path / "set/notes.pt")
    assert run(*command, "--points", 32) == 1
    lines = capsys.readouterr().out.splitlines()
    assert (
        lines[0]
        == f"left out {stray}: expected a place like {op_align_light.LAYOUT}, found another"
    )
    assert lines[1].startswith(f"left out {broken}: expected a whole zip archive, found ")
    assert lines[2] == f"2 clouds in 1 splits in {tmp_path / 'out'}, 2 left out"
    manifest = open_split(tmp_path / "out").manifest
    assert (manifest.count, manifest.statistics) == (2, {"files_refused": 1.0})
    assert run(*command, "--strict") == 1
    printed = capsys.readouterr()
    assert str(stray) in printed.err
    assert printed.err.count("\n") == 1
    assert open_split(tmp_path / "out").manifest.count == 2  # untouched


def test_models_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    foreign.shape2motion(boxes.laptop(), tmp_path / "set", "laptop")
    command = ("import", "shape2motion", tmp_path / "set/MDV02/laptop", "--out", tmp_path / "out")
    assert run(*command) == 0
    assert capsys.readouterr().out == f"1 models in {tmp_path / 'out'}, 0 left out\n"
    assert (
        run(
            "generate",
            "laptop",
            "--source",
            tmp_path / "out/laptop",
            "--count",
            4,
            "--protocol",
            "full",
            "--workers",
            0,
            "--out",
            tmp_path / "data",
        )
        == 0
    )
    split = open_split(tmp_path / "data")
    assert split.manifest.instances[0].id == "0001"
    assert split.manifest.count == 4


def test_wrong_usage(tmp_path: Path):
    assert run("import", "modelnet", tmp_path, "--out", tmp_path) == 2
    assert run("import", "hoi4d", tmp_path) == 2
    assert run("import", "hoi4d", tmp_path / "none", "--out", tmp_path) == 1
