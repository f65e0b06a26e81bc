# SPDX-License-Identifier: MIT
"""Similarities: as scipy finds them, and past planted outliers."""

from __future__ import annotations

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from bench.baselines.similarity_ransac import SAMPLE, _draw, fit, ransac
from tests.helpers.strategies import generator, normal, rotations


def planted(seed: int, clouds: int = 3, points: int = 60, noise: float = 0.0):
    """Matches of known similarities: source, target, scale, rotation, shift."""
    source, rotation = normal(seed, clouds, points, 3), rotations(seed + 1, clouds)
    scale = 0.8 + 0.4 * torch.rand(clouds, generator=generator(seed), dtype=torch.float64)
    shift = normal(seed + 2, clouds, 3)
    target = scale[:, None, None] * source @ rotation.mT + shift[:, None]
    return source, target + noise * normal(seed + 3, clouds, points, 3), scale, rotation, shift


def test_the_rotation_is_scipys() -> None:
    source, target, _, _, _ = planted(0, noise=0.3)
    weight = torch.rand(3, 60, generator=generator(1), dtype=torch.float64)
    found = fit(target, source, weight)
    for b in range(3):
        share = (weight[b] / weight[b].sum())[:, None]
        a, c = (x[b] - (share * x[b]).sum(0) for x in (target, source))
        wanted = Rotation.align_vectors(a.numpy(), c.numpy(), weight[b].numpy())[0]
        assert_close(found.rotation[b], torch.from_numpy(wanted.as_matrix()), atol=1e-6, rtol=0)


def test_the_fit_is_least_squares() -> None:
    source, target, _, _, _ = planted(4, noise=0.3)
    weight = torch.ones(3, 60, dtype=torch.float64)
    found = fit(target, source, weight)

    def cost(scale: Tensor, shift: Tensor) -> Tensor:
        placed = source @ found.rotation.mT * scale[:, None, None] + shift[:, None]
        return (target - placed).square().sum()

    scale, shift = found.scale.requires_grad_(), found.shift.requires_grad_()
    slopes = torch.autograd.grad(cost(scale, shift), (scale, shift))
    assert all(slope.abs().max() < 1e-9 for slope in slopes)


def test_exact_matches_give_the_similarity_back() -> None:
    source, target, scale, rotation, shift = planted(7)
    found = fit(target, source, torch.ones(3, 60, dtype=torch.float64))
    assert_close((found.scale, found.rotation, found.shift), (scale, rotation, shift))
    assert found.residual(target, source).max() < 1e-12


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_outliers_are_left_out(share: float) -> None:
    source, target, _, _, _ = planted(10, clouds=20, noise=0.01)
    bad = torch.arange(60) < share * 60
    target[:, bad] = 3 * normal(11, 20, int(bad.sum()), 3)
    member = torch.ones(20, 60, dtype=torch.bool)
    found = ransac(target, source, member, 0.1, 100)
    inliers = fit(target, source, (~bad).double().expand(20, -1))
    assert_close(found.rotation, inliers.rotation, atol=1e-2, rtol=0)
    assert_close(found.shift, inliers.shift, atol=1e-2, rtol=0)
    assert_close(found.scale, inliers.scale, atol=1e-2, rtol=0)
    everything = fit(target, source, member.double())
    assert (everything.shift - inliers.shift).norm(dim=1).min() > 0.02


def test_only_members_count_and_the_rest_may_be_anything() -> None:
    source, target, _, rotation, _ = planted(13)
    member = torch.arange(60).expand(3, -1) % 4 == 0
    noisy = torch.where(member[..., None], target, torch.zeros_like(target))
    found = ransac(noisy, source, member, 0.1, 20)
    assert_close(found.rotation, rotation, atol=1e-9, rtol=0)


def test_a_cloud_is_answered_alone_as_in_a_batch_and_again() -> None:
    source, target, _, _, _ = planted(16, clouds=20, noise=0.2)
    member = torch.ones(20, 60, dtype=torch.bool)
    whole, again = (ransac(target, source, member, 0.2, 30) for _ in range(2))
    alone = ransac(target[18:19], source[18:19], member[18:19], 0.2, 30)
    assert_close(alone.rotation[0], whole.rotation[18])
    assert torch.equal(whole.rotation, again.rotation)


def test_it_turns_with_the_target() -> None:
    source, target, _, _, _ = planted(19, noise=0.2)
    member, turn = torch.ones(3, 60, dtype=torch.bool), rotations(20)
    before = ransac(target, source, member, 0.2, 30)
    after = ransac(target @ turn.mT, source, member, 0.2, 30)
    assert_close(after.rotation, turn @ before.rotation)


def test_three_different_members_are_drawn() -> None:
    member = torch.rand(4, 30, generator=generator(0)) < 0.3
    member[0] = False
    member[0, [3, 11, 29]] = True
    drawn = _draw(member, 200)
    assert drawn.shape == (4, 200, SAMPLE)
    for b in range(4):
        assert member[b][drawn[b]].all()
        assert all(len(set(row)) == SAMPLE for row in drawn[b].tolist())
        assert set(drawn[b].flatten().tolist()) == set(member[b].nonzero()[:, 0].tolist())


def test_nothing_to_agree_on_is_still_a_similarity() -> None:
    source, target = normal(21, 1, 12, 3), 9 * normal(22, 1, 12, 3)
    found = ransac(target, source, torch.ones(1, 12, dtype=torch.bool), 1e-9, 10)
    assert torch.isfinite(found.rotation).all()
    assert_close(torch.linalg.det(found.rotation), torch.ones(1, dtype=torch.float64))
