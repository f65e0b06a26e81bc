# SPDX-License-Identifier: MIT
"""What the network is taught: candidates as `quick` finds them, and what its word is worth."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.testing import assert_close

from scapo.geometry.rigid import rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, take
from scapo.registered.learning import UNIT, dissent, taught, undeviated
from scapo.registered.view_network import ViewNetwork
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator
from tests.scapo.registered.test_method import trained


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
    cost = dissent(shape, truth, torch.tensor([1.0, 0.5]), hypotheses, 0.3)
    assert_close(cost[:, 0], torch.zeros(2), atol=1e-5, rtol=0)
    assert bool((cost[:, 1] < 0.03).all())
    assert_close(cost[:, 2], 0.3 * torch.tensor([1.0, 0.5]), atol=1e-4, rtol=0)
    assert_close(cost[:, 3], 0.6 * torch.tensor([1.0, 0.5]), atol=1e-4, rtol=0)


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
