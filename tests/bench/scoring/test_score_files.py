# SPDX-License-Identifier: MIT
"""Scores and their report: together or not at all, every field as it should be or refused."""

from __future__ import annotations

import errno
import gzip
import json
import os
import random

import numpy as np
import pytest

from bench import __main__ as program
from bench.scoring import score_files
from bench.scoring.score_files import Run, read_scores, side_file, writing
from bench.tables.results import load
from scapo.store import StoreError
from tests.helpers.altered import altered
from tests.helpers.scored import make_scores, report_of

RUN = Run(method="m", variant="", seed=1, data="clean@0", category="laptop", split="test")
ERRORS = {("iou", "1"): np.ones((3, 2))}
FREE = ("average_precision", "budget", "machine", "run", "settings", "versions")
"""Fields whose content is the writer's."""


def write(path, run=RUN):
    with writing(path) as file:
        file.add(run, 0, ERRORS)
        file.report = report_of(run, samples=3)


@pytest.fixture
def scores(tmp_path):
    make_scores(tmp_path, "scapo", "laptop", supervision=("pose",))
    return next(tmp_path.glob("*.csv.gz"))


def refusal(path, capsys):
    """The one line of `tables` on the folder of a file."""
    out = path.parent.parent / "out"
    with pytest.raises(SystemExit) as ended:
        program.main(["tables", "--scores", str(path.parent), "--out", str(out)])
    assert ended.value.code == 1
    line = capsys.readouterr().err
    assert line.endswith("\n")
    assert line[:-1].isprintable()
    assert "expected" in line
    return line


def complaint(read, path):
    """What is said of a file that is refused; none where it is taken."""
    try:
        read(path)
    except (StoreError, ArithmeticError) as error:
        return str(error)
    return ""


def test_every_field_of_a_report_is_checked(scores, capsys):
    report = side_file(scores)
    whole = json.loads(report.read_text())
    required = {name for name in whole if name not in FREE}
    refused = set()
    for name, value in altered(whole):
        report.write_text(json.dumps(value))
        said = complaint(read_scores, scores)
        assert not said or str(report) in said or name.startswith("digests/scores")
        refused |= {name} if said else set()
    assert {f"{name} left out" for name in whole} <= refused
    assert {f"{name} = '-1.5'" for name in required} <= refused
    assert {f"{name} = '10000000000000000000'" for name in required - {"seed"}} <= refused
    report.write_text(json.dumps({**whole, "seed": "\x1b[31m\n[/x]" * 10**5}))
    line = refusal(scores, capsys)
    assert str(report) in line
    assert len(line) < 3000


def test_damaged_bytes_are_one_line_that_names_the_file(scores, capsys):
    whole, generator = scores.read_bytes(), random.Random(0)
    damaged = [whole[: generator.randrange(len(whole))] for _ in range(8)]
    damaged += [generator.randbytes(200), gzip.compress(generator.randbytes(200)), b""]
    for _ in range(20):
        flipped = bytearray(whole)
        flipped[generator.randrange(len(whole))] ^= 1 << generator.randrange(8)
        damaged.append(bytes(flipped))
    for data in damaged:
        scores.write_bytes(data)
        line = refusal(scores, capsys)
        assert str(scores) in line


ODD = ("", "-1", "1e999", "nan", "x", "\x1b[2J", "9" * 30, "1_0", "\u0661", "a,b", "\0", "x" * 400)


@pytest.mark.parametrize("column", score_files.COLUMNS)
def test_odd_cells_are_refused_or_taken_as_they_are(column, scores):
    record = json.loads(side_file(scores).read_text())
    del record["digests"]["scores"]  # as reports were once
    side_file(scores).write_text(json.dumps(record))
    lines = gzip.decompress(scores.read_bytes()).decode().splitlines()
    place = score_files.COLUMNS.index(column)
    taken = []
    for odd in ODD:
        cells = lines[5].split(",")
        cells[place] = odd
        text = "\n".join([*lines[:5], ",".join(cells), *lines[6:], ""])
        scores.write_bytes(gzip.compress(text.encode()))
        said = complaint(load, scores.parent)
        assert not said or (str(scores) in said and "\n" not in said)
        taken += [] if said else [odd]
    allowed = {"value": ["", "nan", "9" * 30], "variant": [""]}
    assert set(taken) <= set(allowed.get(column, []))


def test_scores_of_another_report_are_refused(tmp_path, capsys):
    write(tmp_path / "in" / "a.csv.gz")
    write(tmp_path / "in" / "b.csv.gz", Run(**{**vars_of(RUN), "seed": 2}))
    (tmp_path / "in" / "a.csv.gz").write_bytes((tmp_path / "in" / "b.csv.gz").read_bytes())
    line = refusal(tmp_path / "in" / "a.csv.gz", capsys)
    assert "expected the scores of a.json, found others" in line


def vars_of(run):
    return {name: getattr(run, name) for name in Run.__slots__}


@pytest.mark.parametrize("lost", ["a.csv.gz", "a.json"])
def test_one_without_the_other_is_refused(lost, tmp_path, capsys):
    write(tmp_path / "in" / "a.csv.gz")
    (tmp_path / "in" / lost).unlink()
    line = refusal(tmp_path / "in" / "a.csv.gz", capsys)
    assert "a.csv.gz" in line or "a.json" in line
    assert "beside it, found none" in line


@pytest.mark.parametrize("call", range(2))
def test_a_full_disk_names_the_file_and_leaves_neither(call, tmp_path, monkeypatch):
    calls = iter(range(9))

    def full(handle):
        if next(calls) == call:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write(tmp_path / "a.csv.gz")
    assert caught.value.filename == str(tmp_path / ("a.csv.gz", "a.json")[call])
    assert list(tmp_path.iterdir()) == []


def test_a_failure_in_between_leaves_the_old_pair(tmp_path):
    write(tmp_path / "a.csv.gz")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def stopped():
        with writing(tmp_path / "a.csv.gz") as file:
            file.add(RUN, 0, ERRORS)
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        stopped()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_in_the_way_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "a.json").mkdir()
    with pytest.raises(StoreError, match=r"a\.json: expected a file to write, found a folder"):
        write(tmp_path / "a.csv.gz")
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize("name", ["=1+1", "-x", "@y", "+z", "'=q"])
def test_names_that_look_like_formulas_are_quoted_and_read_back(name, tmp_path):
    run = Run(**{**vars_of(RUN), "method": name, "variant": name})
    write(tmp_path / "a.csv.gz", run)
    text = gzip.decompress((tmp_path / "a.csv.gz").read_bytes()).decode()
    assert all(line.startswith("'") for line in text.splitlines()[1:])
    assert read_scores(tmp_path / "a.csv.gz")[0].run == run


def test_what_unpacks_to_more_than_memory_should_hold_is_refused(scores, monkeypatch, capsys):
    monkeypatch.setattr(score_files, "MAX_TEXT", 1 << 20)
    bomb = gzip.compress(b"method,variant\n" + b"0" * (1 << 24))
    scores.write_bytes(bomb)
    assert "more than 1048576 bytes unpacked" in refusal(scores, capsys)


def test_no_more_is_written_than_is_read_again(tmp_path, monkeypatch):
    write(tmp_path / "a.csv.gz")
    size = len(gzip.decompress((tmp_path / "a.csv.gz").read_bytes()))
    monkeypatch.setattr(score_files, "MAX_TEXT", size)
    write(tmp_path / "a.csv.gz")
    assert len(read_scores(tmp_path / "a.csv.gz")) == 1
    monkeypatch.setattr(score_files, "MAX_TEXT", size - 1)
    with pytest.raises(StoreError, match=f"at most {size - 1} bytes of scores, .* sample 2"):
        write(tmp_path / "b.csv.gz")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv.gz", "a.json"]
