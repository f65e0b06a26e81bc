# SPDX-License-Identifier: MIT
"""Votes: principal frames and Procrustes turn with the cloud; the network learns a shape."""

from __future__ import annotations

import torch
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations, rotation_angle
from scapo.registered.network import (
    FRAMES,
    PointVotes,
    Target,
    principal_frames,
    procrustes,
    random_frames,
    vote_losses,
)
from tests.helpers.strategies import generator, is_rotation


def clouds(count: int) -> torch.Tensor:
    """Ellipsoidal clouds of mean radius about 0.25."""
    wide = torch.tensor([0.3, 0.15, 0.08])
    points = torch.randn(count, 64, 3, generator=generator(0)) * wide
    return points - points.mean(1, keepdim=True)


def test_the_four_frames_turn_with_the_cloud():
    points = clouds(3)
    turn = random_rotations(1, generator(1))[0]
    plain, turned = principal_frames(points), principal_frames(points @ turn.T)
    assert bool(is_rotation(plain).all())
    seen = plain @ points[:, None].mT
    again = turned @ (points @ turn.T)[:, None].mT
    gap = (seen[:, :, None] - again[:, None]).abs().amax((-1, -2)).amin(-1)
    assert gap.max() < 1e-3


def test_clouds_are_learned_near_their_principal_frames():
    points = clouds(1).expand(400, 64, 3)
    frames = random_frames(points, generator(5))
    assert bool(is_rotation(frames).all())
    near = principal_frames(points)
    apart = rotation_angle(frames[:, None].expand_as(near), near)
    assert float(apart.amin(1).max()) < 1.0
    assert len(apart.argmin(1).unique()) == FRAMES


def test_procrustes_ignores_points_without_weight():
    source = clouds(2)
    rotation, move = random_rotations(2, generator(2)), torch.tensor([[1.0, 2, 3], [0, 1, 0]])
    target = source @ rotation.mT + move[:, None]
    weight = torch.ones(2, 64)
    target[:, :20] += 5
    weight[:, :20] = 0
    found, shift = procrustes(target, source, weight)
    assert_close(found, rotation, atol=1e-4, rtol=0)
    assert_close(shift, move, atol=1e-4, rtol=0)


def test_losses_are_zero_where_votes_are_right_and_distrust_counts_nothing():
    g = generator(3)
    network = PointVotes(2, 1, width=8)
    points = clouds(2)
    votes = network(points)
    target = Target(
        points=votes.points.detach(),
        part=torch.tensor([1.0, 0]).expand(2, 64, 2),
        state=votes.state.detach(),
        log_scale=votes.log_scale.detach(),
        shift=votes.shift.detach(),
        camera=votes.camera.detach(),
        trust=torch.tensor([1.0, 0.0]),
    )
    terms = vote_losses(votes, target)
    assert_close(terms["votes"], torch.tensor(1e-3), atol=1e-5, rtol=0)
    for name in ("state", "size", "camera"):
        assert terms[name] == 0
    votes.points.retain_grad()
    (votes.points * 0 + (votes.points - torch.randn(2, 64, 3, generator=g)) ** 2).sum()
    torch.stack(list(terms.values())).sum().backward()
    assert votes.points.grad is None or votes.points.grad[1].abs().max() == 0


def test_the_network_learns_where_points_lie():
    points = clouds(16)
    with torch.random.fork_rng():
        network = PointVotes(2, 1, width=12)
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    target = points * torch.tensor([1.0, -1, -1])
    losses = []
    for _ in range(40):
        off = (network(points).points - target).norm(dim=-1).mean()
        optimiser.zero_grad()
        off.backward()
        optimiser.step()
        losses.append(float(off.detach()))
    assert losses[-1] < 0.4 * losses[0]
