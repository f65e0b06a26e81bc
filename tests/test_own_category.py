# SPDX-License-Identifier: MIT
"""docs/categories.md is true: its file and commands, on a folder of small models."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import bench.__main__
import scapo
import sim_assets.__main__
from scapo.categories import CATEGORIES
from scapo.export.urdf import Joint, Link, Surface, write_urdf
from scapo.store import open_split, read_header
from scapo.store.definitions import read_categories
from scapo.store.manifest import read_manifest
from tests.helpers.boxes import box
from tests.helpers.pages import code_blocks
from tests.helpers.small import FLAGS

PROGRAMS = {"scapo-data": sim_assets.__main__.main, "scapo-bench": bench.__main__.main}
SMALL = {
    "generate": ["--backend", "raycast", "--points", "128", "--count", "10", "--workers", "0"],
    "check": ["--workers", "0"],
    "train": [*FLAGS["registered"], "--no-pictures"],
    "actuate": ["--workers", "0", "--limit", "1"],
    "preview": ["--count", "2"],
    "evaluate": ["--no-companions"],
}
"""More words, which make the commands of the page quick."""


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    return (repository / "docs" / "categories.md").read_text()


def write_fridge(folder: Path, number: int) -> None:
    """A body with a door before it, hinged at the side; the front faces -x."""
    width, height = 0.6 + 0.1 * number, 1.5 - 0.2 * number
    pieces = (
        ("body", box((0.6, width, height), (0, 0, 0))),
        ("door", box((0.04, width, height), (-0.32, 0, 0))),
    )
    links = [
        Link(name=name, surfaces=(Surface(vertices=v.mesh.vertices, faces=v.mesh.faces),))
        for name, v in pieces
    ]
    hinge = Joint(
        name="hinge", kind="revolute", parent="body", child="door", upper=1.8,
        pivot=np.array([-0.3, width / 2, 0.0]), axis=np.array([0.0, 0.0, -1.0]),
    )  # fmt: skip
    write_urdf(folder, links, [hinge], f"fridge-{number}")


def run(program: str, *words: str) -> int:
    try:
        PROGRAMS[program](list(words))
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.fixture(scope="module")
def place(page, tmp_path_factory) -> Path:
    """A folder in which all commands of the page were run, `mine.toml` gone after `generate`."""
    place = tmp_path_factory.mktemp("own")
    for number in range(2):
        write_fridge(place / "MODELS" / f"f{number}", number)
    (place / "mine.toml").write_text(code_blocks(page, "toml")[0])
    names = {"MODELS", "DATA", "RUN", "SCORES", "TABLES", "OUT"}
    for line in code_blocks(page, "sh")[0].splitlines():
        if not line:
            continue
        program, verb, *rest = shlex.split(line)
        words = [
            str(place / word) if word.split("/")[0] in names or "." in word else word
            for word in rest
        ]
        if "--categories" not in words:
            (place / "mine.toml").unlink(missing_ok=True)
        if verb == "generate":
            at = words.index("--count")
            del words[at : at + 2]
        assert run(program, verb, *words, *SMALL.get(verb, [])) == 0, line
    return place


def test_the_file_of_the_page_is_one(page, tmp_path):
    (tmp_path / "mine.toml").write_text(code_blocks(page, "toml")[0])
    found = read_categories(tmp_path / "mine.toml")
    assert list(found) == ["fridge", "chest"]
    assert not set(found) & set(CATEGORIES)


def test_every_command_of_the_page_ends_well_without_the_file(place):
    assert not (place / "mine.toml").exists()
    assert "Fridge (clean)" in (place / "TABLES" / "table4.md").read_text()
    assert "Fridge (clean)" in (place / "TABLES" / "table7.md").read_text()
    assert (place / "fridges.png").stat().st_size > 1000
    twin = place / "OUT" / "0000"
    assert json.loads((twin / "joints.json").read_text())["joints"][0]["child"] == "door"
    robot = ElementTree.parse(twin / "object" / "mobility.urdf").getroot()
    assert [link.get("name") for link in robot.iter("link")] == ["body", "door"]


def test_data_runs_and_predictions_carry_the_definition(place):
    manifest = read_manifest(place / "DATA" / "fridge" / "train" / "manifest.json")
    expected = manifest.options["definition"]
    assert (expected["parts"], expected["words"]) == (["body", "door"], ["door"])
    for path in (place / "RUN" / "checkpoint.safetensors", place / "test.safetensors"):
        assert read_header(path)["definition"] == expected
    assert "--categories FILE" in (place / "DATA" / "fridge" / "train" / "card.md").read_text()


def test_the_trained_method_answers_without_the_file(place):
    points = open_split(place / "DATA", "fridge", "test").arrays("points")["points"]
    answer = scapo.load(place / "RUN").predict(points[:2])
    assert answer.part_weight.shape == (2, 128, 2)


def test_another_definition_is_other_data(place, page, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(code_blocks(page, "toml")[0].replace("1.9", "2.5", 1))
    words = ["generate", "fridge", "--categories", str(tmp_path / "mine.toml"), "--source",
             str(place / "MODELS"), "--out", str(place / "DATA")]  # fmt: skip
    assert run("scapo-data", *words, *SMALL["generate"]) == 1
    assert "diagonal 1.9, found diagonal 2.5" in capsys.readouterr().err


def test_who_asks_for_it_wrongly_is_told_what_to_do(place, page, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(code_blocks(page, "toml")[0])
    out = ["--out", str(tmp_path / "out")]
    assert run("scapo-data", "generate", "fridge", *out) == 2
    assert "or one of your own with --categories FILE" in capsys.readouterr().err
    assert run("scapo-data", "generate", "lapto", *out) == 2
    assert "did you mean 'laptop'?" in capsys.readouterr().err
    mine = ["--categories", str(tmp_path / "mine.toml")]
    assert run("scapo-data", "generate", "fridge", *mine, *out) == 1
    assert "(generate --source FOLDER)" in capsys.readouterr().err
    data = ["--data", str(place / "DATA")]
    assert run("scapo-bench", "train", "scapo", "--category", "frige", *data, *out) == 2
    assert "category 'frige': expected one of laptop" in capsys.readouterr().err


@pytest.mark.slow
def test_real_fridges_are_read(page, shared_dir, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(code_blocks(page, "toml")[0])
    words = ["check", str(shared_dir / "assets" / "fridge"), "--category", "fridge"]
    code = run("scapo-data", *words, "--categories", str(tmp_path / "mine.toml"), "--workers", "0")
    assert code == 0
    assert ", 0 refused" in capsys.readouterr().out
