# SPDX-License-Identifier: MIT
"""Options of template registration: refused values, and what the quick preset leaves out."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest

from scapo.categories import CATEGORIES
from scapo.registered.config import (
    DiscoveryConfig,
    RegisteredConfig,
    cpu_config,
    decided,
    quick_config,
)
from scapo.registered.course import plan_of


def test_a_grid_too_coarse_is_refused() -> None:
    with pytest.raises(ValueError, match="rotations: expected at least 200, found 150"):
        DiscoveryConfig(rotations=150)


def test_a_dense_template_that_would_never_be_built_is_refused() -> None:
    with pytest.raises(ValueError, match="dense_rounds: expected at least 1, found 0"):
        DiscoveryConfig(dense_rounds=0)
    with pytest.raises(ValueError, match=r"^rounds: expected at least 1, found 0"):
        RegisteredConfig(rounds=0)


@pytest.mark.parametrize(
    ("category", "told", "stand", "price"),
    [("drawer", True, "objects", 1.0), ("drawer", False, "views", 0.2),
     ("oven", True, "views", 0.2)],
)  # fmt: skip
def test_objects_say_how_views_stand_where_a_part_slides_and_they_are_known(
    category: str, told: bool, stand: str, price: float
) -> None:
    config = RegisteredConfig(supervision=("instance",) if told else ())
    found = decided(config, CATEGORIES[category])
    assert (found.stand, found.dissent) == (stand, price)
    assert found.discovery.standing == (stand == "objects")  # nothing else asks a scorer
    discovery = DiscoveryConfig(standing=False)
    asked = replace(config, stand="views", dissent=0.3, discovery=discovery)
    assert decided(asked, CATEGORIES[category]) == asked


@pytest.mark.parametrize("category", ["oven", "laptop"])
def test_objects_vote_together_where_no_symmetry_exchanges_their_parts(category: str) -> None:
    found = decided(RegisteredConfig(), CATEGORIES[category])
    assert found.discovery.together == (category == "oven")


def test_the_quick_preset_does_less_of_the_same() -> None:
    quick, usual = quick_config(), cpu_config()
    for few, many in (
        (asdict(quick.discovery), asdict(usual.discovery)),
        (asdict(quick), asdict(usual)),
    ):
        for name, value in many.items():
            if isinstance(value, tuple):
                assert len(few[name]) <= len(value), name
            elif isinstance(value, int):
                assert few[name] <= value, name
    assert quick.learned * quick.epochs < 0.1 * usual.learned * usual.epochs
    for objects in (False, True):
        seconds = [
            sum(plan_of(d, ("revolute",), one.learned, objects * d.objects).values())
            for one in (quick, usual)
            for d in (one.discovery,)
        ]
        assert seconds[0] < 120 < 3 * seconds[0] < seconds[1]
