# SPDX-License-Identifier: MIT
"""Released models: half the size, the same answers, a card; those of this checkout among them."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from bench import __main__ as program
from bench.requests import ReleaseRequest, Request
from bench.runs import release as releasing
from bench.runs.release import MAX_BYTES, answers_file, card_of, compare_answers, release
from bench.scoring.evaluate import evaluate
from scapo import released
from scapo.alignment import Alignment
from scapo.predictor import load
from scapo.released import find
from scapo.store import StoreError
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, read_checkpoint, write_checkpoint
from scapo.types import Observation
from tests.helpers.conventions import CLOUDS
from tests.helpers.made import sample_arrays, write_split, write_truth
from tests.helpers.placed import placed
from tests.helpers.sighted import sighted
from tests.helpers.tiny import TINY, tiny

RELEASED = sorted(released.weights())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished run of SCAPO on laptops, and their validation split."""
    extra = {"seed": 1, "data_digest": "d" * 64, "supervision": [], "steps": 7, "finished": True,
             "versions": {}, "parameters": 5, "commit": "abc"}  # fmt: skip
    header = checkpoint_header("scapo", TINY, "laptop", extra)
    write_checkpoint(tmp_path / "run" / WEIGHTS, tiny(), header)
    write_split(tmp_path / "data", "laptop", "val", sample_arrays("laptop", 12, 96))
    return tmp_path


def request(folder: Path, **more: Path) -> ReleaseRequest:
    out = folder / "results" / "checkpoints" / "laptop-scapo.safetensors"
    asked = ReleaseRequest(checkpoint=folder / "run", data=folder / "data", out=out)
    return dataclasses.replace(asked, **more)


def test_a_release_is_half_as_large_and_answers_alike(folder: Path, monkeypatch):
    weights, card, answers = release(request(folder))
    before, _ = read_checkpoint(folder / "run")
    after, header = read_checkpoint(weights)
    assert {name: array.shape for name, array in after.items()} == {
        name: array.shape for name, array in before.items()
    }
    sizes = [sum(array.nbytes for array in arrays.values()) for arrays in (before, after)]
    assert sizes[1] < 0.51 * sizes[0]
    assert all(array.dtype != np.float32 for array in after.values())
    assert header["source"] != ""
    monkeypatch.setattr(released, "CHECKOUT", weights.parent.absolute())
    points = np.random.default_rng(0).normal(size=(96, 3))
    here = load("laptop/scapo").predict(points)
    assert all(value.dtype == torch.float32 for value in load(weights).model.state_dict().values()
               if value.is_floating_point())  # fmt: skip
    assert_close(here.part_weight, load(folder / "run").predict(points).part_weight,
                 atol=0.02, rtol=0)  # fmt: skip
    with pytest.raises(StoreError, match=r"released weights \(.*laptop/scapo.*\), found none"):
        find("laptop/other")
    assert '`scapo.load("laptop/scapo").predict(points)`' in card.read_text()
    assert answers.parent == folder / "results" / "checks"


def test_what_lies_there_already_stays_and_its_answers_are_made_anew(folder: Path):
    weights, card, answers = release(request(folder))
    before = weights.read_bytes(), card.read_bytes(), answers.read_bytes()
    card.unlink()
    answers.unlink()
    assert release(request(folder, checkpoint=weights)) == [weights, card, answers]
    assert (weights.read_bytes(), card.read_bytes(), answers.read_bytes()) == before


def test_a_run_of_before_gets_its_frame_from_its_own_training_data(folder: Path, monkeypatch):
    split = write_split(folder / "data", "laptop", "train", sample_arrays("laptop", 24, 96))
    made = Alignment.of_order((1, 0), CLOUDS)
    monkeypatch.setattr(releasing, "aligned", lambda *_: made)
    weights, card, _ = release(request(folder))
    assert read_checkpoint(weights)[1].get("alignment") is None  # the run's data are others
    assert "the frames of the parts are the method's own" in card.read_text()
    arrays, header = read_checkpoint(folder / "run")
    about = {**header, "data_digest": split.manifest.digest}
    releasing.write(folder / "run" / WEIGHTS, arrays, about)
    weights, card, _ = release(request(folder))
    assert load(weights).alignment == made
    assert "13 numbers,\n  fitted after training with the labels of 30 clouds" in card.read_text()
    points = np.random.default_rng(0).normal(size=(96, 3))
    here, own = (load(weights).predict(points, own_frame=flag) for flag in (False, True))
    assert_close(here.part_weight, own.part_weight.flip(-1))
    for found in compare_answers(weights).values():
        assert float(found.pose.max()) == 0


def test_other_answers_are_noticed(folder: Path):
    weights, _, answers = release(request(folder))
    for found in compare_answers(weights).values():
        assert float(found.part_weight.max()) == 0
        assert float(found.pose.max()) == 0
        assert found.pose.shape == (10,)
    other = folder / "other.safetensors"
    header = read_checkpoint(weights)[1]
    changed = tiny()
    with torch.no_grad():
        for parameter in changed.parameters():
            parameter.add_(0.05)
    write_checkpoint(other, changed, header)
    digest = "found those of another model"
    other.replace(weights)
    with pytest.raises(StoreError, match=digest):
        compare_answers(weights)
    kept, about = releasing.read(answers, releasing.FORMAT)
    releasing.write(answers, kept, {**about, "model": releasing.sha256_file(weights)})
    assert float(compare_answers(weights)["fast"].pose.max()) > 1e-2


def test_the_card_tells_the_scores_of_this_run(folder: Path):
    header = read_checkpoint(folder / "run")[1]
    split = write_split(folder / "data", "laptop", "test", sample_arrays("laptop", 8, 96))
    for name, config in (("other", {}), ("own", header["config"])):
        made_by = {"data_digest": header["data_digest"], "config": config}
        path = write_truth(folder / f"{name}.safetensors", split, method="scapo", run=made_by)
        out = folder / "scores" / f"{name}.csv.gz"
        evaluate(Request(predictions=path, data=folder / "data", out=out))
        text = card_of(header, request(folder, scores=folder / "scores"))
        assert ("None of this run." in text) == (name == "other")
    assert "| clean | test | fast | all | 8 | 100.0 | 0.0 | 0.000 | 0.0‡ | 0.000‡ |" in text
    assert text.count("‡ Not calibrated: ") == 1
    assert text.count("| all |") == 1
    assert "d" * 64 in text
    assert "## Limits" in text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"finished": False}, "expected a finished run"),
        ({"config": {"preset": "none"}}, "expected one of paper, literal, cpu"),
    ],
)
def test_what_cannot_be_released(folder: Path, change, message: str, capsys):
    arrays, header = read_checkpoint(folder / "run")
    releasing.write(folder / "run" / WEIGHTS, arrays, {**header, **change})
    with pytest.raises(SystemExit) as stop:
        program.main(["release", str(folder / "run"), "--data", str(folder / "data"), "--out",
                      str(folder / "a.safetensors")])  # fmt: skip
    assert stop.value.code == 1
    assert message in capsys.readouterr().err
    assert not (folder / "a.safetensors").exists()


def test_names_sizes_and_numbers_are_bounded(folder: Path, monkeypatch):
    with pytest.raises(StoreError, match=r"ends in \.safetensors"):
        release(request(folder, out=folder / "a.bin"))
    monkeypatch.setattr(releasing, "MAX_BYTES", 100)
    with pytest.raises(StoreError, match="expected at most 100 bytes"):
        release(request(folder))
    large = tiny()
    with torch.no_grad():
        next(large.parameters()).fill_(1e5)
    with pytest.raises(StoreError, match="expected numbers below 65,504"):
        releasing.slim(large, folder / "large.safetensors", {})


def test_registration_lets_go_of_clouds_that_nothing_looks_at():
    method = copy.deepcopy(placed())
    views, _ = sighted(1, seed=5)
    cloud = Observation(points=views.points - views.camera[:, None])
    method.pseudo.trust[::3] = 0
    before = method.predict(cloud, "quick")
    method.strip()
    assert len(method.pseudo.trust) == len(method.pseudo.points) == 8
    assert method.pseudo.belonging.numel() == 0
    after = method.predict(cloud, "quick")
    assert_close(after.part_weight, before.part_weight)
    assert_close(after.camera_T_part, before.camera_T_part)


@pytest.mark.parametrize("name", RELEASED)
def test_what_is_released_here_answers_as_it_did(name: str):
    path = released.weights()[name]
    assert path.stat().st_size <= MAX_BYTES
    assert path.with_suffix(".md").is_file()
    assert answers_file(path).is_file()
    found = compare_answers(path)
    assert float(found["fast"].pose.max()) < 1e-3
    assert float(found["fast"].part_weight.max()) < 0.05  # of a point between two parts
    # A search may end elsewhere where two placements fit alike and a machine rounds otherwise.
    assert (found["quick"].pose < 1e-2).sum() >= 8
