# SPDX-License-Identifier: MIT
"""Stored placements: found by a cloud's first point, saved and loaded with their size."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations
from scapo.registered.pseudo_labels import PseudoPlacements
from scapo.registered.template import Placement
from tests.helpers.strategies import generator


def test_clouds_are_found_and_strangers_are_not():
    g = generator(0)
    key = torch.randn(6, 3, generator=g)
    placement = Placement.at(random_rotations(6, g), key, torch.arange(6.0)[:, None])
    stored = PseudoPlacements()
    stored.set(key, placement, torch.randn(6, 3, generator=g), torch.ones(6))
    assert stored.find(key[[4, 1]]).tolist() == [4, 1]
    with pytest.raises(ValueError, match="found others"):
        stored.find(torch.randn(1, 3, generator=g))
    loaded = PseudoPlacements()
    loaded.load_state_dict(stored.state_dict())
    assert_close(loaded.placement().state, placement.state)
    assert_close(loaded.camera, stored.camera)
