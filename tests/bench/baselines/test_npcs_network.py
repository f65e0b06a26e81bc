# SPDX-License-Identifier: MIT
"""What NPCS-EPN's network says does not change when the cloud is turned."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch.testing import assert_close

from bench.baselines.npcs_epn import cpu_config
from bench.baselines.npcs_network import NpcsNetwork
from scapo.equivariant.anchors import icosahedron
from scapo.first_weights import initialise
from tests.helpers.small import settle
from tests.helpers.strategies import generator, normal

SIZES = replace(
    cpu_config().network, widths=(8, 8), strides=(2, 2), radii=(0.3, 0.6), neighbours=(8, 8),
    frames=2, code=8, head=(16,),
)  # fmt: skip


def made() -> NpcsNetwork:
    """With drawn weights and batch statistics of some clouds."""
    network = NpcsNetwork(SIZES, 3, 2)
    initialise(network, generator(0))
    points = 0.2 * normal(1, 4, 40, 3, dtype=torch.float32)
    settle(network)(points, points)
    return network.eval()


def test_it_says_the_same_of_a_cloud_turned_by_any_of_the_sixty() -> None:
    network = made()
    points = 0.2 * normal(2, 2, 40, 3, dtype=torch.float32)
    asked = 0.2 * normal(3, 2, 9, 3, dtype=torch.float32)
    with torch.no_grad():
        before = network(points, asked)
        assert (before.coordinate[:, 0] - before.coordinate[:, 1]).abs().max() > 1e-3
        for rotation in icosahedron().rotations.float():
            after = network(points @ rotation.mT, asked @ rotation.mT)
            for field in fields(before):
                found, wanted = (getattr(one, field.name) for one in (after, before))
                assert_close(found, wanted, atol=1e-4, rtol=0)


def test_it_says_other_things_of_a_cloud_turned_otherwise() -> None:
    network, points = made(), 0.2 * normal(2, 2, 40, 3, dtype=torch.float32)
    between = torch.linalg.matrix_exp(torch.tensor([[0, 0.5, 0], [-0.5, 0, 0], [0, 0, 0.0]]))
    before, after = (network(some, some) for some in (points, points @ between.mT))
    assert (before.coordinate - after.coordinate).abs().max() > 1e-4


def test_answers_have_their_ranges() -> None:
    points = 0.2 * normal(4, 2, 30, 3, dtype=torch.float32)
    answer = made()(points, points)
    assert answer.part.shape == (2, 30, 3)
    assert answer.coordinate.shape == (2, 30, 3, 3)
    assert answer.joint.shape == (2, 30, 3)
    for share in (answer.coordinate, answer.heat):
        assert share.min() > 0
        assert share.max() < 1
    for vector in (answer.towards, answer.axis):
        assert_close(vector.norm(dim=-1), torch.ones(2, 30))


def test_attended_channels_are_means_by_their_own_attention() -> None:
    network = made()
    x, attention = normal(5, 2, 60, 4), normal(6, 2, 60, 2).softmax(1)
    wanted = torch.cat(
        [(x[..., :2] * attention[..., :1]).sum(1), (x[..., 2:] * attention[..., 1:]).sum(1)], -1
    )
    assert_close(network._attended(x, attention), wanted)


def test_every_point_is_spoken_of_by_itself() -> None:
    network = made()
    points, asked = (0.2 * normal(k, 1, 40, 3, dtype=torch.float32) for k in (7, 8))
    with torch.no_grad():
        whole, one = network(points, asked), network(points, asked[:, 5:6])
    assert_close(one.coordinate, whole.coordinate[:, 5:6], atol=1e-5, rtol=0)


def test_channels_that_frames_cannot_share_evenly_are_refused() -> None:
    words = "network.frames: expected a divisor of all widths and of the code, 8, 8, 8, found 3"
    with pytest.raises(ValueError, match=words):
        replace(SIZES, frames=3)
