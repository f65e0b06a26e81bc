# SPDX-License-Identifier: MIT
"""The README's commands, glossary and links are true of the programs and the tree."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

import bench.__main__
import sim_assets.__main__
from tests.helpers.pages import code_blocks

PROGRAMS: dict[str, Callable[..., None]] = {
    "scapo-data": sim_assets.__main__.main,
    "scapo-bench": bench.__main__.main,
}


@pytest.fixture(scope="module")
def readme(repository: Path) -> str:
    return (repository / "README.md").read_text()


def commands(text: str) -> list[list[str]]:
    """Command lines of the shell blocks, split into words."""
    lines = [line for block in code_blocks(text) for line in block.splitlines()]
    return [shlex.split(line, comments=True) for line in lines if line.startswith("scapo-")]


def test_every_command_of_the_readme_has_its_verb_and_flags(
    readme: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    found = commands(readme)
    assert len(found) >= 6
    helps: dict[tuple[str, ...], str] = {}
    for program, verb, *rest in found:
        words = (program, verb, *(["scapo"] if verb == "train" else []))
        if words not in helps:
            with pytest.raises(SystemExit) as ended:
                PROGRAMS[program]([*words[1:], "--help"])
            assert ended.value.code == 0
            helps[words] = capsys.readouterr().out
        for word in rest:
            if word.startswith("--"):
                assert re.search(rf"{word}\b", helps[words]), f"{program} {verb} has no {word}"


def test_links_and_pictures_exist(readme: str, repository: Path) -> None:
    targets = re.findall(r"\]\(([^)#:]+)\)", readme)
    assert targets
    missing = [target for target in targets if not (repository / target).exists()]
    assert missing == []


def test_make_targets_exist(readme: str, repository: Path) -> None:
    makefile = (repository / "Makefile").read_text()
    named = set(re.findall(r"(?:`|^)make ([a-z-]+)", readme, flags=re.MULTILINE))
    assert {"demo", "test", "setup", "help", "lint"} <= named
    assert {name for name in named if not re.search(rf"^{name}:", makefile, re.MULTILINE)} == set()


def test_layout_names_real_folders(readme: str, repository: Path) -> None:
    named = re.findall(r"^([a-z_]+)/ ", readme, flags=re.MULTILINE)
    assert {"scapo", "sim_assets", "bench", "tests", "results"} <= set(named)
    assert all((repository / name).is_dir() for name in named)
