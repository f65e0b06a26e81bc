# SPDX-License-Identifier: MIT
"""The image of a view, what votes stand for, and which candidate a network is compared with."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from scapo.first_weights import initialise
from scapo.geometry.rigid import rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_network import (
    BESIDE,
    CELLS,
    FULL,
    REACH,
    WEIGHTS,
    ViewNetwork,
    ViewTarget,
    ViewVotes,
    along_rays,
    image_of,
    placed_by_votes,
    view_losses,
)
from scapo.registered.views import look_along
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator, is_rotation


@torch.no_grad()
def perfect(shape: ArticulatedTemplate, points: Tensor, placement: Placement) -> ViewVotes:
    """Votes that say a placement without a fault, by the parts of the nearest template points."""
    poses = shape.part_poses(placement)
    own = (points[:, None] - poses.translation[:, :, None]) @ poses.rotation
    placed, _ = shape.place(placement)
    part = shape.logit[torch.cdist(points, placed).argmin(-1)]
    return ViewVotes(
        points=own.transpose(1, 2),
        part=part,
        log_scale=placement.log_scale,
        shift=placement.shift,
        deviation=placement.deviation,
        hinge=placement.shift,
    )


@torch.no_grad()
def target_of(
    shape: ArticulatedTemplate, placements: list[Placement], part: Tensor, price: Tensor
) -> ViewTarget:
    """Placements of the same single view as its candidates."""
    poses = [shape.part_poses(one) for one in placements]
    return ViewTarget(
        poses=replace(
            poses[0],
            rotation=torch.cat([one.rotation for one in poses]),
            translation=torch.cat([one.translation for one in poses]),
        ),
        part=part.expand(1, len(placements), -1),
        log_scale=torch.stack([one.log_scale for one in placements], 1),
        shift=torch.stack([one.shift for one in placements], 1),
        deviation=torch.stack([one.deviation for one in placements], 1),
        price=price,
        trust=torch.ones(1),
    )


def test_an_image_holds_means_of_the_points_in_each_cell() -> None:
    g = generator(0)
    points = (torch.rand(2, 50, 3, generator=g) - 0.5) * 1.1
    normals = F.normalize(torch.randn(2, 50, 3, generator=g), dim=-1)
    image = image_of(points, normals)
    assert image.shape == (2, 8, CELLS, CELLS)
    for b in range(2):
        cells: dict[tuple[int, int], list[int]] = {}
        for i, (x, y, _) in enumerate(points[b].tolist()):
            place = [int((value / REACH + 1) / 2 * CELLS) for value in (x, y)]
            cells.setdefault((place[1], place[0]), []).append(i)
        assert int(image[b, 0].sum()) == len(cells)
        for (row, column), held in cells.items():
            cell = image[b, :, row, column]
            assert cell[0] == 1
            assert_close(cell[1], 4 * points[b, held, 2].mean(), atol=1e-5, rtol=1e-5)
            assert_close(cell[2:5], normals[b, held].mean(0), atol=1e-5, rtol=1e-5)
            assert bool((cell[5:7].abs() <= 0.5 + 1e-5).all())
            assert_close(cell[7], torch.tensor(len(held) / FULL))


def test_rays_are_brought_to_z_with_any_roll() -> None:
    camera = torch.randn(500, 3, generator=generator(1))
    turn = along_rays(camera, generator(2))
    assert bool(is_rotation(turn).all())
    ray = (turn @ F.normalize(-camera, dim=-1)[..., None])[..., 0]
    beside = torch.arccos(ray[:, 2].clamp(-1, 1))
    assert 0.5 * BESIDE < beside.median() < 2 * BESIDE
    roll = turn @ look_along(camera).mT
    angle = torch.atan2(roll[:, 1, 0], roll[:, 0, 0])
    assert 0.15 < float((angle > torch.pi / 2).float().mean()) < 0.35


@pytest.mark.parametrize("deviation", [0.0, 0.15])
def test_votes_without_a_fault_give_their_placement_back(deviation: float) -> None:
    shape = template()
    views, truth = sighted(6, seed=3)
    g = generator(4)
    turn = torch.zeros(6, 1, 3)
    turn[..., 0] = deviation
    truth = replace(
        truth,
        log_scale=0.2 * torch.randn(6, 3, generator=g),
        shift=torch.tensor([0.03, 0.0, -0.02]).expand(6, 1, 3),
        deviation=turn,
    )
    found, sure = placed_by_votes(perfect(shape, views.points, truth), views.points, shape)
    assert_close(found.rotation, truth.rotation, atol=1e-4, rtol=0)
    assert_close(found.translation, truth.translation, atol=1e-4, rtol=0)
    assert_close(found.state, truth.state, atol=2e-3, rtol=0)
    assert_close(found.shift, truth.shift)
    assert bool((sure > 0.999).all())


def test_a_sliding_part_says_how_far_it_is_out() -> None:
    shape = ArticulatedTemplate(("prismatic",), 400)
    shape.load_state_dict(template().state_dict())
    views, truth = sighted(4, seed=5)
    truth = replace(truth, state=torch.tensor([[0.0], [0.1], [0.2], [-0.1]]))
    found, _ = placed_by_votes(perfect(shape, views.points, truth), views.points, shape)
    assert_close(found.state, truth.state, atol=1e-4, rtol=0)


def test_votes_of_a_few_points_that_are_far_off_change_little() -> None:
    shape = template()
    views, truth = sighted(4, seed=6)
    votes = perfect(shape, views.points, truth)
    wrong = votes.points.clone()
    wrong[:, ::8] += 0.4
    found, sure = placed_by_votes(replace(votes, points=wrong), views.points, shape)
    assert rotation_angle(found.rotation, truth.rotation).rad2deg().max() < 1
    assert bool(((sure > 0.8) & (sure < 0.9)).all())


def test_the_candidate_that_costs_least_is_learned() -> None:
    shape = template()
    views, truth = sighted(1, seed=7)
    other = replace(truth, rotation=truth.rotation @ rotvec_to_rotmat(torch.tensor([3.0, 0, 0])))
    votes = perfect(shape, views.points, other)
    part = votes.part.argmax(-1)[:, None]
    alone = view_losses(votes, views.points, target_of(shape, [truth], part, torch.zeros(1, 1)))
    for price, small in ((0.0, True), (100.0, False)):
        target = target_of(shape, [truth, other], part, torch.tensor([[0.0, price]]))
        terms = view_losses(votes, views.points, target)
        assert (float(terms["votes"]) < 0.02) == small
        assert terms["size"] == 0
        if not small:
            assert_close(terms["votes"], alone["votes"])
    assert set(terms) == set(WEIGHTS) - {"hinge"}
    known = replace(target, aside=torch.full((1, 2, 1), 0.3))
    assert_close(view_losses(votes, views.points, known)["hinge"], torch.tensor(0.3))


@torch.no_grad()
def test_views_that_are_not_trusted_count_nothing() -> None:
    shape = template()
    views, truth = sighted(2, seed=8)
    votes = perfect(shape, views.points, truth)
    target = ViewTarget(
        poses=shape.part_poses(truth),
        part=votes.part.argmax(-1)[:, None],
        log_scale=truth.log_scale[:, None],
        shift=truth.shift[:, None],
        deviation=truth.deviation[:, None],
        price=torch.zeros(2, 1),
        trust=torch.tensor([1.0, 0.0]),
    )
    spoilt = votes.points.clone()
    spoilt[1] += 1.0
    terms = view_losses(replace(votes, points=spoilt), views.points, target)
    assert float(terms["votes"]) < 0.02


def test_the_network_learns_where_points_lie() -> None:
    """Of a few views, which it sees turned about their rays in every step."""
    views, truth = sighted(12, seed=9)
    network = ViewNetwork(2, 1, channels=8)
    initialise(network, generator(0))
    optimiser = torch.optim.Adam(network.parameters(), 4e-3)
    g, losses = generator(1), []
    for _ in range(60):
        turn = along_rays(views.camera, g)
        points, normals = views.points @ turn.mT, views.normals @ turn.mT
        rotation = turn @ truth.rotation
        moved = (turn @ truth.translation[..., None])[..., 0]
        own = (points - moved[:, None]) @ rotation
        votes = network(points, normals, 128)
        off = (votes.points[:, :, 0] - own[:, :128]).norm(dim=-1).mean()
        optimiser.zero_grad()
        off.backward()
        optimiser.step()
        losses.append(float(off.detach()))
    assert losses[-1] < 0.5 * losses[0]


def test_points_that_do_not_vote_are_seen_all_the_same() -> None:
    network = ViewNetwork(2, 1, channels=4).eval()
    initialise(network, generator(0))
    g = generator(2)
    points = 0.2 * torch.randn(1, 60, 3, generator=g)
    normals = F.normalize(torch.randn(1, 60, 3, generator=g), dim=-1)
    few, all_of_them = (network(points, normals, count) for count in (20, 60))
    assert_close(few.points, all_of_them.points[:, :20])
    without = network(points[:, :20], normals[:, :20], 20)
    assert (without.points - few.points).abs().max() > 1e-4
