# SPDX-License-Identifier: MIT
"""A study of tiny runs: everything is made once, and the page says what the files say."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bench import __main__ as program
from bench.analysis.study_page import PAGE, Entry
from bench.requests import Request, StudyRequest
from bench.runs import study
from bench.runs.predict import joined
from scapo.store import write_bytes
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, write_checkpoint
from scapo.store.files import read
from tests.helpers import made
from tests.helpers.tiny import TINY, tiny


def write_run(folder, seed):
    extra = {"seed": seed, "steps": 0, "commit": "0abc", "machine": {"cpu": "a chip", "cores": 2}}
    write_checkpoint(
        folder / WEIGHTS, tiny(seed), checkpoint_header("scapo", TINY, "laptop", extra)
    )
    return str(folder)


@pytest.mark.slow
def test_a_study_is_made_once_and_told_on_one_page(tmp_path, capsys) -> None:
    made.make_data(tmp_path / "data", "laptop", count=6, train=9, points=96)
    runs = [write_run(tmp_path / f"run{seed}", seed) for seed in (1, 2)]
    out = tmp_path / "study"
    words = ["study", *runs, "--data", str(tmp_path / "data"), "--out", str(out), "--mode", "fast",
             "--calibration", "5", "--samples", "3", "--device", "cpu"]  # fmt: skip
    program.main(words)
    assert capsys.readouterr().out.count("study: ") == 12
    page = (out / PAGE).read_text()
    report = json.loads((out / "scores" / "laptop-scapo-cpu-seed1-fast.json").read_text())
    for text in (
        f"{100 * report['summary']['iou_1']['mean']:.1f} [",
        "| laptop-scapo-cpu-seed2 | fast |",
        "## Stability",
        "### scapo cpu laptop test: one piece replaced by the truth",
        "(pictures/laptop-scapo-cpu-seed1-fast/overlay.png)",
        "`scapo-bench study run1 run2 --data data --out study",
        "a chip, 2 cores, cpu",
    ):
        assert text in page, text
    assert str(tmp_path) not in page
    arrays, _ = read(out / "predictions" / "laptop-scapo-cpu-seed1-fast-train.safetensors")
    answered = np.isfinite(arrays["camera_T_part"]).all((1, 2, 3))
    assert answered.nonzero()[0].tolist() == [0, 2, 4, 6, 8]
    assert report["calibration"]["answered"] == [5, 5]
    (out / "scores" / "laptop-scapo-cpu-seed2-fast.csv.gz").unlink()
    program.main(words)
    printed = capsys.readouterr().out
    assert printed.count("study: ") == 1
    assert "seed2-fast.csv.gz" in printed
    assert (out / PAGE).read_text() == page


def test_the_training_split_is_scored_without_a_calibration(tmp_path, monkeypatch) -> None:
    """Which would be one on the clouds that are scored, and is refused."""
    made.make_data(tmp_path / "data", "laptop", count=2, train=4, points=96)
    run, out = write_run(tmp_path / "run", 1), tmp_path / "study"
    for name in ("explain", "draw_pictures"):
        monkeypatch.setattr(study, name, lambda _: [])
    program.main(["study", run, "--data", str(tmp_path / "data"), "--out", str(out), "--mode",
                  "fast", "--split", "train", "--samples", "0"])  # fmt: skip
    report = json.loads((out / "scores" / "laptop-scapo-cpu-seed1-fast.json").read_text())
    assert report["split"] == "train"
    assert report["calibration"] is None
    assert (out / PAGE).is_file()


def test_another_question_is_answered_anew(tmp_path, monkeypatch) -> None:
    for name, count in (("data", 4), ("more", 5)):
        made.make_data(tmp_path / name, "laptop", count=count, train=6, points=96)
    run, out = write_run(tmp_path / "run", 1), tmp_path / "study"

    def make(request: Request) -> None:
        limit = getattr(request, "limit", "")
        write_bytes(request.out, f"{request.data} {request.split} {limit}".encode())

    for name in ("predict", "evaluate_beside", "measure_stability"):
        monkeypatch.setattr(study, name, lambda request, *_: make(request))

    def below(file: str, request: Request) -> tuple[()]:
        make(replace(request, out=request.out / file))
        return ()

    for name, file in (("explain", "ladder.md"), ("draw_pictures", "ranking.png")):
        monkeypatch.setattr(study, name, partial(below, file))
    told: list[Path | None] = []

    def page(out: Path, entries: list[Entry], *_: object) -> Path:
        told.extend(one.stability for one in entries)
        return out

    monkeypatch.setattr(study, "write_page", page)

    def asked(
        data: str = "data", split: str = "test", samples: int = 20, calibration: int = 500
    ) -> list[str]:
        said: list[str] = []
        request = StudyRequest(
            runs=(Path(run),), data=tmp_path / data, out=out, split=split, mode="fast",
            samples=samples, calibration=calibration,
        )  # fmt: skip
        study.study(request, said.append)
        scores = (out / "scores" / "laptop-scapo-cpu-seed1-fast.csv.gz").read_text()
        assert scores.startswith(f"{tmp_path / data} {split}")
        return [Path(line).name for line in said]

    name = "laptop-scapo-cpu-seed1"
    shown = [f"{name}-fast.csv.gz", "ladder.md", "ranking.png"]
    frames, scored = f"{name}-fast-train.safetensors", f"{name}-fast-test.safetensors"
    assert asked() == [scored, frames, *shown, f"{name}.json"]
    assert asked() == []
    assert asked(samples=5) == [f"{name}.json"]
    assert asked(samples=5, calibration=3) == [frames, *shown]
    assert asked(samples=5, split="train") == [frames, *shown, f"{name}.json"]
    assert asked(samples=5) == [frames, *shown, f"{name}.json"]
    assert asked("more", samples=5) == [scored, *shown, f"{name}.json"]
    assert asked("more", samples=0) == []
    assert told[-2:] == [out / "stability" / f"{name}.json", None]


def test_runs_of_one_name_are_refused(tmp_path, capsys) -> None:
    made.make_data(tmp_path / "data", "laptop", count=4, train=6, points=96)
    run = write_run(tmp_path / "run", 1)
    with pytest.raises(SystemExit):
        program.main(["study", run, run, "--data", str(tmp_path / "data"), "--out",
                      str(tmp_path / "out"), "--mode", "fast", "--samples", "0"])  # fmt: skip
    assert "found 'laptop-scapo-cpu-seed1' twice" in capsys.readouterr().err


def test_no_run_is_wrong_usage(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        program.main(["study", "--data", str(tmp_path), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert capsys.readouterr().err == "scapo-bench: RUN: expected one or more, found none\n"
    assert not (tmp_path / "out").exists()


def test_joined_leaves_the_others_without_an_answer() -> None:
    parts = [{"x": np.ones((2, 3), np.float32)}, {"x": np.full((1, 3), 2, np.float32)}]
    full = joined(parts, np.array([0, 2, 3]), 5)["x"]
    assert full.dtype == np.float32
    np.testing.assert_array_equal(full[:, 0], [1, np.nan, 1, 2, np.nan])
    assert joined(parts, np.arange(3), 3)["x"].shape == (3, 3)
