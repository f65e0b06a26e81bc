# SPDX-License-Identifier: MIT
"""A method with conventions of its own answers in the object's frame after training on labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bench.infer import model as models
from bench.requests import PredictRequest, Request
from bench.runs import align as room
from bench.runs import predict as predicting
from bench.runs.align import align, aligned
from bench.runs.predict import predict
from bench.scoring.evaluate import evaluate
from scapo.alignment import Alignment, unit_length
from scapo.method import Mode
from scapo.records import map_tensors
from scapo.store import Split, StoreError
from scapo.store.checkpoint import WEIGHTS, read_checkpoint
from scapo.store.predictions import read_prediction_header
from scapo.types import Observation, Prediction
from tests.helpers.conventions import convention, in_own_words
from tests.helpers.placed import Told, placed_run, told_split

COUNT = 24
OWN = convention((1, 0), np.random.default_rng(3))


class Own(Told):
    """Right but for every sixth cloud, in conventions of its own: its base is the door."""

    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        found = map_tensors(super().predict(observation, mode), wide)
        limits = torch.tensor([[[0.0, 1.2]]]).double().expand(len(found.part_weight), 1, 2)
        found = replace(found, joint_limits=limits)
        words = in_own_words(found, OWN, wide(unit_length(observation.points)), self.category)
        return map_tensors(words, lambda one: one.float() if one.is_floating_point() else one)


def wide(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.double() if tensor.is_floating_point() else tensor


@pytest.fixture(scope="module")
def own() -> Own:
    return Own(COUNT, wrong=dict.fromkeys(range(0, COUNT, 6), 0.8))


@pytest.fixture
def run(own: Own, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that loads as `own`; data with its clouds twice, as train and val."""
    for split in ("train", "val"):
        told_split(own, tmp_path / "data", split)
    folder = placed_run(tmp_path / "run")
    for place in (room, predicting):
        monkeypatch.setattr(place, "load", lambda path: (own, read_checkpoint(path)[1]))
    return folder


def train_split(run: Path) -> Split:
    return Split(run.parent / "data" / "oven" / "train")


def scores(run: Path, name: str, calibration: str | None = None, **flags: Any) -> dict[str, Any]:
    """The report of predictions on val."""
    data, out = run.parent / "data", run.parent / f"{name}.safetensors"
    predict(PredictRequest(checkpoint=run, data=data, split="val", out=out, device="cpu", **flags))
    frames = None if calibration is None else run.parent / f"{calibration}.safetensors"
    return evaluate(Request(
        predictions=out, data=data, split="val", out=run.parent / f"{name}.csv.gz",
        calibration=frames,
    ))  # fmt: skip


def median_rotation(run: Path, name: str) -> float:
    import pandas as pd

    rows = pd.read_csv(run.parent / f"{name}.csv.gz")
    return float(rows[rows.metric == "part_rotation"].value.median())


def test_a_finished_run_gets_the_frame_by_which_its_answers_are_true(run: Path) -> None:
    weights, before = read_checkpoint(run)
    said: list[str] = []
    align(run, train_split(run), "cpu", said.append)
    assert said == [
        "poses in the object's frame: fitted on 24 labelled clouds of train, after training"
    ]
    after, header = read_checkpoint(run)
    assert all(np.array_equal(weights[name], after[name]) for name in weights)
    found = header.pop("alignment")
    assert header == before
    assert found["order"] == [1, 0]
    assert found["sign"] == list(OWN.sign)
    np.testing.assert_allclose(found["zero"], OWN.zero, atol=1e-3)
    np.testing.assert_allclose(found["own_T_part"][0], OWN.own_T_part[0], atol=1e-3)
    assert found["clouds"] == {
        "split": "train", "data_digest": train_split(run).manifest.digest, "samples": 24,
        "mode": "quick",
    }  # fmt: skip
    bytes_then = (run / WEIGHTS).read_bytes()
    align(run, train_split(run), "cpu", said.append)
    assert (run / WEIGHTS).read_bytes() == bytes_then
    assert len(said) == 1


def test_scores_are_right_without_a_calibration_and_the_report_says_why(run: Path) -> None:
    before = scores(run, "before")
    assert before["calibration"] is None
    assert median_rotation(run, "before") > 20
    align(run, train_split(run), "cpu", lambda line: None)
    after = scores(run, "after")
    assert median_rotation(run, "after") < 0.1
    assert after["calibration"] == {
        "at": "training", "samples": 24, "split": "train", "mode": "quick",
        "data": train_split(run).manifest.digest,
    }  # fmt: skip
    state, state_before = (one["summary"]["joint_state_deg"]["mean"] for one in (after, before))
    assert state < 0.1 < state_before
    frame = read_prediction_header(run.parent / "after.safetensors").object_frame
    assert frame is not None
    assert frame.order == (1, 0)


def test_a_calibration_gives_the_same_in_either_frame_and_frames_are_not_mixed(run: Path) -> None:
    align(run, train_split(run), "cpu", lambda line: None)
    reports = []
    for flag in (False, True):
        trained = run.parent / f"train-{flag}.safetensors"
        predict(PredictRequest(checkpoint=run, data=run.parent / "data", split="train",
                               out=trained, device="cpu", own_frame=flag))  # fmt: skip
        reports.append(scores(run, f"own-{flag}", f"train-{flag}", own_frame=flag))
    one, other = (report["summary"] for report in reports)
    for name in ("iou_1", "part_rotation_deg", "part_translation_r4", "joint_direction_deg"):
        assert one[name]["mean"] == pytest.approx(other[name]["mean"], abs=1e-3)
    with pytest.raises(StoreError, match="'object_frame': expected that of 24 clouds of 'train'"):
        scores(run, "mixed", "train-True")


def test_without_labels_or_poses_frames_stay_as_found(run: Path, own: Own, tmp_path: Path) -> None:
    split = train_split(run)
    assert aligned(own, split, 19, "quick", "cpu") is None  # fewer than 20 clouds
    said: list[str] = []
    blank = told_split(own, tmp_path / "blank", "train", labelled=False)
    align(run, blank, "cpu", said.append)
    (line,) = said
    assert line.startswith("poses stay in the method's own frames: ")
    assert "has fewer than 20 labelled clouds with an answer" in line
    assert "alignment" not in read_checkpoint(run)[1]


def test_infer_answers_in_the_stored_frame(run: Path) -> None:
    align(run, train_split(run), "cpu", lambda line: None)
    stored = models.load_model(run, "cpu", "fast")
    assert stored.predictor.in_object_frame
    assert isinstance(stored.predictor.alignment, Alignment)
    assert stored.calibration is None
