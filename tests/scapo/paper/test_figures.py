# SPDX-License-Identifier: MIT
"""What SCAPO shows of its training, and that showing changes nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scapo.geometry.points import normalise
from scapo.store.checkpoint import WEIGHTS
from scapo.training import fit
from scapo.training import log as progress_pictures
from scapo.training.log import PICTURES, shown
from tests.helpers.tiny import tiny, tiny_data
from tests.helpers.two_ranks import CONFIG

NAMES = {
    "canonicalise-canonical.png",
    "canonicalise-reconstruction.png",
    "articulate-canonical.png",
    "articulate-template.png",
    "articulate-reconstruction.png",
}


def test_panels_hold_what_the_networks_say() -> None:
    model = tiny().eval()
    clouds = shown(tiny_data().observation, 4)
    with torch.no_grad():
        pictures = model.pictures(clouds, "articulate")
        prediction = model.predict(clouds)
    assert pictures.keys() == {"canonical", "template", "reconstruction"}
    points, _ = normalise(clouds.points)
    for panel, cloud, weight in zip(
        pictures["canonical"].panels, points, prediction.part_weight, strict=True
    ):
        assert panel.part is not None
        assert panel.axis is not None
        assert torch.equal(panel.part, weight.argmax(-1))
        assert torch.cdist(panel.points[:9], panel.points[:9]).allclose(
            torch.cdist(cloud[:9], cloud[:9]), atol=1e-4
        )
        assert panel.axis.norm(dim=-1).allclose(torch.ones(1))
    assert model.pictures(clouds, "canonicalise").keys() == {"canonical", "reconstruction"}


def test_the_same_clouds_are_shown_each_time() -> None:
    observation = tiny_data(24).observation
    assert torch.equal(shown(observation).points, observation.points[::4])
    assert len(shown(tiny_data(3).observation).points) == 3


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("drawn")
    fit.fit(tiny(), tiny_data(), folder, replace(CONFIG, pictures_every=0.0))
    return folder


def test_training_leaves_pictures(drawn: Path) -> None:
    assert {path.name for path in (drawn / PICTURES).iterdir()} == NAMES


def test_tensorboard_has_them(drawn: Path) -> None:
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = reader.EventAccumulator(str(drawn / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    tags = {f"{tag}.png" for tag in events.Tags()["images"]}
    assert tags == NAMES
    steps = [event.step for event in events.Images("canonicalise-canonical")]
    assert steps == [3, 6]  # every so often, here after each epoch, and at the end of the stage


def test_pictures_change_nothing(drawn: Path, tmp_path: Path) -> None:
    fit.fit(tiny(), tiny_data(), tmp_path, CONFIG)
    assert not (tmp_path / PICTURES).exists()
    assert (tmp_path / WEIGHTS).read_bytes() == (drawn / WEIGHTS).read_bytes()
    assert json.loads((tmp_path / "config.json").read_text())["method"] == "scapo"


def test_without_matplotlib_nothing_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress_pictures, "can_draw", lambda: False)
    fit.fit(tiny(), tiny_data(), tmp_path, replace(CONFIG, pictures_every=0.0))
    assert not (tmp_path / PICTURES).exists()
    assert (tmp_path / WEIGHTS).is_file()
