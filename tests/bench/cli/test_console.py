# SPDX-License-Identifier: MIT
"""What reaches the terminal: names as they are, on one line, obeyed by nobody."""

from __future__ import annotations

import csv

import pytest

from bench import __main__ as program
from bench.analysis.answered import read_answered
from bench.figures.overlay import overlay_picture
from bench.figures.pictures import ranking_picture
from bench.requests import Request
from scapo.store.files import read, write
from scapo.store.predictions import write_predictions
from tests.helpers import made

NAME = "[/x] :smile: [c] $\\frac{$"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data and predictions of an oddly named method in an oddly named folder."""
    folder = tmp_path_factory.mktemp("odd") / NAME
    split = made.make_data(folder / "data", "laptop", count=6, train=8, points=40)
    header = made.header_of(split, method=NAME, variant="=1|[red]<b>")
    write_predictions(folder / "p.safetensors", header, made.truth_as_prediction(split))
    return folder


def test_names_are_printed_as_they_are(folder, tmp_path, capsys):
    out = tmp_path / NAME
    words = ["--predictions", str(folder / "p.safetensors"), "--data", str(folder / "data")]
    program.main(["evaluate", *words, "--out", str(out / "s" / "s.csv.gz")])
    printed = capsys.readouterr().out
    assert f"Scores: {out / 's' / 's.csv.gz'}\n" in printed
    assert NAME in printed.replace("\n", " ")
    program.main(["explain", *words, "--out", str(out / "e")])
    program.main(["tables", "--scores", str(out / "s"), "--out", str(out / "t")])
    assert str(out / "t" / "table1.md") in capsys.readouterr().out
    with (out / "t" / "table1.csv").open(newline="") as file:
        assert NAME in {row["method"].partition(" (")[0] for row in csv.DictReader(file)}


def test_names_are_drawn_as_they_are(folder, tmp_path):
    answered = read_answered(
        Request(predictions=folder / "p.safetensors", data=folder / "data", out=tmp_path)
    )
    overlay_picture(answered, tmp_path / "a.png", answered.instance)
    ranking_picture(answered, folder / "p.safetensors", tmp_path / "b.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert (tmp_path / "b.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["a\nb", "\x1b[31mred", "\x9b2J", "\udcff", "[/x]", ":smile:"])
def test_a_refusal_is_one_line_that_obeys_nothing(name, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        program.main(["tables", "--scores", str(tmp_path / name)])
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert said.err[:-1].isprintable()
    if name.isprintable():
        assert f"scapo-bench: {tmp_path / name}: expected a folder of scores" in said.err


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, "x" * 10**6) for field in ("method", "variant", "seed", "budget", "supervision")],
)
def test_a_name_of_a_megabyte_is_refused_in_short(field, value, folder, tmp_path, capsys):
    arrays, header = read(folder / "p.safetensors")
    write(tmp_path / "p.safetensors", arrays, {**header, field: value})
    with pytest.raises(SystemExit):
        program.main(["evaluate", "--predictions", str(tmp_path / "p.safetensors"), "--data",
                      str(folder / "data"), "--out", str(tmp_path / "s.csv.gz")])  # fmt: skip
    said = capsys.readouterr().err
    assert f"header field {field!r}" in said
    assert len(said) < 3000
