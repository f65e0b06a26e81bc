# SPDX-License-Identifier: MIT
"""CSV of actuations: what was written is read again, and what is not ours is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest

from scapo.store import StoreError
from scapo.store.actuations import (
    Actuation,
    is_actuations,
    read_actuations,
    write_actuations,
)

ROW = Actuation(
    method="=mine", variant="a, b", seed=1, supervision="pose joint", data="clean@0123",
    category="oven", split="val", sample=0, instance=2, joint=0, success=True, towards="open",
    moved=31.25, needed=30.0, travel=60.5, unit="deg", off_path_mean=1.5, off_path_peak=2.0,
    reason="",
)  # fmt: skip
LOST = replace(
    ROW, sample=1, success=None, towards="", moved=None, needed=None, travel=None,
    off_path_mean=None, off_path_peak=None, reason="no such\nfile",
)  # fmt: skip


def test_rows_come_back(tmp_path):
    path = tmp_path / "a.csv"
    rows = [ROW, LOST, replace(ROW, sample=2, success=False)]
    write_actuations(path, rows)
    assert read_actuations(path) == rows
    assert is_actuations(path)
    assert "\n'=mine," in path.read_text()  # no spreadsheet takes it for a formula


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("method,", "methods,", "expected the columns"),
        (",31.25,", ",far,", "line 2: expected numbers"),
        (",1,open,", ",2,open,", "line 2: expected numbers"),
        (",open,", ",up,", "towards: expected one of open, closed"),
        ("pose joint", "pose hinge", "supervision: expected known labels, found 'hinge'"),
        (",31.25,", ",", "line 2: expected 19 cells, found 18"),
        (",31.25,", ",nan,", "moved: expected a finite number"),
    ],
)
def test_what_is_not_ours_is_refused(tmp_path, old, new, message):
    path = tmp_path / "a.csv"
    write_actuations(path, [ROW])
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(StoreError, match=message):
        read_actuations(path)


def test_a_file_without_rows_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    write_actuations(path, [])
    with pytest.raises(StoreError, match="expected a row for each sample, found none"):
        read_actuations(path)
    assert not is_actuations(_text(tmp_path / "b.csv"))
    with pytest.raises(StoreError, match="expected the columns"):
        read_actuations(tmp_path / "b.csv")


def _text(path):
    path.write_text("a,b\n1,2\n")
    return path
