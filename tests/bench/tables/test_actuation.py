# SPDX-License-Identifier: MIT
"""Table 7: shares and forces counted by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.__main__ import main
from bench.tables.actuation import load_actuations, table_7
from bench.tables.render import to_csv, to_latex, to_markdown
from bench.tables.write import make_tables
from scapo.store import StoreError
from scapo.store.actuations import Actuation, write_actuations

ROW = Actuation(
    method="icp", variant="", seed=1, supervision="", data="clean@0123", category="oven",
    split="test", sample=0, instance=0, joint=0, success=True, towards="open", moved=31.0,
    needed=30.0, travel=60.0, unit="deg", off_path_mean=2.0, off_path_peak=3.0, reason="",
)  # fmt: skip
ROWS = [
    ROW,
    replace(ROW, sample=1, success=False, off_path_mean=4.0),
    replace(ROW, sample=2, instance=1, off_path_mean=9.0),
    replace(ROW, sample=3, instance=1, success=None, off_path_mean=None, reason="lost"),
    replace(ROW, sample=4, instance=1, off_path_mean=3.0),
]


def test_shares_are_of_the_joints_that_were_tried(tmp_path):
    write_actuations(tmp_path / "deep" / "a.csv", ROWS)
    other = [replace(ROW, method="mine", category="drawer", data="sensor@9", supervision="pose")]
    write_actuations(tmp_path / "b.csv", [*other, replace(ROW, split="val", sample=9)])
    (tmp_path / "notes.csv").write_text("a,b\n")
    table = table_7(load_actuations(tmp_path, "test"))
    assert table.columns == ("Oven (clean)", "Drawer (sensor)")
    moved, force = table.blocks
    icp, mine = moved.rows
    assert (icp.method, mine.method) == ("ICP", "mine")
    assert (icp.marks, mine.marks) == ((False, False, False), (True, False, False))
    cell = icp.cells[0]
    assert (cell.value, cell.passed, cell.count, cell.undefined) == (75.0, 3, 4, 1)
    assert cell.low is not None
    assert cell.high is not None
    assert cell.low <= 75 <= cell.high
    assert icp.cells[1].value is None
    assert force.rows[0].cells[0].value == 3.5
    assert all("75.0" in text for text in (to_markdown(table), to_latex(table), to_csv(table)))


def test_a_joint_that_was_tried_twice_or_on_other_data_is_refused(tmp_path):
    write_actuations(tmp_path / "a.csv", ROWS)
    write_actuations(tmp_path / "b.csv", ROWS[1:2])
    with pytest.raises(StoreError, match="expected each joint once, found sample 1, joint 0"):
        load_actuations(tmp_path, "test")
    write_actuations(tmp_path / "b.csv", [replace(ROW, data="clean@9")])
    with pytest.raises(StoreError, match="expected rows on clean@0123, found clean@9"):
        load_actuations(tmp_path, "test")


def test_it_is_written_with_the_others_from_actuations_alone(tmp_path):
    write_actuations(tmp_path / "scores" / "a.csv", ROWS)
    made = make_tables(tmp_path / "scores")
    assert [table.number for table in made.with_ours()] == ["7"]
    assert tmp_path / "out" / "table7.md" in made.write(tmp_path / "out")
    assert "75.0" in (tmp_path / "out" / "table7.md").read_text()
    assert "No actuations were found." in to_markdown(table_7({}))


def test_only_ours_leaves_the_printed_rows_out(tmp_path):
    write_actuations(tmp_path / "a.csv", ROWS)
    made = make_tables(tmp_path, only_ours=True)
    rows = [row for table in made.tables for block in table.blocks for row in block.rows]
    assert rows
    assert {row.source for row in rows} == {"ours"}


def test_a_folder_without_scores_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["tables", "--scores", str(tmp_path), "--out", str(tmp_path / "out")])
    assert ended.value.code == 1
    assert "expected scores on test (NAME.csv.gz), found none; `scapo-bench evaluate` writes" in (
        capsys.readouterr().err.replace("\n", " ")
    )
    assert not (tmp_path / "out").exists()


def test_the_command_prints_what_has_rows_of_ours(tmp_path, capsys):
    write_actuations(tmp_path / "a.csv", ROWS)
    main(["tables", "--scores", str(tmp_path), "--out", str(tmp_path / "out"), "--only-ours"])
    text = capsys.readouterr().out
    assert "Table 7." in text
    assert "Table 1." not in text
    assert "75.0" in text
