# SPDX-License-Identifier: MIT
"""Which sample shows which object, and how samples are cut into shards."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scapo.categories import CATEGORIES
from scapo.geometry.camera import Intrinsics
from scapo.store.manifest import MAX_POINTS
from sim_assets.generation.assets import ProceduralAsset
from sim_assets.generation.plan import (
    SHARD_SAMPLES,
    Entry,
    Request,
    instance_record,
    plan_digest,
    plan_shards,
    samples_per_instance,
    used_instances,
)
from sim_assets.sampling.samples import Settings
from tests.helpers.boxes import laptop


def request(count: int, states: int = 1, **changes) -> Request:
    settings = Settings(
        protocol="joint",
        backend="raycast",
        camera=Intrinsics.from_fov(1.0, 64, 64),
        points=128,
        sampling="random",
        color=False,
        states_per_view=states,
    )
    fields = {
        "kind": CATEGORIES["laptop"],
        "split": "train",
        "seed": 1,
        "count": count,
        "instances": 1,
        "source": "procedural",
        "source_options": {},
        "settings": settings,
        **changes,
    }
    return Request(**fields)


def entries(count: int) -> list[Entry]:
    return [
        Entry(
            asset=ProceduralAsset(category="laptop", split="train", seed=1, index=i),
            instance=instance_record(laptop(f"object {i}")),
            geometry=f"{i:064d}",
        )
        for i in range(count)
    ]


@given(st.integers(1, 700), st.integers(1, 60), st.sampled_from([1, 2, 5]))
def test_shards_hold_every_sample_once_in_order(views, instances, states):
    wanted = request(views * states, states)
    instances = min(instances, views)
    each = samples_per_instance(wanted, instances)
    used = used_instances(wanted, instances)
    assert used == instances  # none goes without
    shards = plan_shards(wanted, entries(used), instances)
    sample = 0
    for number, shard in enumerate(shards):
        assert shard.number == number
        assert shard.file == f"{number:05d}.safetensors"
        assert shard.first == sample
        assert shard.count <= 2 * SHARD_SAMPLES + states
        for piece in shard.pieces:
            for view in range(piece.first, piece.first + piece.views):
                assert view * states == sample
                assert piece.index == sample // each % used
                sample += states
        assert sample == shard.first + shard.count
    assert sample == wanted.count
    assert {piece.index for shard in shards for piece in shard.pieces} == set(range(used))


@pytest.mark.parametrize(
    ("views", "instances", "each", "shown"),
    [(640, 13, 50, [50] * 12 + [40]), (22, 10, 2, [4, *[2] * 9]), (7, 4, 2, [2, 2, 2, 1]),
     (1000, 97, 10, [20] * 3 + [10] * 94), (3, 5, 1, [1, 1, 1])],
)  # fmt: skip
def test_no_object_goes_without_samples(views, instances, each, shown):
    wanted = request(views)
    used = used_instances(wanted, instances)
    assert samples_per_instance(wanted, instances) == each
    found = [0] * used
    for shard in plan_shards(wanted, entries(used), instances):
        for piece in shard.pieces:
            found[piece.index] += piece.views
    assert found == shown


def test_whole_instances_share_a_shard_where_they_fit():
    shards = plan_shards(request(100), entries(10), 10)
    assert [shard.count for shard in shards] == [60, 40]
    assert [len(shard.pieces) for shard in shards] == [6, 4]
    assert [shard.count for shard in plan_shards(request(100), entries(2), 2)] == [50, 50]
    assert [shard.count for shard in plan_shards(request(300), entries(1), 1)] == [64] * 4 + [44]


@pytest.mark.parametrize(("points", "states"), [(300_000, 1), (300_000, 5), (2**24, 1)])
def test_shards_of_many_points_are_no_larger_than_a_reader_takes(points, states):
    wanted = request(60, states)
    wanted = replace(wanted, settings=replace(wanted.settings, points=points))
    shards = plan_shards(wanted, entries(2), 2)
    assert sum(shard.count for shard in shards) == 60
    assert all(shard.count * points <= MAX_POINTS for shard in shards)
    assert all(shard.count % states == 0 for shard in shards)


def test_options_hold_all_that_changes_pixels():
    options = request(10, source_options={"up": "-y"}).options()
    assert options["points"] == 128
    assert options["protocol"] == "joint"
    assert options["noise"] == "none"
    assert options["backend"] == "raycast"
    assert options["camera"]["width"] == 64
    assert options["up"] == "-y"


def test_keys_tell_views_splits_seeds_and_sources_apart():
    keys = {
        request(1).key(0),
        request(1).key(1),
        request(1, split="val").key(0),
        request(1, seed=2).key(0),
        request(1, source="urdf").key(0),
        request(1, kind=CATEGORIES["oven"]).key(0),
    }
    assert len(keys) == 6
    assert request(1).key(0) == request(500).key(0)


def test_the_plan_digest_depends_on_objects_and_views():
    base = plan_digest(entries(2), ["a", "b"])
    assert base == plan_digest(entries(2), ["a", "b"])
    assert base != plan_digest(entries(2), ["a", "c"])
    assert base != plan_digest(entries(3), ["a", "b"])


def test_the_instance_record_is_the_objects_origin():
    record = instance_record(laptop("a name"))
    assert record.id == "a name"
    assert record.object_T_asset[2] == (0.0, 0.0, 1.0, 0.0)
    assert record.joint_names == ("hinge",)
    with pytest.raises(AttributeError):
        record.id = "b"  # type: ignore[misc]
