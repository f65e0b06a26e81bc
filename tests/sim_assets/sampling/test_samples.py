# SPDX-License-Identifier: MIT
"""The identities that labelled samples satisfy, alone and several objects together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from scapo.geometry.camera import Intrinsics
from scapo.geometry.rigid import joint_motion
from scapo.parallel.pool import Outcome
from sim_assets.generation import shard as shards
from sim_assets.generation.generate import Made, Running, _without
from sim_assets.generation.generate import generate as generate_split
from sim_assets.generation.ledger import GenerateError
from sim_assets.generation.plan import plan_shards
from sim_assets.generation.request import make_request, versions
from sim_assets.generation.shard import TOGETHER, ShardJob
from sim_assets.models.reader import find, read
from sim_assets.objects import ArticulatedObject
from sim_assets.options import DataOptions
from sim_assets.procedural import RECIPES, generate
from sim_assets.rendering.backends import make_renderer, resolve_backend
from sim_assets.rendering.base import AbstractParallelRenderer, Frame, RenderError, RenderRequest
from sim_assets.rendering.embree import RaycastRenderer
from sim_assets.sampling import samples
from sim_assets.sampling.samples import (
    Row,
    SampleMaker,
    Settings,
    ViewBatch,
    ViewError,
    geometry_digest,
    render_together,
    split_batches,
)
from tests.helpers.boxes import box, laptop

REAL = {
    "oven": "oven",
    "eyeglasses": "eyeglasses",
    "laptop": "laptop",
    "storage": "drawer",
    "scissors": "scissors",
}


@pytest.fixture(scope="module")
def settings() -> Settings:
    try:
        backend = resolve_backend("auto")
    except RenderError as error:
        pytest.skip(str(error))
    return Settings(
        protocol="joint",
        backend=backend,
        camera=Intrinsics.from_fov(np.radians(60), 256, 256),
        points=1024,
        sampling="random",
        color=False,
        states_per_view=1,
    )


def make(thing: ArticulatedObject, settings: Settings, count: int) -> tuple[list[Row], int]:
    """Samples, and how many views were drawn for them."""
    backend = None if settings.protocol == "full" else settings.backend
    renderer = None if backend is None else make_renderer(backend, color=settings.color)
    maker = SampleMaker(renderer, thing, settings)
    rendered = list(maker.render_views([("samples", thing.instance, i) for i in range(count)]))
    return [row for view in rendered for row in view.rows], sum(view.draws for view in rendered)


def distances(thing: ArticulatedObject, row: Row) -> np.ndarray:
    """Of each point from the surface of its own part, mapped back by its pose, m."""
    found = []
    for part in range(len(thing.visuals)):
        pose = row["camera_T_part"][part].astype(np.float64)
        points = row["points"][row["part"] == part].astype(np.float64)
        back = (points - pose[:3, 3]) @ pose[:3, :3]
        mesh = thing.part_mesh(part)
        found.append(trimesh.proximity.closest_point(mesh, back)[1])
    return np.concatenate(found)


def check_rows(thing: ArticulatedObject, rows: list[Row], *, surfaces: int) -> None:
    """All identities of the layout; distances for the first few rows, which are slow."""
    size = float(np.linalg.norm(thing.extents()))
    for number, row in enumerate(rows):
        pose = torch.from_numpy(row["camera_T_part"].astype(np.float64))
        for j, joint in enumerate(thing.category.joints):
            pivot, axis, state = (
                torch.from_numpy(row[name][j].astype(np.float64)[...])
                for name in ("joint_pivot", "joint_axis", "joint_state")
            )
            moved = joint_motion(pivot, axis, state, joint.kind) @ pose[joint.parent]
            assert (moved - pose[joint.child]).abs().max() < 1e-5
            pivot, axis = torch.from_numpy(thing.pivot[j]), torch.from_numpy(thing.axis[j])
            parent = pose[joint.parent] @ joint_motion(pivot, axis, state, joint.kind)
            assert (parent - pose[joint.child]).abs().max() < 1e-5
            assert 0.15 <= row["joint_state"][j] / thing.upper[j] <= 0.95 + 1e-6
            assert np.linalg.norm(row["joint_axis"][j]) == pytest.approx(1, abs=1e-6)
        count = np.bincount(row["part"], minlength=len(thing.visuals))
        assert count.min() >= 16
        assert row["part"].max() < len(thing.visuals)
        assert (row["points"][:, 2] > 0).all()
        assert (row["visible"] >= 0).all()
        assert (row["visible"] <= 1).all()
        if number < surfaces:
            assert np.percentile(distances(thing, row), 99) <= 1e-3 * size


@pytest.mark.parametrize("name", RECIPES)
def test_identities_of_procedural_samples(name, settings):
    draws = 0
    for index in range(4):
        thing = generate(name, "train", 5, index)
        rows, drawn = make(thing, settings, 16)
        draws += drawn
        check_rows(thing, rows, surfaces=2)
    print(f"{name}: {100 * (draws - 64) / draws:.1f} % of the views redrawn")  # noqa: T201


@pytest.mark.parametrize("folder", REAL)
def test_identities_of_real_samples(folder, shared_dir, settings):
    root = shared_dir / "assets" / folder
    urdfs = find(root)[:3]
    for urdf in urdfs:
        thing = read(urdf, REAL[folder], root=root)
        rows, _ = make(thing, settings, 64 // len(urdfs))
        check_rows(thing, rows, surfaces=1)


def test_isolated_parts_do_not_hide_each_other(settings):
    thing = laptop()
    joint, _ = make(thing, settings, 32)
    isolated, _ = make(thing, replace(settings, protocol="isolated"), 32)
    check_rows(thing, isolated, surfaces=1)
    pairs = [
        (a["visible"], b["visible"])
        for a, b in zip(joint, isolated, strict=True)
        if np.array_equal(a["joint_state"], b["joint_state"])
    ]
    assert len(pairs) > 20
    assert all((b >= a - 0.01).all() for a, b in pairs)
    assert max((b - a).max() for a, b in pairs) > 0.1


def test_full_clouds_cover_both_sides(settings):
    thing = laptop()
    rows, draws = make(thing, replace(settings, protocol="full", color=True), 4)
    assert draws == 4
    check_rows(thing, rows, surfaces=2)
    row = rows[0]
    assert (row["visible"] == 1).all()
    assert row["color"].shape == (1024, 3)
    pose = row["camera_T_part"][0].astype(float)
    back = (row["points"][row["part"] == 0] - pose[:3, 3]) @ pose[:3, :3]
    assert abs((back[:, 2] > -0.01).mean() - 0.5) < 0.1  # top and underside alike


def test_states_per_view_share_the_camera(settings):
    thing = laptop()
    rows, _ = make(thing, replace(settings, states_per_view=3), 2)
    assert len(rows) == 6
    for first in (0, 3):
        for row in rows[first + 1 : first + 3]:
            assert np.array_equal(row["camera_T_part"][0], rows[first]["camera_T_part"][0])
            assert not np.array_equal(row["joint_state"], rows[first]["joint_state"])


def test_colours_and_other_numbers_of_points(settings):
    thing = generate("laptop", "val", 5, 0)
    wanted = replace(settings, points=300, sampling="fps", color=True)
    rows, _ = make(thing, wanted, 2)
    assert rows[0]["points"].shape == (300, 3)
    assert rows[0]["color"].shape == (300, 3)
    assert rows[0]["color"].dtype == np.uint8
    assert len(np.unique(rows[0]["points"], axis=0)) == 300


def test_a_view_depends_on_its_own_key_alone(settings):
    thing = laptop()
    many, _ = make(thing, settings, 5)
    assert settings.backend is not None
    with make_renderer(settings.backend) as renderer:
        maker = SampleMaker(renderer, thing, settings)
        (alone,) = maker.render_views([("samples", thing.instance, 3)])
    for name, array in alone.rows[0].items():
        assert np.array_equal(array, many[3][name]), name


def test_views_that_show_too_little_of_a_part_are_drawn_again(settings):
    thing = laptop()
    # A small knob at the base's back edge is hidden from the front at many states.
    knob = box((0.03, 0.03, 0.03), (0.125, 0.0, -0.03))
    hidden = replace(thing, instance="knob", visuals=((knob,), thing.visuals[1]))
    rows, draws = make(hidden, settings, 12)
    assert draws > 12
    assert all((row["part"] == 0).sum() >= 16 for row in rows)


def test_objects_that_cannot_be_shown_are_named(settings, monkeypatch):
    monkeypatch.setattr(samples, "MAX_DRAWS", 3)
    thing = laptop()
    speck = box((1e-4, 1e-4, 1e-4), (0, 0, -0.01))
    hidden = replace(thing, instance="speck", visuals=((speck,), thing.visuals[1]))
    with pytest.raises(ViewError, match=r"speck: expected a view with .* found none in 3 draws"):
        make(hidden, settings, 1)


def test_the_geometry_digest_sees_micrometres_and_nothing_less():
    thing = laptop()
    assert geometry_digest(thing) == geometry_digest(laptop("another name"))
    for step, same in ((1e-8, True), (1e-5, False)):
        moved = replace(thing, pivot=thing.pivot + step)
        assert (geometry_digest(moved) == geometry_digest(thing)) is same


class RaycastSubScenes(AbstractParallelRenderer):
    """A ray caster in each sub-scene."""

    def __init__(self, capacity: int = 3) -> None:
        self.capacity = capacity
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

    def render_all(self, requests: Sequence[RenderRequest | None]) -> list[Frame | None]:
        assert len(requests) == len(self.casters)
        self.rounds += 1
        return [
            None
            if request is None
            else caster.render(request.state, request.camera_T_object, request.camera, request.only)
            for caster, request in zip(self.casters, requests, strict=True)
        ]

    def close(self) -> None:
        self.casters = []


def data_options(**given) -> DataOptions:
    usual = {"count": 24, "instances": 4, "points": 128, "image_size": 96, "backend": "raycast"}
    return DataOptions(**{**usual, **given})


def make_split(folder: Path, category: str, asked: DataOptions, **changes) -> Made:
    request, assets = make_request(category, asked)
    found = versions(request.settings.backend)
    return generate_split(request, assets, folder, found, replace(Running(workers=0), **changes))


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def use(monkeypatch, renderer: RaycastSubScenes) -> RaycastSubScenes:
    monkeypatch.setattr(shards, "_renderer", lambda backend, color: renderer)
    return renderer


@pytest.mark.parametrize(
    ("category", "given"),
    [
        ("laptop", {}),
        ("eyeglasses", {"protocol": "isolated", "noise": "disparity"}),
        ("drawer", {"states_per_view": 2, "count": 12}),
    ],
    ids=["joint", "isolated", "states"],
)
def test_the_bytes_are_those_of_one_after_the_other(category, given, tmp_path, monkeypatch):
    asked = data_options(**given)
    alone = make_split(tmp_path / "alone", category, asked)
    renderer = use(monkeypatch, RaycastSubScenes())
    together = make_split(tmp_path / "together", category, asked)
    assert max(renderer.shown) == 3
    assert content(together.folder) == content(alone.folder)


def maker(index: int = 0, **given) -> tuple[SampleMaker, list[tuple[object, ...]]]:
    request, assets = make_request("laptop", data_options(**given))
    return SampleMaker(None, assets[index].load(), request.settings), [
        request.key(i) for i in range(7)
    ]


def test_views_are_split_among_the_sub_scenes():
    a, b = maker(0), maker(1)
    groups = split_batches([a, (b[0], b[1][:2])], 3)
    assert [[len(batch.keys) for batch in group] for group in groups] == [[3, 3, 1], [2]]
    assert [key for batch in groups[0] for key in batch.keys] == a[1]
    assert [len(batch.keys) for batch in split_batches([a], 100)[0]] == [1] * 7


def test_more_batches_than_sub_scenes_and_a_batch_that_fails():
    renderer = RaycastSubScenes(2)
    good, keys = maker()
    bad, _ = maker(1)
    bad.least = 10**6  # no view is good
    batches = [
        ViewBatch(maker=good, keys=keys[:2]),
        ViewBatch(maker=bad, keys=keys[:1]),
        ViewBatch(maker=good, keys=keys[2:3]),
    ]
    ended: list[ViewBatch] = []
    render_together(renderer, batches, ended.append)
    assert renderer.shown == [2, 1]
    assert batches[1].error is not None
    assert "found none in 100 draws" in str(batches[1].error)
    assert [len(batch.rendered) for batch in batches] == [2, 0, 1]
    assert batches[0] in ended
    with RaycastRenderer() as caster:
        alone = SampleMaker(caster, good.thing, good.settings)
        expected = list(alone.render_views(keys[:3]))
    for view, other in zip(expected, batches[0].rendered + batches[2].rendered, strict=True):
        assert view.draws == other.draws
        assert np.array_equal(view.rows[0]["points"], other.rows[0]["points"])


def test_objects_that_break_the_renderer_together_are_shown_one_by_one(tmp_path, monkeypatch):
    alone = make_split(tmp_path / "alone", "laptop", data_options())
    renderer = use(monkeypatch, RaycastSubScenes())
    renderer.broken = 2
    done: list[int] = []
    again = make_split(
        tmp_path / "again", "laptop", data_options(), progress=lambda what, n, total: done.append(n)
    )
    assert content(again.folder) == content(alone.folder)
    assert done[-1] == 24
    renderer.broken = 1
    with pytest.raises(GenerateError, match="expected fewer than 1 objects, found 1"):
        make_split(tmp_path / "none", "laptop", data_options(), strict=True)


def test_when_several_objects_killed_a_worker_each_is_tried_apart(tmp_path, monkeypatch):
    request, assets = make_request("laptop", data_options())
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
    renderer = use(monkeypatch, RaycastSubScenes())
    labels: list[str] = []
    shards.render_shard(again, lambda label, amount: labels.append(label))
    assert TOGETHER not in labels
    assert set(labels) == {asset.name for asset in assets}
    assert max(renderer.shown) == 3
    named = replace(died, job=again, label=assets[1].name)
    assert _without(named, strict=False).skip == {assets[1].name: "its process ..."}


def test_complete_samples_are_turned_by_any_rotation():
    """Uniform over all: each entry of the rotation is uniform in [-1, 1] (Archimedes), and the
    object stays where the view has it."""
    from sim_assets.sampling.viewpoints import generator, rotation

    turns = np.stack([rotation(None, generator("turn", k).spawn(1)[0]) for k in range(4000)])
    entries = np.sort(turns.reshape(len(turns), 9), axis=0)
    expected = np.linspace(-1, 1, len(turns))[:, None]
    assert np.abs(entries - expected).max() < 0.06  # Kolmogorov-Smirnov, 1.9 sqrt(1 / n) * 2
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    again = rotation(None, generator("turn", 0).spawn(1)[0])
    np.testing.assert_array_equal(turns[0], again)
