# SPDX-License-Identifier: MIT
"""Voting: right pairs among many wrong ones give one frame, and confidence tells outsiders."""

from __future__ import annotations

import torch

from scapo.geometry.rigid import random_rotations, rotation_angle
from scapo.registered.pairwise import Modes
from scapo.registered.synchronisation import synchronise
from tests.helpers.strategies import generator


def noisy_modes(right: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, Modes]:
    """Ten views, the last a stranger; a share of pairs right, all others random."""
    g = generator(5)
    rotation, translation = random_rotations(10, g), torch.randn(10, 3, generator=g)
    pairs = torch.combinations(torch.arange(10))
    good = (torch.rand(len(pairs), generator=g) < right) & (pairs != 9).all(1)
    i, j = pairs.unbind(-1)
    relative = rotation[j].mT @ rotation[i]
    shift = (rotation[j].mT @ (translation[i] - translation[j])[..., None])[..., 0]
    wild = random_rotations(len(pairs) * 3, g).unflatten(0, (-1, 3))
    wild[good, 0] = relative[good]
    move = torch.randn(len(pairs), 3, 3, generator=g)
    move[good, 0] = shift[good]
    score = torch.tensor([0.30, 0.34, 0.36]).expand(len(pairs), 3).clone()
    score[good, 0] -= 0.04
    return rotation, translation, pairs, Modes(rotation=wild, translation=move, score=score)


def test_right_pairs_outvote_wrong_ones():
    rotation, translation, pairs, modes = noisy_modes(0.6)
    found = synchronise(10, pairs, modes)
    frame = found.rotation[0] @ rotation[0].mT
    angles = rotation_angle(found.rotation[:9], frame @ rotation[:9]).rad2deg()
    assert angles.max() < 1
    assert found.confidence.argmin() == 9
    moved = (found.translation - found.translation[:1])[:9]
    assert (moved - (translation - translation[:1])[:9] @ frame.T).norm(dim=-1).max() < 0.05
