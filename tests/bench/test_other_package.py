# SPDX-License-Identifier: MIT
"""A package of one file and one line of metadata adds a method, from training to the table."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from bench.__main__ import main
from bench.scoring.score_files import read_scores
from scapo import registry
from scapo.predictor import load
from scapo.store.files import read, read_header
from scapo.store.predictions import read_prediction_header
from tests.helpers.small import hinged_data

FILE = '''
"""Parts by the colour of a point: a line through colour space, learned from labels."""
from dataclasses import dataclass

import torch
from torch import nn

from scapo.method import AbstractMethod, ParameterGroup, Sgd, Stage, StepDecay
from scapo.registry import Method
from scapo.types import Prediction


@dataclass(frozen=True)
class Config:
    epochs: int = 6
    lr: float = 2.0


class Colours(AbstractMethod):
    name = "colours"
    supervision = frozenset({"segmentation"})

    def __init__(self, config, category, generator):
        super().__init__()
        self.config, self.category = config, category
        self.line = nn.Linear(3, len(category.parts))
        nn.init.zeros_(self.line.weight)
        nn.init.zeros_(self.line.bias)

    @property
    def variant(self):
        return ""

    def stages(self):
        return (Stage(name="line", epochs=self.config.epochs, lr=self.config.lr, batch=4,
                      optimiser=Sgd(momentum=0.5), schedule=StepDecay(every=4, factor=0.1),
                      parameters=(ParameterGroup(module="line", weight_decay=0.0),),
                      validate_every=2),)

    def start(self, stage, observation, labels, generator):
        assert observation.color is not None and observation.sensor is not None

    def losses(self, observation, labels, step):
        assert labels.camera_T_part is None and labels.joints is None
        assert observation.sensor.shape == (len(step.index), 3)
        known = labels.part >= 0
        votes = self.line(observation.color)[known]
        return {"part": nn.functional.cross_entropy(votes, labels.part[known])}

    def predict(self, observation, mode="fast"):
        assert observation.sensor is not None
        return Prediction(part_weight=self.line(observation.color).softmax(-1).detach())


METHOD = Method(title="By colour", rank=5, maker=Colours, presets={"default": Config},
                supervision=("segmentation",))
'''
LINE = "[scapo.methods]\ncolours = by_colour:METHOD\n"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The file, and the line as installing the package would leave it."""
    folder = tmp_path / "installed"
    info = folder / "by_colour-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "by_colour.py").write_text(FILE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: by-colour\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(LINE)
    monkeypatch.syspath_prepend(folder)
    registry.external.cache_clear()
    yield folder
    registry.external.cache_clear()
    sys.modules.pop("by_colour", None)


def test_one_file_and_one_line_are_a_method(
    package: Path, tmp_path: Path, repository: Path
) -> None:
    data, run = hinged_data(tmp_path / "data", color=True), tmp_path / "run"
    words = ["train", "colours", "--category", "laptop", "--data", data, "--out", run]
    path = os.pathsep.join([str(package), str(repository)])
    done = subprocess.run(
        [sys.executable, "-m", "bench", *map(str, words), "--device", "cpu", "--lr", "3.0"],
        capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    header = read_header(run / "checkpoint.safetensors")
    assert header["method"] == "colours"
    assert header["config"] == {"epochs": 6, "lr": 3.0}
    assert header["supervision"] == ["segmentation"]
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    judged = [line["validation"] for line in lines if "validation" in line]
    assert len(judged) == 3
    assert judged[-1] < judged[0] < 0.7  # of log 2 = 0.69 for a guess

    out, scores = tmp_path / "test.safetensors", tmp_path / "scores" / "laptop.csv.gz"
    for verb in (
        ["predict", run, "--data", data, "--out", out, "--device", "cpu"],
        ["evaluate", "--predictions", out, "--data", data, "--out", scores],
        ["tables", "--scores", scores.parent, "--out", tmp_path / "tables"],
    ):
        main([str(word) for word in verb])
    assert read_prediction_header(out).supervision == ("segmentation",)
    (found,) = read_scores(scores)
    iou = [values.mean() for (metric, _), values in found.errors.items() if metric == "iou"]
    assert min(iou) > 0.9
    rows = (tmp_path / "tables" / "table1.md").read_text().splitlines()
    named = [row for row in rows if "By colour" in row or "ICP" in row]
    assert "By colour" in named[0]  # its rank is less than that of ICP

    weight = torch.from_numpy(read(out)[0]["part_weight"])
    arrays = read(data / "laptop" / "test" / "00000.safetensors")[0]
    color, centre = arrays["color"] / 255, torch.zeros(3)
    again = load(run).predict(arrays["points"], color=color, sensor=centre)
    torch.testing.assert_close(again.part_weight, weight)
    with pytest.raises(ValueError, match=r"color: expected the shape of points, \(5, 160, 3\)"):
        load(run).predict(arrays["points"], color=color[:, :3], sensor=centre)
