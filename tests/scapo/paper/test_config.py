# SPDX-License-Identifier: MIT
"""The presets: what they promise of sizes and values, and that a run finds its own again."""

from __future__ import annotations

import pytest

from scapo.categories import CATEGORIES
from scapo.paper.config import PRESETS, ScapoConfig, complete_config, cpu_config
from scapo.paper.method import Scapo
from scapo.registry import LIBRARY
from tests.helpers.strategies import generator


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_names_itself_and_is_known_to_the_commands(name: str) -> None:
    made = PRESETS[name]()
    assert made.preset == name
    assert LIBRARY["scapo"].preset(name) == made
    assert set(PRESETS) == set(LIBRARY["scapo"].presets)


@pytest.mark.parametrize("name", ["cpu", "complete"])
def test_a_lean_preset_is_its_own_default(name: str) -> None:
    assert Scapo(PRESETS[name](), CATEGORIES["oven"], generator(0)).variant == name


def test_a_search_of_parts_leaves_the_base_free() -> None:
    """What the search says of the base cannot be said with its state held at 0."""
    complete = complete_config()
    assert complete.part_start == "search"
    assert not complete.joint.base_fixed
    assert complete.joint.revolute_range / 2 >= complete.search.reach


def test_the_cpu_preset_has_at_most_a_million_and_a_half_parameters() -> None:
    made = Scapo(cpu_config(), CATEGORIES["eyeglasses"], generator(0))
    assert sum(parameter.numel() for parameter in made.parameters()) <= 1_500_000


def test_defaults_are_the_papers() -> None:
    config = ScapoConfig()
    assert config.decoder.points == 1024
    assert (config.lr, config.min_lr, config.weight_decay) == ((1e-3, 1e-4), 1e-6, 1e-8)
    assert config.epochs == (200, 200)
    weights = config.loss
    assert (weights.cycle, weights.recon, weights.kp_seg, weights.seg) == (10, 10, 1, 1)
    assert (weights.shape_var, weights.dir_align, weights.joint_prox) == (10, 0.1, 1)
    assert (weights.joint_boundary, weights.variance_scale, weights.proximity_scale) == (3, 60, 30)
    assert (weights.state_gauge, weights.part_mass) == (0, 0)
