# SPDX-License-Identifier: MIT
"""The log and the timing of a run: read whole, or refused by file, line and field."""

from __future__ import annotations

import json

import pytest

from bench.figures.pictures import training_curve
from bench.run_files import read_metrics, read_timing
from scapo.store import StoreError
from tests.helpers.altered import altered

ROW = {"step": 1, "stage": "a", "lr": 0.1, "loss": 1.0, "loss/x": 2.0}
TIMING = {"seconds": 3.0, "samples_per_second": {"a": 2.0}, "stage_seconds": {"a": 1.0}}


def complaint(read, path):
    try:
        read(path)
    except StoreError as error:
        return str(error)
    return ""


def test_every_field_of_a_timing_is_checked(tmp_path):
    path = tmp_path / "timing.json"
    path.write_text(json.dumps(TIMING))
    assert read_timing(tmp_path).stage_seconds == {"a": 1.0}
    taken = set()
    for name, value in altered(TIMING):
        path.write_text(json.dumps(value))
        said = complaint(read_timing, tmp_path)
        assert not said or str(path) in said
        taken |= set() if said else {name}
    assert taken <= {f"{field}/a left out" for field in TIMING}
    for data in (b"", b"\xff", b"[" * 10**5, b'{"seconds": NaN}'):
        path.write_bytes(data)
        assert str(path) in complaint(read_timing, tmp_path)


def test_every_line_of_a_log_is_checked(tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = [json.dumps(value) for name, value in altered(ROW) if not name.startswith("lr")]
    lines += ["[]", "7", "", '{"a"', '{"step": 1, "stage": "a", "loss": 1e999}']
    taken = []
    for line in lines:
        path.write_text(f"{json.dumps(ROW)}\n{line}\n")
        said = complaint(read_metrics, path)
        assert not said or f"{path}: line 2" in said
        taken += [] if said else [json.loads(line)]
    for row in taken:  # what is taken can be drawn
        assert isinstance(row["step"], int)
        assert isinstance(row["stage"], str)
        path.write_text(f"{json.dumps(ROW)}\n{json.dumps(row)}\n")
        training_curve(path, tmp_path / "c.png")
    assert 0 < len(taken) < len(lines) / 2
    assert read_metrics(tmp_path / "none.jsonl") == []


@pytest.mark.parametrize("name", ["$\\frac{$", "\u4e2d\x1b[2J", "x" * 10**6])
def test_odd_names_are_drawn_as_they_are(name, tmp_path):
    rows = [ROW, {**ROW, "stage": name, f"loss/{name}": 1.0}]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    training_curve(path, tmp_path / "c.png")
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")
