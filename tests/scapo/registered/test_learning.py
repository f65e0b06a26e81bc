# SPDX-License-Identifier: MIT
"""What the network is taught: candidates as `quick` finds them, and what its word is worth."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from scapo.geometry.rigid import rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, take
from scapo.registered.learning import UNIT, Said, dissent, taught, undeviated, voted
from scapo.registered.view_network import ViewNetwork
from scapo.types import Observation
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator
from tests.scapo.registered.test_method import trained
from tests.scapo.registered.test_view_network import perfect


def test_candidates_are_placements_in_the_frame_of_the_cloud() -> None:
    method, _ = trained(0)
    views, truth = sighted(5, seed=61)
    found = method._candidates(views.points - views.camera[:, None])
    clouds, several = found.gap.shape
    assert clouds == 5
    assert several > 1
    assert bool((found.gap.amin(1) == 0).all())
    best = torch.arange(5) * several + found.gap.argmin(1)
    chosen = take(found.placement, best)
    assert rotation_angle(chosen.rotation, truth.rotation).rad2deg().median() < 8
    own = found.part[torch.arange(5), found.gap.argmin(1)].long()
    placed, _ = method.template.place(truth)
    true = method.template.logit.argmax(-1)[torch.cdist(views.points, placed).argmin(-1)]
    assert (own == true).float().mean() > 0.9
    length = found.normals.float().norm(dim=-1) / UNIT
    assert_close(length, torch.ones_like(length), atol=0.01, rtol=0)
    facing = (found.normals.float() * (views.camera[:, None] - views.points)).sum(-1)
    assert (facing > 0).float().mean() > 0.95


def test_a_step_asks_for_some_points_of_each_view() -> None:
    method, observation = trained(0)
    assert isinstance(method.network, ViewNetwork)
    clouds = (observation.points[:4], torch.arange(4))
    terms = taught(method.network, method.template, method.targets, clouds, 64, generator(0))
    again = taught(method.network, method.template, method.targets, clouds, 64, generator(0))
    assert set(terms) == {"votes", "part", "size"}
    assert all(torch.equal(terms[name], again[name]) for name in terms)
    other = taught(method.network, method.template, method.targets, clouds, 64, generator(1))
    assert other["votes"] != terms["votes"]


def test_parts_that_lie_another_way_than_the_network_says_cost() -> None:
    shape = template()
    _, truth = sighted(2, seed=3)
    turn = rotvec_to_rotmat(torch.tensor([3.0, 0, 0]))
    hypotheses = cat(
        [
            one
            for view in range(2)
            for own in [take(truth, torch.tensor([view]))]
            for one in (
                own,
                replace(own, state=own.state + 0.1),
                replace(own, state=own.state + 2.0),
                replace(own, rotation=own.rotation @ turn),
            )
        ]
    )
    sure, weight = torch.tensor([1.0, 0.5]), torch.zeros(2, 1, 2)
    said = Said(placement=truth, part_weight=weight, sure=sure)
    cost = dissent(shape, said, hypotheses, 0.3)
    assert_close(cost[:, 0], torch.zeros(2), atol=1e-5, rtol=0)
    assert bool((cost[:, 1] < 0.03).all())
    assert_close(cost[:, 2], 0.3 * torch.tensor([1.0, 0.5]), atol=1e-4, rtol=0)
    assert_close(cost[:, 3], 0.6 * torch.tensor([1.0, 0.5]), atol=1e-4, rtol=0)


def test_points_that_the_template_leaves_unsureare_of_the_part_that_the_network_says() -> None:
    """Against the powers of both, point by point; where the template is sure it stays."""
    method, observation = trained(0)
    seen = method._seen(observation)
    placement = method._searched(seen, "quick").placement
    plain = seen.part_weights(method.template, placement)
    other = torch.eye(2)[1 - plain.argmax(-1)]  # Of each point the part that it is not of
    said = Said(placement=placement, part_weight=other, sure=torch.ones(len(plain)))
    found = seen.part_weights(method.template, placement, said)
    product = (plain + 0.02) * (other + 0.02) ** 0.35
    assert_close(found, product / product.sum(-1, keepdim=True))
    flipped = found.argmax(-1) != plain.argmax(-1)
    assert not bool(flipped[plain.amax(-1) > 0.9].any())
    unsure = plain.amax(-1) < 0.7
    assert bool(unsure.any())
    assert bool(flipped[unsure].all())


def test_a_search_begins_about_the_axes_of_the_category() -> None:
    _, truth = sighted(2, seed=3, deviation=0.2)
    assert truth.deviation.abs().max() > 0
    plain = undeviated(truth)
    assert plain.deviation.abs().max() == 0
    assert_close(plain.rotation, truth.rotation)


def test_deviations_are_told_of_the_best_candidate_alone() -> None:
    method, _ = trained(0)
    method.template.load.fill_(0.1)
    method.template.noise.copy_(1e-4 * torch.eye(len(method.template.noise)))
    views, _ = sighted(3, seed=61)
    found = method._candidates(views.points - views.camera[:, None])
    told = found.placement.deviation.flatten(1).abs().amax(1).view_as(found.gap) > 0
    assert torch.equal(told, found.gap == 0)


def test_a_view_is_answered_alike_in_every_quarter_roll() -> None:
    """By four looks; one look says something else of each."""
    method, observation = trained(30)
    assert isinstance(method.network, ViewNetwork)
    seen = method._seen(observation)
    quarter = rotvec_to_rotmat(torch.tensor([0, 0, torch.pi / 2]))
    rolled = replace(seen, views=replace(seen.views, look=quarter @ seen.views.look))
    for looks, alike in ((4, True), (1, False)):
        found = [
            voted(method.network, method.template, one, looks).placement for one in (seen, rolled)
        ]
        apart = rotation_angle(found[0].rotation, found[1].rotation).max()
        assert (float(apart) < 1e-3) == alike


def test_a_look_that_means_another_frame_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three looks at perfect votes the second says that the base is turned, and is less sure."""
    shape = template()
    views, truth = sighted(3, seed=12)
    method, _ = trained(0)
    network = method.network
    assert isinstance(network, ViewNetwork)
    seen = replace(
        method._seen(Observation(points=views.points - views.camera[:, None])),
        clean=views.points, normals=views.normals, views=views,
    )  # fmt: skip
    other = replace(truth, rotation=truth.rotation @ rotvec_to_rotmat(torch.tensor([2.0, 0, 0])))
    said = cat([perfect(shape, views.points, one) for one in (truth, other, truth)])
    noise = torch.zeros_like(said.points)
    noise[3:6] = 0.02 * torch.randn(noise[3:6].shape, generator=generator(1))
    monkeypatch.setattr(
        ViewNetwork, "forward", lambda *_: replace(said, points=said.points + noise)
    )
    answer = voted(network, shape, seen, 3)
    found = answer.placement
    assert rotation_angle(found.rotation, truth.rotation).max() < 1e-3
    assert_close(found.log_scale, truth.log_scale)
    assert_close(answer.part_weight, said.part[:3].softmax(-1))
