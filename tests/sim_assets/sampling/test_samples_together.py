# SPDX-License-Identifier: MIT
"""Samples of several objects at once are those of each alone; with ray casting in every place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scapo.parallel.pool import Outcome
from sim_assets.generation import shard as shards
from sim_assets.generation.generate import Made, Running, _without, generate
from sim_assets.generation.ledger import GenerateError
from sim_assets.generation.plan import plan_shards
from sim_assets.generation.request import make_request, versions
from sim_assets.generation.shard import TOGETHER, ShardJob
from sim_assets.objects import ArticulatedObject
from sim_assets.options import DataOptions
from sim_assets.rendering.base import AbstractParallelRenderer, Ask, Frame, RenderError
from sim_assets.rendering.embree import RaycastRenderer
from sim_assets.sampling.samples import Shooter, Take, divide, shoot_together


class Places(AbstractParallelRenderer):
    """A ray caster in each place."""

    def __init__(self, places: int = 3) -> None:
        self.places = places
        self.casters: list[RaycastRenderer] = []
        self.shown: list[int] = []
        """Objects of each `open_all`."""
        self.rounds = 0
        self.broken = 0
        """From how many objects on it fails; 0 for never."""

    def open(self, thing: ArticulatedObject) -> None:
        self.open_all([thing])

    def open_all(self, things: Sequence[ArticulatedObject]) -> None:
        names = {thing.instance for thing in things}
        self.shown.append(len(things))
        if self.broken and len(names) >= self.broken:
            raise RenderError(f"expected fewer than {self.broken} objects, found {len(names)}")
        self.casters = [RaycastRenderer() for _ in things]
        for caster, thing in zip(self.casters, things, strict=True):
            caster.open(thing)

    def render(self, state, camera_T_object, camera, only=None) -> Frame:
        return self.casters[0].render(state, camera_T_object, camera, only)

    def render_all(self, asks: Sequence[Ask | None]) -> list[Frame | None]:
        assert len(asks) == len(self.casters)
        self.rounds += 1
        return [
            None
            if ask is None
            else caster.render(ask.state, ask.camera_T_object, ask.camera, ask.only)
            for caster, ask in zip(self.casters, asks, strict=True)
        ]

    def close(self) -> None:
        self.casters = []


def options(**given) -> DataOptions:
    usual = {"count": 24, "instances": 4, "points": 128, "image_size": 96, "backend": "raycast"}
    return DataOptions(**{**usual, **given})


def make(folder: Path, category: str, asked: DataOptions, **changes) -> Made:
    request, assets = make_request(category, asked)
    found = versions(request.settings.backend)
    return generate(request, assets, folder, found, replace(Running(workers=0), **changes))


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def use(monkeypatch, renderer: Places) -> Places:
    monkeypatch.setattr(shards, "_renderer", lambda backend, color: renderer)
    return renderer


@pytest.mark.parametrize(
    ("category", "given"),
    [
        ("laptop", {}),
        ("eyeglasses", {"protocol": "isolated", "noise": "disparity"}),
        ("drawer", {"states_per_view": 2}),
    ],
    ids=["joint", "isolated", "states"],
)
def test_the_bytes_are_those_of_one_after_the_other(category, given, tmp_path, monkeypatch):
    asked = options(**given)
    alone = make(tmp_path / "alone", category, asked)
    places = use(monkeypatch, Places())
    together = make(tmp_path / "together", category, asked)
    assert max(places.shown) == 3
    assert content(together.folder) == content(alone.folder)


def shooter(index: int = 0, **given) -> tuple[Shooter, list[tuple[object, ...]]]:
    request, assets = make_request("laptop", options(**given))
    return Shooter(None, assets[index].load(), request.settings), [request.key(i) for i in range(7)]


def test_views_are_divided_among_the_places():
    a, b = shooter(0), shooter(1)
    groups = divide([a, (b[0], b[1][:2])], 3)
    assert [[len(take.keys) for take in group] for group in groups] == [[3, 3, 1], [2]]
    assert [key for take in groups[0] for key in take.keys] == a[1]
    assert [len(take.keys) for take in divide([a], 100)[0]] == [1] * 7


def test_more_takes_than_places_and_a_take_that_fails():
    places = Places(2)
    good, keys = shooter()
    bad, _ = shooter(1)
    bad.least = 10**6  # no view is good
    takes = [
        Take(shooter=good, keys=keys[:2]),
        Take(shooter=bad, keys=keys[:1]),
        Take(shooter=good, keys=keys[2:3]),
    ]
    ended: list[Take] = []
    shoot_together(places, takes, ended.append)
    assert places.shown == [2, 1]
    assert takes[1].error is not None
    assert "found none in 100 draws" in str(takes[1].error)
    assert [len(take.shots) for take in takes] == [2, 0, 1]
    assert takes[0] in ended
    with RaycastRenderer() as caster:
        alone = Shooter(caster, good.thing, good.settings)
        expected = list(alone.shots(keys[:3]))
    for shot, other in zip(expected, takes[0].shots + takes[2].shots, strict=True):
        assert shot.draws == other.draws
        assert np.array_equal(shot.rows[0]["points"], other.rows[0]["points"])


def test_objects_that_break_the_renderer_together_are_shown_one_by_one(tmp_path, monkeypatch):
    alone = make(tmp_path / "alone", "laptop", options())
    places = use(monkeypatch, Places())
    places.broken = 2
    done: list[int] = []
    again = make(
        tmp_path / "again", "laptop", options(), progress=lambda what, n, total: done.append(n)
    )
    assert content(again.folder) == content(alone.folder)
    assert done[-1] == 24
    places.broken = 1
    with pytest.raises(GenerateError, match="expected fewer than 1 objects, found 1"):
        make(tmp_path / "none", "laptop", options(), strict=True)


def test_when_several_objects_killed_a_worker_each_is_tried_apart(tmp_path, monkeypatch):
    request, assets = make_request("laptop", options())
    entries = [shards.describe(asset, lambda label, amount: None) for asset in assets]
    job = ShardJob(
        folder=tmp_path,
        request=request,
        plan=plan_shards(request, entries, 4)[0],
        options={},
        versions={},
        strict=False,
    )
    died = Outcome(job=job, result=None, failure="died", reason="its process ...", label=TOGETHER)
    again = _without(died, strict=False)
    assert again == replace(job, apart=True)
    places = use(monkeypatch, Places())
    labels: list[str] = []
    shards.render_shard(again, lambda label, amount: labels.append(label))
    assert TOGETHER not in labels
    assert set(labels) == {asset.name for asset in assets}
    assert max(places.shown) == 3
    named = replace(died, job=again, label=assets[1].name)
    assert _without(named, strict=False).skip == {assets[1].name: "its process ..."}
