# SPDX-License-Identifier: MIT
"""Which model answers: a run's, a category's, or all that were released."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.infer import model as models
from bench.infer.model import load_model, load_models
from scapo.store.checkpoint import WEIGHTS
from scapo.store.files import sha256_file
from scapo.store.schema import StoreError
from scapo.text import UsageError
from tests.helpers.placed import placed_run


def test_a_run_names_itself(tmp_path):
    run = placed_run(tmp_path / "my-oven")
    for what in (run, run / WEIGHTS):
        (found,) = load_models(what, None, "cpu", "fast")
        assert found.name == "my-oven"
        assert found.method == "registered"
        assert found.category.name == "oven"
        assert found.digest == sha256_file(run / WEIGHTS)
        assert found.calibration is None
        assert not found.predictor.in_object_frame


def test_released_models_answer_by_category(tmp_path, monkeypatch):
    weights = {name: placed_run(tmp_path / name, name) / WEIGHTS for name in ("oven", "safe")}
    renamed = {name: path.rename(tmp_path / f"{name}.safetensors")
               for name, path in weights.items()}  # fmt: skip
    monkeypatch.setattr(models, "released", lambda: renamed)
    assert [m.name for m in load_models(None, None, "cpu", "fast")] == ["oven", "safe"]
    (found,) = load_models(None, "safe", "cpu", "fast")
    assert found.category.name == "safe"
    with pytest.raises(UsageError, match="--category laptop: expected one of oven, safe; a run"):
        load_models(None, "laptop", "cpu", "fast")
    with pytest.raises(UsageError, match=r"--run RUN; did you mean 'oven'\?$"):
        load_models(None, "oevn", "cpu", "fast")
    with pytest.raises(UsageError, match="expected one of the two or none, found both"):
        load_models(Path("a"), "oven", "cpu", "fast")


def test_without_released_models_a_run_is_asked_for(monkeypatch):
    monkeypatch.setattr(models, "released", dict)
    with pytest.raises(UsageError, match="no model is released yet; a run of your own"):
        load_models(None, "oven", "cpu", "fast")
    with pytest.raises(StoreError, match="found none yet: give one of your own with --run RUN"):
        load_models(None, None, "cpu", "fast")


def test_a_calibration_of_another_checkpoint_is_refused(tmp_path):
    run = placed_run(tmp_path)
    (run / "checkpoint.calibration-fast.json").write_text("{}")
    with pytest.raises(StoreError, match=r"calibration-fast\.json: expected scapo-calibration/2"):
        load_model(run, "cpu", "fast")
    assert load_model(run, "cpu", "quick").calibration is None
    assert load_model(run, "cpu", None).calibration is None
