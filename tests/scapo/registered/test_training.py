# SPDX-License-Identifier: MIT
"""The whole training of template registration, on a few views: it repeats, resumes and predicts."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest
import torch

from scapo.categories import CATEGORIES
from scapo.method import Journal
from scapo.predictor import load
from scapo.registered import base, discovery
from scapo.registered import method as room
from scapo.registered.config import DiscoveryConfig, RegisteredConfig
from scapo.registered.discovery import Discovery, discover
from scapo.registered.method import TemplateRegistration
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import SearchResult
from scapo.registered.template import ArticulatedTemplate
from scapo.store.samples import TrainingData
from scapo.training import fit
from scapo.training.journal import StoredJournal
from scapo.types import Labels, Observation
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator
from tests.helpers.two_ranks import StoppedError
from tests.scapo.training.test_fit import same

DISCOVERY = DiscoveryConfig(
    seeds=12, rotations=200, searched=12, trusted=(0.9,), starts=3, draws=1, heats=(), judged=4,
    mirror=False, halves=False, template_points=120, final_points=240,
)  # fmt: skip
"""Mirror images, half of the time: `test_discovery`."""


CONFIG = RegisteredConfig(
    discovery=DISCOVERY,
    learned=20,
    placed=20,
    epochs=2,
    points=128,
    channels=4,
    batch=8,
    grid_hypotheses=16,
)


RUN = fit.FitConfig(log_every=1, checkpoint_every=0.0, pictures_every=None)


def clouds(count: int) -> Observation:
    """Views of a box with a flap, the camera at the origin."""
    views, _ = sighted(count, seed=80)
    return Observation(points=views.points - views.camera[:, None])


def method(config: RegisteredConfig = CONFIG) -> TemplateRegistration:
    return TemplateRegistration(config, CATEGORIES["oven"], generator(0))


def test_a_template_at_hand_is_learned_stored_and_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of a training but the discovery, in place of which the truth is; a kill in between."""
    _, truth = sighted(10, seed=80)
    none = torch.zeros(10)
    made = Discovery(
        template=template(count=240),
        found=SearchResult(placement=truth, loss=none, margin=none),
        scorer=OrientationScorer(),
    )
    monkeypatch.setattr(room, "discover", lambda *_: made)
    data = TrainingData(observation=clouds(10), labels=Labels(), digest="here")
    config = replace(CONFIG, learned=10, placed=10)

    def stopping(progress: fit.Progress) -> None:
        if (progress.stage.name, progress.epoch) == ("round-2", 1):
            raise StoppedError

    fit.fit(method(config), data, tmp_path / "whole", RUN)
    with pytest.raises(StoppedError):
        fit.fit(method(config), data, tmp_path / "cut", RUN, listener=stopping)
    fit.fit(method(config), data, tmp_path / "cut", RUN, resume=True)
    same(tmp_path / "whole", tmp_path / "cut")
    learned = load(tmp_path / "whole")
    one = learned.predict(data.observation.points[0], "refine")
    assert one.part_weight.shape == (data.observation.points.shape[1], 2)
    assert isinstance(learned.model, TemplateRegistration)
    assert torch.equal(learned.model.template.points, made.template.points)
    kept = learned.model.pseudo.placement().rotation
    assert all(bool((row == truth.rotation).all((1, 2)).any()) for row in kept)


@pytest.mark.slow
def test_a_template_is_found_learned_and_stored(tmp_path: Path) -> None:
    data = TrainingData(observation=clouds(20), labels=Labels(), digest="here")

    def listener(progress: fit.Progress) -> None:
        """What a kill after the first epoch would leave."""
        if progress.epoch == 1 and not (tmp_path / "cut").exists():
            shutil.copytree(tmp_path / "whole", tmp_path / "cut")

    fit.fit(method(), data, tmp_path / "whole", RUN, listener=listener)
    found = load(tmp_path / "whole")
    assert isinstance(found.model, TemplateRegistration)
    template = found.model.template
    assert (template.logit.argmax(-1) == 1).float().mean() > 0.1
    assert found.model.pseudo.rotation.shape == (20, 3, 3)
    one = found.predict(data.observation.points[0], "refine")
    assert one.part_weight.shape == (data.observation.points.shape[1], 2)
    fit.fit(method(), data, tmp_path / "cut", RUN, resume=True)
    same(tmp_path / "whole", tmp_path / "cut")


@pytest.mark.slow
def test_the_same_views_give_the_same_template_interrupted_or_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of few views, which tell no joint: the steps are those of a discovery, and real."""

    def interrupted(*_: object) -> NoReturn:
        raise StoppedError

    def found(journal: Journal) -> Discovery:
        return discover(
            views, ArticulatedTemplate(("revolute",)), few, generator(3), journal=journal
        )

    def stored() -> StoredJournal:
        return StoredJournal(tmp_path, {}, "votes", lambda *_: None)

    few = replace(DISCOVERY, seeds=6, searched=8, judged=2, starts=1, leans=False,
                  template_points=60, final_points=80)  # fmt: skip
    views, _ = sighted(10, seed=80)
    one = found(Journal())
    with monkeypatch.context() as patch:
        patch.setattr(discovery, "densified", interrupted)
        with pytest.raises(StoppedError):
            found(stored())
    for step in ("common_frame", "fitted_proposals", "advance", "_advance_alone"):
        monkeypatch.setattr(discovery, step, interrupted)  # none of them is done again
    other = found(stored())
    for name, value in one.template.state_dict().items():
        assert torch.equal(value, other.template.state_dict()[name]), name
    assert torch.equal(one.found.loss, other.found.loss)


def test_too_few_clouds_are_refused() -> None:
    made = method(replace(CONFIG, learned=7))
    with pytest.raises(ValueError, match="training data: expected at least 8 clouds, found 5"):
        made.start("votes", clouds(5), Labels(), torch.Generator().manual_seed(0))


TOLD = replace(CONFIG, learned=10, placed=10, epochs=1, supervision=("instance",))


@pytest.fixture
def first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TrainingData:
    """What a run in `first` was trained on, in place of whose discovery the truth is."""
    _, truth = sighted(10, seed=80)
    none = torch.zeros(10)
    found = SearchResult(placement=truth, loss=none, margin=none)
    made = Discovery(template=template(count=240), found=found, scorer=OrientationScorer())
    monkeypatch.setattr(room, "discover", lambda *_: made)
    data = TrainingData(observation=clouds(10), labels=Labels(), digest="here")
    fit.fit(method(TOLD), data, tmp_path / "first", RUN)
    monkeypatch.setattr(room, "discover", None)  # it is not found again
    return data


@pytest.mark.slow
def test_clouds_are_placed_by_several_processes_as_by_one(
    first: TrainingData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In both rounds, the second with the network of the first."""
    monkeypatch.setattr(base, "KEPT", 4)
    begun = replace(TOLD, start=str(tmp_path / "first"))
    for workers in (0, 2):
        config = replace(RUN, workers=workers)
        fit.fit(method(begun), first, tmp_path / str(workers), config)
    same(tmp_path / "0", tmp_path / "2")


def test_a_run_begins_at_another_ones_template_and_refuses_what_does_not_fit(
    first: TrainingData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = replace(TOLD, start=str(tmp_path / "first"))
    fit.fit(method(begun), first, tmp_path / "second", RUN)
    second, other = load(tmp_path / "second").model, load(tmp_path / "first").model
    assert isinstance(second, TemplateRegistration)
    assert isinstance(other, TemplateRegistration)
    assert torch.equal(second.template.points, other.template.points)
    for channels, learned in ((begun.channels, True), (begun.channels // 2, False)):
        another = method(replace(begun, channels=channels))
        monkeypatch.setattr(another, "_place", lambda *_: None)
        another.start("votes", clouds(10), Labels(), torch.Generator())
        assert bool(another.network.learned) == learned  # it places with what it was taught
        weights, known = another.network.state_dict(), other.network.state_dict()
        assert all(torch.equal(weights[name], known[name]) for name in known) or not learned
    g = torch.Generator()
    with pytest.raises(ValueError, match="was told instance; add --supervision instance"):
        method(replace(begun, supervision=())).start("votes", clouds(10), Labels(), g)
    larger = replace(begun, discovery=replace(DISCOVERY, final_points=300))
    with pytest.raises(ValueError, match=r"found one of 240 .* add --discovery\.final-points 240"):
        method(larger).start("votes", clouds(10), Labels(), g)


@pytest.mark.slow
def test_hinges_alone_are_taught_to_a_network_that_is_there(
    first: TrainingData, tmp_path: Path
) -> None:
    begun = replace(TOLD, start=str(tmp_path / "first"), teach="hinges", rounds=1)
    told = replace(first, labels=Labels(instance=torch.zeros(10, dtype=torch.long)))
    fit.fit(method(begun), told, tmp_path / "second", RUN)
    before, after = (load(tmp_path / name).model for name in ("first", "second"))
    assert isinstance(after, TemplateRegistration)
    weights, taught = before.state_dict(), after.state_dict()
    changed = {
        name
        for name, value in taught.items()
        if name.startswith("network") and not torch.equal(value, weights[name])
    }
    assert changed == {"network.hinge.weight", "network.hinge.bias", "network.hinged"}
    found = [model.predict(first.observation, "quick") for model in (before, after)]
    assert all(one.joints is not None for one in found)
    assert torch.equal(found[0].part_weight, found[1].part_weight)
    pivots = [one.joints.pivot for one in found if one.joints is not None]
    assert (pivots[0] - pivots[1]).abs().max() > 1e-4
    laptop = TemplateRegistration(begun, CATEGORIES["laptop"], generator(0))
    laptop.template, laptop.targets = after.template, after.targets
    assert len(laptop.targets.hinge) == 10
    with pytest.raises(ValueError, match="objects with a hinge and several views, found none"):
        laptop._hang(told.observation.points, told.labels)
    assert laptop.network.hinged == 0
    alone = replace(told, labels=Labels(instance=torch.arange(10)))
    with pytest.raises(ValueError, match="objects with a hinge and several views, found none"):
        fit.fit(method(begun), alone, tmp_path / "third", RUN)
    with pytest.raises(ValueError, match="expected a run whose network is one as here"):
        method(replace(begun, channels=2)).start(
            "votes", clouds(10), told.labels, torch.Generator()
        )
    with pytest.raises(ValueError, match="teach: expected start, supervision instance"):
        replace(TOLD, teach="hinges")
