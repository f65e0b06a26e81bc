# SPDX-License-Identifier: MIT
"""Ctrl-C while `scapo-bench` or the demo starts: status 130 and one line, wherever it is then."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.cli.program import run
from bench.methods import METHODS
from scapo.ranges import check_numbers
from tests.helpers.struck import check_struck


@pytest.mark.parametrize("struck", ["scapo.interrupt", "tyro", "bench.cli.verbs"])
def test_an_interrupt_in_an_import(repository: Path, struck: str) -> None:
    check_struck("bench", struck, repository)


@pytest.mark.parametrize("struck", ["tyro", "torch"])
def test_an_interrupt_in_an_import_of_the_demo(repository: Path, struck: str) -> None:
    check_struck("bench.demo", struck, repository)


@pytest.mark.parametrize(
    ("words", "kind", "meant"),
    [(["trian"], "verb", "train"), (["train", "registerd", "--seed", "1"], "method", "registered")],
)
def test_a_verb_or_method_that_is_none_is_told_the_one_that_looks_like_it(
    words: list[str], kind: str, meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(words)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"scapo-bench: {kind} ")
    assert said.endswith(f"did you mean '{meant}'?\n")


@pytest.mark.parametrize("words", [["predict", "registerd"], ["train", "--help"], ["--help"]])
def test_other_words_are_left_to_the_parser(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A run may have any name, and flags may come first."""
    with pytest.raises(SystemExit):
        run(words)
    shown = capsys.readouterr()
    assert "did you mean" not in shown.out + shown.err


def test_every_preset_of_every_method_has_numbers_that_can_be() -> None:
    for method in METHODS.values():
        for preset in method.presets:
            check_numbers(method.preset(preset))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("gcn3d --dropout 7", "--dropout: expected 0 to 1, found 7"),
        ("gcn3d --neighbours 100000", "--neighbours: expected 1 to 1024, found 100000"),
        ("gcn3d --widths 0 1 1 1 1", "--widths: expected 1 or more, found 0"),
        ("pointnet2 --near-radii 0.1", "--near-samples: expected 1, as --near-radii has, found 3"),
        ("npcs-epn --network.frames 0", "--network.frames: expected 1 or more, found 0"),
        ("eap --encoder.channels 0", "--encoder.channels: expected 1 or more, found 0"),
        ("op-align --backbone.depth 1", "--backbone.depth: expected 4, as --backbone.channels has"),
        ("icp --reach nan", "--reach: expected a finite number above 0, found nan"),
        ("registered --epochs 0", "--epochs: expected 1 or more, found 0"),
        ("registered --discovery.trusted", "--discovery.trusted: expected 1 or more numbers"),
        ("registered --lr inf", "--lr: expected a finite number, 0 or more, found inf"),
        ("scapo --epochs 1 2 3", "--epochs: expected 1 to 2 numbers, found 3"),
        ("scapo --gamma 0", "--gamma: expected a finite number above 0, found 0"),
        ("icp --seed -1", "--seed: expected 0 or more, found -1"),
        ("icp --checkpoint-every nan", "--checkpoint-every: expected a finite number, 0 or more"),
    ],
)
def test_numbers_that_cannot_be_are_refused_before_any_work(
    words: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    rest = ["--category", "laptop", "--data", str(tmp_path), "--out", str(out)]
    with pytest.raises(SystemExit) as ended:
        run(["train", *words.split(), *rest])
    assert ended.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"scapo-bench: {said}")
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (["run", "cpu", "--only"], "--only"),
        (["run", "cpu", "--splits", "--out", "x"], "--splits"),
        (["tables", "--scores", ""], "--scores"),
    ],
)
def test_a_flag_with_nothing_to_it_is_refused_before_any_work(
    words: list[str], flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"scapo-bench: {flag}: expected a value, found none\n"
