# SPDX-License-Identifier: MIT
"""The figures of a run: each is drawn, or said why not; predictions of another run are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from bench import __main__ as program
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, write_checkpoint
from tests.helpers import made
from tests.helpers.tiny import TINY, tiny


def run_and_predictions(folder: Path) -> list[str]:
    made.make_data(folder / "data", "laptop", count=5, train=5, points=96)
    header = checkpoint_header("scapo", TINY, "laptop", {"seed": 1, "steps": 0})
    write_checkpoint(folder / "run" / WEIGHTS, tiny(1), header)
    file = folder / "p.safetensors"
    words = ["--data", str(folder / "data")]
    program.main(["predict", str(folder / "run"), *words, "--out", str(file), "--device", "cpu"])
    return ["pictures", str(folder / "run"), *words, "--predictions", str(file), "--clouds", "3"]


def test_figures_are_drawn_or_said_to_be_left_out(tmp_path, capsys) -> None:
    words = run_and_predictions(tmp_path)
    capsys.readouterr()
    program.main([*words, "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "training.png: left out" in printed
    drawn = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert drawn == ["overlay.png", "ranking.png", "template.png"]
    for name in drawn:
        with Image.open(tmp_path / "out" / name) as image:
            assert image.width > 300
            assert len(set(image.convert("L").resize((40, 40)).tobytes())) > 5


def test_predictions_of_another_run_are_refused(tmp_path, capsys) -> None:
    words = run_and_predictions(tmp_path)
    header = checkpoint_header("scapo", TINY, "laptop", {"seed": 2, "steps": 0})
    write_checkpoint(tmp_path / "run" / WEIGHTS, tiny(2), header)
    with pytest.raises(SystemExit):
        program.main([*words, "--out", str(tmp_path / "out")])
    assert "expected" in capsys.readouterr().err
