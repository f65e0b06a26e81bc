# SPDX-License-Identifier: MIT
"""The printed numbers, and what does not add up in them."""

from __future__ import annotations

from bench.tables.paper import check, mean_mismatches, printed_cells


def test_arithmetic_mismatches():
    found = {(m.table, m.metric, m.method, f"{m.recomputed:.2f}")
             for m in mean_mismatches(printed_cells())}  # fmt: skip
    assert len([item for item in found if item[0] == "1"]) == 11
    assert len([item for item in found if item[0] == "2"]) == 9
    assert {
        ("1", "seg_iou", "Ours", "84.58"),
        ("1", "joint_dir", "OP-Align", "4.19"),
        ("2", "part_15", "OP-Align(SJ)", "68.82"),
        ("2", "part_5", "3DGCN", "14.51"),
    } <= found
    lines = check()
    assert "Table 2 Ours laptop: joint_10 99.27 but joint_15 98.30" in lines
    assert any("joint_15: Ours minus OP-Align(SJ) +3.18 as printed, +0.92" in line
               for line in lines)  # fmt: skip


def test_the_printed_numbers_are_those_of_the_paper(shared_dir, repository):
    theirs = (shared_dir / "paper" / "paper_tables.csv").read_text()
    assert (repository / "bench" / "paper.csv").read_text() == theirs.replace("\r\n", "\n")
    assert (repository / "results" / "paper.csv").read_text() == theirs.replace("\r\n", "\n")
