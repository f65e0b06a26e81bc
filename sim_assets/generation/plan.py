# SPDX-License-Identifier: MIT
"""What a split will hold: objects, samples per object, shards; a function of the request alone.

Sample i shows instance (i // samples_per_instance) % instances. Its generator is seeded by source,
category, split, seed and view number, so neither workers nor interruptions nor shards change it.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from scapo.categories import Category
from scapo.store import canonical_json
from scapo.store.definitions import definition
from scapo.store.manifest import MAX_POINTS, Instance
from sim_assets.generation.assets import Asset
from sim_assets.models.account import sentences
from sim_assets.objects import ArticulatedObject
from sim_assets.sampling.ambiguity import CHOSEN as TOLERANCE
from sim_assets.sampling.samples import Settings

SHARD_SAMPLES = 64
"""Samples that a shard holds about, in whole instances where they fit: one job of a worker."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What is asked for, apart from where to put it."""

    kind: Category
    split: str
    seed: int
    count: int
    """Samples."""
    instances: int
    """Objects asked for."""
    source: str
    """`procedural`, or what kind of folder the models come from."""
    source_options: dict[str, Any]
    """How models are read: all that changes the objects."""
    settings: Settings

    @property
    def category(self) -> str:
        """Its name."""
        return self.kind.name

    def options(self) -> dict[str, Any]:
        """All that changes pixels, for the manifest."""
        settings = asdict(self.settings)
        camera = settings.pop("camera")
        settings.pop("held_out")  # said by the split
        settings.pop("images")  # beside the shards, whose bytes are the same without them
        for name, usual in (("preset", "sim-art"), ("mask", "exact"), ("ambiguity", False)):
            if settings[name] == usual:
                settings.pop(name)
        if self.settings.ambiguity:
            settings["ambiguity"] = asdict(TOLERANCE)
        return {
            **settings,
            "camera": camera,
            "source": self.source,
            "instances": self.instances,
            **self.source_options,
            **definition(self.kind),
        }

    def key(self, view: int) -> tuple[object, ...]:
        """The seed of a view's generator."""
        return (self.source, self.category, self.split, self.seed, view)


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One object of the plan."""

    asset: Asset
    instance: Instance
    geometry: str
    """SHA-256 of surfaces and joints in whole micrometres (`samples.geometry_digest`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """Consecutive views of one object; an object may have several."""

    entry: Entry
    index: int
    """Of the instance in the manifest."""
    first: int
    """View number."""
    views: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardPlan:
    """What one shard holds."""

    number: int
    first: int
    """Sample number."""
    count: int
    pieces: tuple[Piece, ...]

    @property
    def file(self) -> str:
        """Its name."""
        return f"{self.number:05d}.safetensors"


def samples_per_instance(request: Request, instances: int) -> int:
    """Consecutive samples of an instance: count / instances in whole views.

    Rounded up, so that the last has fewer; where that would leave some without any, rounded down,
    and the first ones come again.
    """
    states = request.settings.states_per_view
    views = request.count // states
    each = math.ceil(views / instances)
    if math.ceil(views / each) < instances:
        each = max(1, views // instances)
    return each * states


def used_instances(request: Request, instances: int) -> int:
    """How many of the instances get samples: all, unless they are more than the views."""
    return min(instances, request.count // request.settings.states_per_view)


def plan_shards(request: Request, entries: Sequence[Entry], instances: int) -> list[ShardPlan]:
    """Cut the samples into shards of about SHARD_SAMPLES, at instance boundaries if possible.

    Args:
        request: What is asked for.
        entries: The objects that get samples.
        instances: Number of instances asked for, which fixes samples_per_instance.
    """
    states = request.settings.states_per_view
    each = samples_per_instance(request, instances)
    size = max(1, round(SHARD_SAMPLES / each)) * each
    if each > 2 * SHARD_SAMPLES:
        size = math.ceil(SHARD_SAMPLES / states) * states
    most = MAX_POINTS // (request.settings.points * states) * states  # that a reader takes
    if size > most:
        size = most // each * each or most
    shards = []
    for number, first in enumerate(range(0, request.count, size)):
        last = min(first + size, request.count)
        pieces = []
        for run in range(first // each, (last - 1) // each + 1):
            low, high = max(first, run * each), min(last, (run + 1) * each)
            index = run % len(entries)
            piece = Piece(
                entry=entries[index],
                index=index,
                first=low // states,
                views=(high - low) // states,
            )
            pieces.append(piece)
        shards.append(
            ShardPlan(number=number, first=first, count=last - first, pieces=tuple(pieces))
        )
    return shards


def instance_record(thing: ArticulatedObject) -> Instance:
    """The manifest's record of an object."""
    origin = thing.origin
    rows = tuple(tuple(float(x) for x in row) for row in origin.object_T_asset)
    return Instance(
        id=thing.instance,
        source=origin.source,
        sha256=origin.sha256,
        object_T_asset=rows,
        rest=dict(origin.rest),
        joint_names=origin.joint_names,
        sign=origin.sign,
        trait=thing.trait,
        account=sentences(thing),
    )


def plan_digest(entries: Sequence[Entry], shard_plans: Sequence[str]) -> str:
    """SHA-256 over instances, their surfaces, and the first-drawn states and cameras.

    Args:
        entries: The objects in order.
        shard_plans: Per shard, the SHA-256 of its views' states and cameras.
    """
    objects = [[entry.instance.id, entry.geometry] for entry in entries]
    return hashlib.sha256(canonical_json([objects, list(shard_plans)]).encode()).hexdigest()
