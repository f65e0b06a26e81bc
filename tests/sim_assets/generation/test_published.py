# SPDX-License-Identifier: MIT
"""The published record of `sim-art/2` holds what docs/benchmark.md promises of its splits."""

from __future__ import annotations

import json
from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from sim_assets.generation.benchmark import pieces

PUBLISHED = Path(__file__).parents[3] / "results" / "sim-art-2"
SIZES = {"train": (100, 5000), "val": (50, 1000), "test": (50, 1000), "test-ood": (40, 800)}


def published(name: str) -> dict[str, Any]:
    """One of the published files."""
    return json.loads((PUBLISHED / name).read_text())


def test_every_split_is_recorded_whole() -> None:
    recorded = published("sim-art-2.json")["splits"]
    assert set(recorded) == {piece.name for piece in pieces()}
    assert sum(split["samples"] for split in recorded.values()) == 117_000
    for name, split in recorded.items():
        objects, samples = SIZES[name.rpartition("/")[2]]
        assert (split["objects"], split["samples"], split["samples_lost"]) == (objects, samples, 0)


def test_complete_shows_the_objects_states_and_places_of_clean() -> None:
    recorded = published("sim-art-2.json")["splits"]
    clean = {name: split for name, split in recorded.items() if name.startswith("clean/")}
    assert len(clean) == 20
    for name, split in clean.items():
        other = recorded[name.replace("clean/", "complete/")]
        assert split["plan_digest"] == other["plan_digest"]
        assert split["digest"] != other["digest"]


@pytest.mark.parametrize("part", ["clean", "sensor"])
def test_splits_share_no_object(part: str) -> None:
    ids = published("sim-art-2-ids.json")["splits"]
    for category in {name.split("/")[1] for name in ids if name.startswith(f"{part}/")}:
        of_split = [set(ids[f"{part}/{category}/{split}"]) for split in SIZES]
        assert [len(some) for some in of_split] == [objects for objects, _ in SIZES.values()]
        assert not any(one & other for one, other in combinations(of_split, 2))


def test_half_of_the_unseen_has_unseen_proportions_and_half_is_rearranged() -> None:
    recorded = published("sim-art-2-ids.json")
    unseen = [name for name in recorded["splits"] if name.endswith("test-ood")]
    assert list(recorded["traits"]) == unseen
    for name, traits in recorded["traits"].items():
        assert set(traits) == set(recorded["splits"][name])
        assert Counter(traits.values())["proportions"] == 20
