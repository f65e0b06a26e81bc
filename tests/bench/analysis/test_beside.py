# SPDX-License-Identifier: MIT
"""What `evaluate` scores beside a method: other readings of it, and answers that are no method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench import __main__ as program
from bench.analysis import beside
from bench.analysis.beside import evaluate_beside, score_references
from bench.analysis.reference import training_split
from bench.requests import EvaluateRequest, Request, Settings
from bench.scoring.evaluate import evaluate
from bench.scoring.score_files import read_report, read_scores
from bench.statistics import interval
from bench.tables.render import to_markdown
from bench.tables.results import load
from bench.tables.write import build
from scapo.store import Split
from scapo.store.predictions import write_predictions
from tests.helpers import made

KINDS = ("constant", "oracle-pose")


def benchmark(folder: Path, part: str = "clean", *, seed: int = 2) -> Split:
    """Training and test objects of one part; the test objects have traits and `alike`."""
    for name, count, own in (("train", 8, 1), ("test", 12, seed)):
        arrays = made.sample_arrays("oven", count, 32, seed=own)
        if name == "test":
            arrays = made.unambiguous(arrays)
        split = made.write_split(folder / part, "oven", name, arrays)
    return made.give_traits(split, ["proportions", "", "hinge set back"])


def shuffled(split: Split) -> dict[str, np.ndarray]:
    """The truth with the parts of every third sample exchanged."""
    answer = made.truth_as_prediction(split)
    answer["part"][::3] = np.array([1, 0], np.uint8)[answer["part"][::3]]
    return answer


def asked(folder: Path, split: Split, name: str = "mine") -> EvaluateRequest:
    path = folder / f"{name}.safetensors"
    write_predictions(path, made.header_of(split, method=name, camera=True), shuffled(split))
    return EvaluateRequest(
        predictions=path, data=split.folder.parent.parent, split=split.manifest.split,
        out=folder / "scores" / f"{name}.csv.gz",
    )  # fmt: skip


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*.csv.gz"))


def test_one_command_makes_every_row_of_the_table(tmp_path: Path) -> None:
    split = benchmark(tmp_path / "data")
    request = asked(tmp_path, split)
    _, found = evaluate_beside(request)
    readings = ("", ".ambiguity", ".one-order")
    assert names(tmp_path / "scores") == sorted(
        f"{name}{reading}.csv.gz"
        for name in ("mine", *(f"references/clean-oven-test-{kind}" for kind in KINDS))
        for reading in readings
    )
    assert len(found) == 8
    table = build(load(tmp_path / "scores"))[0]
    rows = {
        row.method: row for block in table.blocks[:1] for row in block.rows if row.source == "ours"
    }
    plain = ["mine", "Constant prediction", "Oracle pose"]
    assert [name for name, row in rows.items() if not row.plain] == plain
    assert "mine, one part order" in rows
    assert not any("ambiguity" in name for name in rows)  # no view looks like another
    assert [rows[name].camera for name in ("mine", "Oracle pose")] == [True, False]
    assert rows["Oracle pose"].marks == (True, True, True)
    text = to_markdown(table)
    assert "Not scored" not in text
    (swapped,) = (row for block in table.blocks for row in block.rows
                  if block.heading.startswith("O ") and row.method == "mine")  # fmt: skip
    assert swapped.cells[3].shown == "33.3"  # the third that were exchanged


def test_what_stands_beside_is_what_its_own_command_gives(tmp_path: Path) -> None:
    split = benchmark(tmp_path / "data")
    request = asked(tmp_path, split)
    evaluate_beside(request)
    for reading, settings in (("one-order", Settings(label_order="dataset")),
                              ("ambiguity", Settings(ambiguity="on"))):  # fmt: skip
        alone = tmp_path / f"{reading}.csv.gz"
        evaluate(Request(predictions=request.predictions, data=request.data, out=alone,
                         settings=settings))  # fmt: skip
        scores = tmp_path / "scores" / f"mine.{reading}.csv.gz"
        assert scores.read_bytes() == alone.read_bytes()
    for kind in KINDS:
        path = tmp_path / f"{kind}.safetensors"
        program.main(["reference", kind, "--data", str(request.data), "--category", "oven",
                      "--out", str(path)])  # fmt: skip
        evaluate(Request(predictions=path, data=request.data, out=tmp_path / f"{kind}.csv.gz"))
        scores = tmp_path / "scores" / "references" / f"clean-oven-test-{kind}.csv.gz"
        assert scores.read_bytes() == (tmp_path / f"{kind}.csv.gz").read_bytes()


def test_references_are_made_once_for_the_same_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = benchmark(tmp_path / "data")
    made_for: list[str] = []
    write = beside.write_answers
    monkeypatch.setattr(
        beside, "write_answers", lambda kind, *rest: (made_for.append(kind), write(kind, *rest))
    )
    evaluate_beside(asked(tmp_path, split, "mine"))
    assert made_for == list(KINDS)
    evaluate_beside(asked(tmp_path, split, "other"))
    assert made_for == list(KINDS)
    (tmp_path / "scores" / "references" / "clean-oven-test-constant.one-order.json").unlink()
    evaluate_beside(asked(tmp_path, split, "other"))
    assert made_for == [*KINDS, "constant"]
    again = benchmark(tmp_path / "data", seed=5)  # other test clouds under the same name
    score_references(again.folder.parent.parent, again, tmp_path / "scores")
    assert made_for == [*KINDS, "constant", *KINDS]


def test_nothing_stands_beside_what_is_read_otherwise_or_asked_for_alone(tmp_path: Path) -> None:
    split = benchmark(tmp_path / "data")
    request = asked(tmp_path, split)
    evaluate_beside(replace(request, companions=False))
    assert names(tmp_path / "scores") == ["mine.csv.gz"]
    evaluate_beside(replace(request, settings=Settings(iou="soft")))
    assert names(tmp_path / "scores") == ["mine.csv.gz"]
    train = Split(split.folder.parent / "train")
    evaluate_beside(asked(tmp_path, train, "train"))
    assert "references" not in " ".join(names(tmp_path / "scores"))
    evaluate_beside(asked(tmp_path, split, "constant"))
    assert "references" not in " ".join(names(tmp_path / "scores"))


def test_data_without_training_objects_take_those_of_clean(tmp_path: Path) -> None:
    split = made.write_split(tmp_path / "data" / "real", "oven", "test",
                             made.sample_arrays("oven", 4, 32))  # fmt: skip
    assert training_split(split) is None
    _, written = evaluate_beside(asked(tmp_path, split))
    assert [path.name for path in written] == ["mine.one-order.csv.gz"]
    clean = benchmark(tmp_path / "data")
    found = training_split(split)
    assert found is not None
    assert found.folder == clean.folder.parent / "train"
    files = score_references(tmp_path / "data" / "real", split, tmp_path / "scores")
    assert files[0].name == "real-oven-test-constant.csv.gz"
    assert read_report(files[0]).run["data_digest"] == found.manifest.digest


def test_scores_are_told_apart_by_trait(tmp_path: Path) -> None:
    split = benchmark(tmp_path / "data")
    request = asked(tmp_path, split)
    report, _ = evaluate_beside(request)
    (scores,) = read_scores(request.out)
    assert scores.traits == ("hinge set back", "proportions")
    assert sorted(report["by_trait"]) == ["hinge set back", "proportions"]
    instance = split.arrays("instance")["instance"]
    for number, trait in ((0, "proportions"), (2, "hinge set back")):
        found = report["by_trait"][trait]
        members = instance == number
        assert (found["samples"], found["instances"]) == (members.sum(), 1)
        expected = interval(scores.errors["part_rotation", "deg"][members], instance[members])
        assert found["summary"]["part_rotation_deg"]["mean"] == pytest.approx(expected.mean)
        share = (np.flatnonzero(members) % 3 == 0).mean()
        assert found["summary"]["swapped_1"]["mean"] == pytest.approx(share)
        few = scores.of_trait(trait)
        assert few.samples.tolist() == np.flatnonzero(members).tolist()


def test_the_command_scores_references_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split = benchmark(tmp_path / "data", "complete")
    words = ["--data", str(split.folder.parent.parent), "--category", "oven"]
    for wrong, said in (
        ([*words], "expected --out or --scores, found neither"),
        ([*words, "--out", str(tmp_path / "p.safetensors")], "one file each, found both"),
    ):
        with pytest.raises(SystemExit) as ended:
            program.main(["reference", "both", *wrong])
        assert ended.value.code == 2
        assert said in capsys.readouterr().err
    program.main(["reference", "both", *words, "--scores", str(tmp_path / "scores")])
    out = capsys.readouterr().out.splitlines()
    assert [Path(line).name for line in out[::3]] == [
        f"complete-oven-test-{kind}.csv.gz" for kind in KINDS
    ]
    table = build(load(tmp_path / "scores"))[4]
    assert table.number == "1-complete"
    ours = [row for row in table.blocks[0].rows if row.source == "ours"]
    rows = {row.method for row in ours if not row.plain}
    assert rows == {"Constant prediction", "Oracle pose"}
