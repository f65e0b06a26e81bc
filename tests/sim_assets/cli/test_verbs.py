# SPDX-License-Identifier: MIT
"""`scapo-data` as a user meets it: help, exit codes, one-line errors, what is printed and drawn."""

from __future__ import annotations

import io
import json
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import get_args

import pytest
from rich.console import Console

from scapo.categories import CATEGORIES
from scapo.store import open_split, write_bytes
from scapo.store.manifest import MAX_POINTS
from sim_assets.cli import verbs
from sim_assets.cli.verbs import MOST_POINTS, VERBS, Benchmark, Workers
from sim_assets.generation import benchmark
from sim_assets.generation.benchmark import pieces
from sim_assets.importers import op_align_light
from sim_assets.inspect.preview import draw_preview
from tests.helpers import boxes, foreign
from tests.helpers.foreign import light_set, write_pt
from tests.helpers.odd_names import NAME
from tests.helpers.programs import run


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A small data set of two splits, made by the command itself."""
    out = tmp_path_factory.mktemp("data")
    common = ("--protocol", "full", "--points", 128, "--workers", 0, "--out", out)
    assert run("generate", "laptop", "--count", 20, "--instances", 4, *common) == 0
    assert run("generate", "oven", "--count", 6, "--split", "test", *common) == 0
    return out


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_every_verb_says_what_each_flag_does(verb, capsys):
    assert run(verb, "--help") == 0
    text = capsys.readouterr().out
    assert f"scapo-data {verb}" in text
    assert "--help" in text


def test_generate_has_the_flags_of_the_contract(capsys):
    run("generate", "--help")
    text = capsys.readouterr().out
    text = " ".join(text.split())
    flags = """out source up front scale split count instances seed points protocol noise backend
        image-size sampling color states-per-view workers engine strict"""
    for flag in flags.split():
        assert re.search(rf"--{flag}[ ,]", text), flag
    assert set(get_args(verbs.CategoryName)) == set(CATEGORIES)


def test_the_version_is_that_of_the_package(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"scapo-data {metadata.version('scapo')}\n"


HEAVY = ("torch", "sapien", "mani_skill", "trimesh", "matplotlib", "scipy", "pandas", "viser")
"""What takes from a tenth of a second to seconds to import."""


def test_help_imports_nothing_heavy():
    """In a process of its own: of the program, and of every verb."""
    script = f"""
import sys, io, contextlib
from sim_assets.__main__ import main
for words in {[["--help"], ["--version"], *([verb, "--help"] for verb in VERBS)]!r}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main(words)
print([name for name in {HEAVY!r} if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == ("[]\n", "")


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("bogus",),
        ("generate",),
        ("generate", "laptop"),
        ("generate", "chair", "--out", "x"),
        ("generate", "laptop", "--out", "x", "--bogus", "1"),
        ("generate", "laptop", "--out", "x", "--count", "many"),
        ("generate", "laptop", "--out", "x", "--noise", "loud"),
        ("info",),
        ("preview", "x"),
        ("check", "x", "--bogus"),
    ],
)
def test_wrong_usage_ends_2(arguments, capsys):
    assert run(*arguments) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("generate", "laptop", "--count", 0), "count: expected 1 or more, found 0"),
        (("generate", "laptop", "--source", "/no/such"), "/no/such: expected a folder"),
        (("generate", "laptop", "--workers", -1), "workers: expected 0 or more, found -1"),
        (("info", "/no/such"), "/no/such: expected a data set (manifest.json), found none"),
        (("check", "/no/such"), "/no/such: expected a folder or a .urdf file, found nothing"),
        (("build", "laptop", "--count", 0), "count: expected 1 or more, found 0"),
        (("build", "laptop", "--seed", -1), "seed: expected 0 or more, found -1"),
        (("check", "x", "--scale", "nan"), "scale: expected a finite number above 0, found nan"),
        (("generate", "laptop", "--seed", 2**63), "seed: expected 0 to 9223372036854775807"),
        (("generate", "laptop", "--timeout", "nan"), "timeout: expected a finite number above 0"),
        (("generate", "laptop", "--timeout", 0), "timeout: expected a finite number above 0"),
        (("benchmark", "sim-art/2", "--workers", -1), "workers: expected 0 or more, found -1"),
        (("benchmark", "sim-art/2", "--timeout", -1), "timeout: expected a finite number above 0"),
        (("import", "hoi4d", "x", "--points", 2**25), "points: expected 1 to 16777216, found"),
    ],
)
def test_bad_input_ends_1_with_one_line(arguments, message, tmp_path, capsys):
    out = () if arguments[0] in ("info", "check") else ("--out", tmp_path / "out")
    assert run(*arguments, *out) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"scapo-data: {message}")


def test_generate_prints_a_summary_and_says_when_all_is_there(data, capsys):
    flags = ("--protocol", "full", "--points", 128, "--workers", 0, "--out", data)
    assert run("generate", "laptop", "--count", 20, "--instances", 4, *flags) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "laptop/train: 20 samples of 4 objects, there already, whole"
    assert lines[1] == "views redrawn: 0.00 %"
    manifest = json.loads((data / "laptop/train/manifest.json").read_text())
    assert lines[2] == f"digest {manifest['digest']}"
    assert lines[3].split()[1] == manifest["plan_digest"]
    assert run("generate", "laptop", "--count", 21, "--instances", 4, *flags) == 1
    assert "count 20, found count 21; choose another folder" in capsys.readouterr().err


def test_generate_names_the_models_it_left_out(tmp_path, capsys):
    assert run("build", "laptop", "--out", tmp_path / "models", "--count", 3) == 0
    bad = sorted((tmp_path / "models/laptop").glob("*/mobility.urdf"))[1]
    bad.write_text("<robot/>")
    flags = ("--protocol", "full", "--workers", 0, "--points", 64, "--count", 4)
    source = tmp_path / "models/laptop"
    code = run("generate", "laptop", "--source", source, "--out", tmp_path / "data", *flags)
    assert code == 1
    text = capsys.readouterr().out
    assert "laptop/train: 4 samples of 2 objects" in text
    assert f"left out {bad.parent.name}" in text
    assert "note: too few models to divide (3): every split shows all of them" in text
    code = run(
        "generate", "laptop", "--source", source, "--out", tmp_path / "b", "--strict", *flags
    )
    assert code == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_info_tells_counts_ranges_and_damage(data, tmp_path, capsys):
    assert run("info", data) == 0
    text = capsys.readouterr().out
    for piece in (
        "laptop (base, screen), split train",
        "20 of 128 points, 4 objects, seed 1",
        "oven (body, door), split test",
        "protocol full",
        "azimuth",
        "points on screen",
        "5 to 5 samples",
        "all whole",
    ):
        assert piece in text, piece
    copy = tmp_path / "split"
    copy.mkdir()
    for path in (data / "laptop/train").iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    shard = copy / "00000.safetensors"
    shard.write_bytes(shard.read_bytes()[:-4] + b"\0\0\0\0")
    assert run("info", copy) == 1
    assert "DAMAGED" in capsys.readouterr().out


def test_preview_draws_a_png(data, tmp_path, capsys):
    out = tmp_path / "sheet.png"
    assert run("preview", data, "--out", out, "--count", 6) == 0
    assert capsys.readouterr().out.startswith("12 samples drawn")
    content = out.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", content[16:24])
    assert width > 1500
    assert height > 600
    assert draw_preview(data, tmp_path / "again.png", 6) == 12
    assert (tmp_path / "again.png").read_bytes() == content
    assert draw_preview(data, out, 3, "oven", "test") == 3
    for arguments in (
        ("preview", data, "--out", tmp_path / "sheet.jpg"),
        ("preview", data, "--out", out, "--count", 0),
        ("preview", data, "--out", out, "--category", "safe"),
    ):
        assert run(*arguments) == 1
        assert capsys.readouterr().err.count("\n") == 1


def test_check_says_of_each_model_what_came_of_it(tmp_path, capsys):
    assert run("build", "oven", "--out", tmp_path, "--count", 1) == 0
    (tmp_path / "oven" / "broken").mkdir()
    (tmp_path / "oven" / "broken" / "mobility.urdf").write_text("<robot")
    capsys.readouterr()
    results = tmp_path / "results.json"
    assert run("check", tmp_path / "oven", "--json", results, "--workers", 1) == 1
    text = capsys.readouterr().out
    assert "1 accepted, 0 repaired, 1 refused" in text
    assert json.loads(results.read_text())["counts"]["refused"] == 1
    for front in (["--front", "-y"], ["--front=-y"]):  # a word with a dash is no flag there
        assert run("check", tmp_path / "oven", "--up", "z", *front, "--workers", 1) == 1
        assert "1 accepted" in capsys.readouterr().out


def test_hostile_names_in_info_and_preview(data, tmp_path, capsys):
    folder = tmp_path / "split"
    for path in (data / "laptop/train").iterdir():
        write_bytes(folder / path.name, path.read_bytes())
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["parts"] = [NAME, "$\\frac{$"]
    manifest["versions"] = {NAME: NAME}
    write_bytes(folder / "manifest.json", json.dumps(manifest).encode())
    usual = run("info", data / "laptop/train"), capsys.readouterr().out.count("\n")
    assert run("info", folder) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (0, len(lines)) == usual
    assert all(line.isprintable() and len(line) < 3000 for line in lines)
    assert run("preview", folder, "--out", tmp_path / "sheet.png", "--count", 2) == 0
    assert capsys.readouterr().out.startswith("2 samples drawn")


ONLY = ("sensor/scissors/val", "clean/laptop/val")
HERE = Workers(workers=0)


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_pieces_are_counted_and_the_record_named(
    console: Console, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "SIZES", dict.fromkeys(benchmark.SIZES, (1, 2)))
    verb = Benchmark(name="sim-art/2", out=tmp_path, only=ONLY, backend="raycast", how=HERE)
    assert verb.run(console) == 0
    text = printed(console)
    names = [piece.name for piece in pieces(ONLY)]
    assert len(names) == 2
    assert all(f"{number}/2 {name}" in text for number, name in enumerate(names, 1))
    assert f"recorded in {tmp_path / benchmark.RECORD}" in text
    assert (tmp_path / benchmark.RECORD).is_file()


def test_a_failed_object_ends_in_1_after_all_pieces(
    console: Console, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "SIZES", dict.fromkeys(benchmark.SIZES, (1, 1)))
    make = benchmark.make_benchmark

    def failing(*arguments: object) -> Iterator[object]:
        for done in make(*arguments):  # type: ignore[arg-type]
            yield replace(done, made=replace(done.made, failed={"scissors-val-2-00000": "died"}))

    monkeypatch.setattr(benchmark, "make_benchmark", failing)
    verb = Benchmark(name="sim-art/2", out=tmp_path, only=ONLY, backend="raycast", how=HERE)
    assert verb.run(console) == 1
    assert "2/2" in printed(console)
    assert "scissors-val-2-00000" in printed(console)


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


def test_wrong_usage_of_import(tmp_path: Path):
    assert run("import", "modelnet", tmp_path, "--out", tmp_path) == 2
    assert run("import", "hoi4d", tmp_path) == 2
    assert run("import", "hoi4d", tmp_path / "none", "--out", tmp_path) == 1


def test_a_bound_that_is_written_out_is_that_of_the_store():
    assert MOST_POINTS == MAX_POINTS
