# SPDX-License-Identifier: MIT
"""Stored placements: saved and loaded with their size."""

from __future__ import annotations

import torch
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations
from scapo.registered.pseudo_labels import PseudoLabels
from scapo.registered.template import Placement
from tests.helpers.strategies import generator


def test_what_is_stored_comes_back_with_its_size():
    g = generator(0)
    key = torch.randn(6, 3, generator=g)
    placement = Placement.at(random_rotations(6, g), key, torch.arange(6.0)[:, None])
    stored = PseudoLabels()
    stored.set(key, placement, torch.randn(6, 3, generator=g), torch.ones(6))
    loaded = PseudoLabels()
    loaded.load_state_dict(stored.state_dict())
    assert_close(loaded.placement().state, placement.state)
    assert_close(loaded.camera, stored.camera)
