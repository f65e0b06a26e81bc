# SPDX-License-Identifier: MIT
"""Options of SCAPO as it works: refused values, and names of variants."""

from __future__ import annotations

import pytest

from scapo.categories import CATEGORIES
from scapo.registered.initialisation import DiscoveryConfig
from scapo.registered.method import RegisteredConfig, RegisteredScapo, cpu_config
from tests.helpers.strategies import generator


def variant(config: RegisteredConfig) -> str:
    return RegisteredScapo(config, CATEGORIES["oven"], generator(0)).variant


def test_a_grid_too_coarse_is_refused() -> None:
    with pytest.raises(ValueError, match="rotations: expected at least 200, found 150"):
        DiscoveryConfig(rotations=150)


def test_departures_are_named_and_a_shorter_training_is_not() -> None:
    assert variant(cpu_config()) == ""
    assert variant(RegisteredConfig(learned=20, epochs=1, lr=1.0, batch=2)) == ""
    discovery = DiscoveryConfig(held_frame=False, range_cost=0.0)
    config = RegisteredConfig(strays="kept", settle=False, discovery=discovery)
    assert variant(config) == (
        "discovery.range_cost=0.0 discovery.held_frame=False strays=kept settle=False"
    )
