# SPDX-License-Identifier: MIT
"""Names from outside: one line, nothing that a terminal, a spreadsheet or a page would obey."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from scapo.text import as_cell, as_markdown, from_cell, one_line


@given(st.text(st.characters(codec=None), max_size=300))
def test_a_line_can_be_printed_whatever_it_says(text: str) -> None:
    line = one_line(text)
    assert line.isprintable()
    line.encode()  # undecodable names of files included


@given(st.text(st.characters(codec=None), max_size=60), st.integers(20, 40))
def test_long_text_keeps_its_ends(text: str, longest: int) -> None:
    line = one_line("begin" + "x" * 50 + text + "x" * 50 + "end", longest)
    assert line.startswith("begin")
    assert line.endswith("end")
    assert "…" in line
    assert len(line) == longest
    assert len(one_line(text * 50, longest)) <= longest


def test_ordinary_messages_stay_as_they_are() -> None:
    for line in ("data/a  b.csv: expected 1, found 2", "Å–×", "[/x] :x: $a$"):
        assert one_line(line) == line
    assert one_line("first\n   second\r\n") == "first second"
    assert one_line("\x1b]0;title\x07 \x9b2J \u202e") == r"\x1b]0;title\x07 \x9b2J \u202e"
    assert len(one_line("y" * 10**6)) <= 2000


@given(st.text(max_size=20) | st.sampled_from("=+-@\t\r'").map(lambda c: c + "1"))
def test_cells_are_no_formulas_and_are_read_back(text: str) -> None:
    cell = as_cell(text)
    assert cell[:1] not in set("=+-@\t\r")
    assert from_cell(cell) == text


@given(st.text(max_size=40))
def test_markdown_has_no_tags_and_no_columns(text: str) -> None:
    shown = as_markdown(text)
    assert not set("<>\n") & set(shown)
    assert "](" not in shown
    odd = re.compile(r"(?<!\\)\\(?:\\\\)*\|")  # an even number of backslashes escapes no column
    assert shown.count("|") == len(odd.findall(shown))
