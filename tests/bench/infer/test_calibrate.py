# SPDX-License-Identifier: MIT
"""A model is calibrated on labelled clouds, and infer then speaks of its answers in their terms."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from bench.infer import answer
from bench.infer import calibrate as room
from bench.infer.calibrate import calibrate
from bench.infer.calibration import read_calibration
from bench.requests import CalibrateRequest
from scapo.store.checkpoint import WEIGHTS
from scapo.store.samples import TENSORS
from scapo.store.schema import StoreError
from tests.helpers.made import write_split
from tests.helpers.placed import Told, placed_run, told_model, told_split

COUNT = 24


@pytest.fixture(scope="module")
def told() -> Told:
    """Every fourth answer is wrong, with a smaller margin."""
    return Told(COUNT, wrong=dict.fromkeys(range(0, COUNT, 4), 0.4))


@pytest.fixture
def data(told, tmp_path):
    """The clouds with the truth, as a split `val`."""
    told_split(told, tmp_path / "data", "val")
    return tmp_path / "data"


def test_confidences_follow_how_often_answers_are_right(told, data, tmp_path, monkeypatch):
    run = placed_run(tmp_path / "run")
    monkeypatch.setattr(room, "load_model", lambda *_: told_model(told))
    monkeypatch.setattr(answer, "RESAMPLES", 1)
    request = CalibrateRequest(
        checkpoint=str(run), data=data, mode="fast", picture=tmp_path / "r.png", device="cpu"
    )
    found, written = calibrate(request)
    assert [path.name for path in written] == ["checkpoint.calibration-fast.json", "r.png"]
    assert read_calibration(written[0], "0" * 64) == found
    assert found.samples == COUNT
    assert found.alignment is not None
    assert found.alignment.order == (0, 1)
    assert found.alignment.sign == (1.0,)
    assert found.alignment.zero[0] == pytest.approx(0, abs=1e-3)
    assert found.reliability["part"].base_rate == pytest.approx(0.75)
    assert found.reliability["part"].brier < 0.05  # a constant 0.75 would have 0.19
    assert sum(found.reliability["joint"].count) == COUNT
    with Image.open(tmp_path / "r.png") as image:
        assert image.width > 500
        assert len(set(image.convert("L").resize((60, 40)).tobytes())) > 5


def test_too_few_samples_are_refused(told, data, tmp_path, monkeypatch):
    run = placed_run(tmp_path / "run")
    monkeypatch.setattr(room, "load_model", lambda *_: told_model(told))
    request = CalibrateRequest(checkpoint=str(run), data=data, mode="fast", limit=10, device="cpu")
    with pytest.raises(StoreError, match="expected at least 20 samples, found 10"):
        calibrate(request)
    assert [path.name for path in run.iterdir()] == [WEIGHTS]


def test_clouds_in_another_frame_are_asked_with_the_place_of_their_camera(
    told, tmp_path, monkeypatch
):
    split = told_split(told, tmp_path / "plain", "val")
    place = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
    arrays = {**split.arrays(*TENSORS), "sensor": place}
    write_split(tmp_path / "data", "oven", "val", arrays)
    asked = []

    def noting(name, cloud, *words):
        asked.append(cloud.sensor)
        return answer.ask(name, cloud, *words)

    monkeypatch.setattr(room, "load_model", lambda *_: told_model(told))
    monkeypatch.setattr(room, "ask", noting)
    monkeypatch.setattr(answer, "RESAMPLES", 1)
    run = placed_run(tmp_path / "run")
    calibrate(CalibrateRequest(checkpoint=str(run), data=tmp_path / "data", device="cpu"))
    np.testing.assert_array_equal(asked, place)
