# SPDX-License-Identifier: MIT
"""The pages of docs/ link to what exists, and each stands in the site's navigation."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.helpers.pages import code_blocks

tomllib = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
LINK = re.compile(r"\]\(([^)\s#:]+)(?:#[^)]*)?\)")


def leaves(node: Any) -> Iterator[str]:
    """The pages of a navigation."""
    if isinstance(node, str):
        yield node
        return
    for child in node.values() if isinstance(node, dict) else node:
        yield from leaves(child)


@pytest.fixture(scope="module")
def pages(repository: Path) -> list[Path]:
    found = sorted((repository / "docs").glob("*.md"))
    assert len(found) > 10
    return found


def test_links_lead_somewhere(pages: list[Path], repository: Path):
    links = [
        (page.name, target)
        for page in [*pages, repository / "results" / "README.md"]
        for target in LINK.findall(page.read_text())
        if not (page.parent / target).exists()
    ]
    assert links == []


def test_links_are_found():
    assert LINK.findall("[a](b.md) [c](d.md#e) [f](https://g) ![h](i.png)") == [
        "b.md",
        "d.md",
        "i.png",
    ]


def test_every_page_is_in_the_navigation_once(pages: list[Path], repository: Path):
    site = yaml.safe_load((repository / "mkdocs.yml").read_text())
    assert sorted(leaves(site["nav"])) == [page.name for page in pages]


def test_the_drawing_has_every_room(repository: Path):
    """Those of the import contracts, which name every file and folder of the packages."""
    drawing = code_blocks((repository / "docs" / "architecture.md").read_text())[0]
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    layers = [
        layer
        for contract in project["tool"]["importlinter"]["contracts"]
        if contract.get("containers") in (["bench"], ["scapo"], ["sim_assets"])
        for layer in contract["layers"]
    ]
    rooms = {room for layer in layers for room in re.findall(r"\w+", layer)}
    assert len(rooms) > 40
    assert rooms - set(re.findall(r"\w+", drawing)) == {"__main__"}
