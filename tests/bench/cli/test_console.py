# SPDX-License-Identifier: MIT
"""What reaches the terminal: names as they are, on one line, obeyed by nobody."""

from __future__ import annotations

import csv
import io

import pytest
from rich.console import Console

from bench import __main__ as program
from bench.analysis.answered import read_answered
from bench.cli import console as module
from bench.figures.overlay import overlay_picture
from bench.figures.pictures import ranking_picture
from bench.requests import Request
from scapo.method import Stage
from scapo.store.files import read, write
from scapo.store.predictions import write_predictions
from scapo.training.fit import Progress
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


def test_a_place_that_is_a_file_is_told_with_what_was_expected(folder, tmp_path, capsys):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as ended:
        program.main(["evaluate", "--predictions", str(folder / "p.safetensors"), "--data",
                      str(folder / "data"), "--out", str(tmp_path / "file/s.csv.gz")])  # fmt: skip
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert said == f"scapo-bench: {tmp_path / 'file'}: expected a folder, found a file\n"


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
    assert f"header field {field}: expected" in said
    assert len(said) < 3000


def heard(console: Console, monkeypatch: pytest.MonkeyPatch, steps: list[tuple[float, Progress]]):
    """A training of which is heard at those seconds."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with module.stage_bars(console) as listener:
        for seconds, step in steps:
            now[0] = seconds
            listener(step)


def position(done: float, step: str = "", left: float | None = None) -> Progress:
    stage = Stage(name="[/x] votes", epochs=2, lr=1.0)
    loss = None if step else 0.5
    return Progress(stage=stage, epoch=0, done=done, loss=loss, step=step, left=left)


def test_a_log_has_a_line_of_progress_at_once_and_each_half_minute(monkeypatch):
    steps = [
        (0.0, position(0.0, "draw 1", 500.0)),
        (20.0, position(0.1, "draw 2", 470.0)),
        (40.0, position(0.2, "[c] draw 3", 65.0)),
        (80.0, position(0.0)),
        (100.0, position(0.25)),
        (120.0, position(0.5)),
    ]
    out = io.StringIO()
    heard(Console(file=out, width=100), monkeypatch, steps)
    lines = out.getvalue().splitlines()
    assert lines[:4] == [
        "[/x] votes: draw 1, 0 % of the start, about 8 min 20 s left",
        "[/x] votes: [c] draw 3, 20 % of the start, about 1 min 05 s left",
        "[/x] votes, 0 %  loss 0.5000",
        "[/x] votes, 50 %  loss 0.5000, about 0 min 40 s left",
    ]
    assert [line.split(" ━")[0].rstrip() for line in lines[4:]] == [
        "[/x] votes: start",
        "[/x] votes",
    ]


def test_a_terminal_has_a_bar_with_the_time_left(monkeypatch):
    out = io.StringIO()
    console = Console(file=out, width=90, force_terminal=True, color_system=None)
    steps = [(0.0, position(0.4, "rung 1 of 2, template 1 of 3", 3725.0))]
    heard(console, monkeypatch, steps)
    last = next(line for line in reversed(out.getvalue().splitlines()) if "votes" in line)
    assert "[/x] votes: rung 1 of 2, template 1 of 3" in last
    assert "40.0 %" in last
    assert "1:02:05" in last
    assert "of the start" not in out.getvalue()
