# SPDX-License-Identifier: MIT
"""Stored placements: saved and loaded with their size."""

from __future__ import annotations

import torch
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations
from scapo.registered.pseudo_labels import Candidates, PseudoLabels, ViewTargets
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


def test_candidates_come_back_cloud_by_cloud_and_are_forgotten():
    g = generator(1)
    placement = Placement.at(
        random_rotations(6, g), torch.randn(6, 3, generator=g), torch.arange(6.0)[:, None]
    )
    found = Candidates(
        placement=placement,
        part=torch.randint(0, 2, (3, 2, 5), generator=g).to(torch.uint8),
        gap=torch.rand(3, 2, generator=g),
        margin=torch.ones(3),
        inlier=torch.ones(3, 5, dtype=torch.bool),
        normals=torch.ones(3, 5, 3, dtype=torch.int8),
    )
    stored, loaded = ViewTargets(), ViewTargets()
    stored.set(found, torch.tensor([1.0, 0, 1]))
    loaded.load_state_dict(stored.state_dict())
    assert_close(loaded.placement(torch.tensor([2, 0])).state[:, 0], torch.tensor([4.0, 5, 0, 1]))
    assert loaded.part.dtype == torch.uint8
    assert torch.equal(loaded.normals, found.normals)
    loaded.clear()
    assert all(tensor.numel() == 0 for tensor in loaded.state_dict().values())
