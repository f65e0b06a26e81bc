# SPDX-License-Identifier: MIT
"""Names in tables are text: no HTML in Markdown, no formula in CSV, no command in LaTeX."""

from __future__ import annotations

import csv
import re

import pytest

from bench.tables.write import make_tables
from tests.helpers.scored import make_scores

NAMES = ["=HYPERLINK(1)", "+1", "-1+2", "@x", "<img src=x onerror=alert(1)>", "a|b", "[c](d)", "*a",
         "$\\frac{$", "\\input{x}", "R&D"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_text_in_every_form(name, tmp_path):
    make_scores(tmp_path / "in", name.replace("/", "_"), "laptop", variant="v")
    make_scores(tmp_path / "in", "scapo", "laptop")
    paths = make_tables(tmp_path / "in").write(tmp_path / "out")
    texts = {path.name: path.read_text() for path in paths}
    for file, text in texts.items():
        if file.endswith(".csv"):
            for row in csv.reader(text.splitlines()):
                for cell in row:
                    assert re.fullmatch(r"-?[\d.]+(e-?\d+)?", cell) or cell[:1] not in set("=+-@")
    page = texts["table1.md"]
    assert "<img" not in page
    assert "](" not in page
    widths = {len(re.findall(r"(?<!\\)\|", line)) for line in page.splitlines() if line[:1] == "|"}
    assert len(widths) == 1
    assert "\\input{" not in texts["table1.tex"]
    assert "\\frac{" not in texts["table1.tex"]
    assert not re.search(r"\\\\\s*[\[*]", texts["table1.tex"])  # an argument of the end of a row
