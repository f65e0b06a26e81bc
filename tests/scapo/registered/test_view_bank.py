# SPDX-License-Identifier: MIT
"""Template matching: images by their definition, batches as single views, shifted parts found."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.geometry.points import MEAN_RADIUS
from scapo.geometry.rigid import random_rotations, rotation_angle
from scapo.records import cat, take
from scapo.registered.template import ArticulatedTemplate, Placement, turn_placement
from scapo.registered.view_bank import (
    CELLS,
    DEPTH_WEIGHT,
    EXTENT,
    FILLED,
    NORMAL_WEIGHT,
    SPLATTED,
    UNLIKE,
    UNLIKE_WEIGHT,
    WANTED,
    ShownPoints,
    ViewBank,
    draw,
    rolls,
    sphere,
)
from scapo.registered.views import PartialViews, observe
from tests.helpers.sighted import box, sighted, template
from tests.helpers.sliding import BODY, OUT, UP
from tests.helpers.strategies import generator


def still(states: torch.Tensor) -> Placement:
    """The template at these states, its own size, no shift."""
    count = len(states)
    return Placement.at(torch.eye(3).expand(count, 3, 3), torch.zeros(count, 3), states)


def test_an_image_is_what_its_definition_says():
    g = generator(0)
    points, normals = 0.3 * torch.randn(2, 5, 3, generator=g)
    weight = torch.rand(5, generator=g)
    width, cells = 2 * EXTENT / CELLS, torch.zeros(CELLS, CELLS, 5)
    for p, n, w in zip(points, normals, weight, strict=True):
        value = torch.cat([torch.ones(1), DEPTH_WEIGHT * p[2:], NORMAL_WEIGHT * n])
        for row in range(CELLS):
            for column in range(CELLS):
                middle = torch.tensor([column, row]) * width + width / 2 - EXTENT
                share = (1 - (p[:2] - middle).abs() / width).clamp_min(0).prod()
                cells[row, column] += SPLATTED * w / weight.sum() * share * value
    expected = cells / (cells[..., :1] + FILLED)
    torch.testing.assert_close(draw(points, normals, weight), expected.flatten())


def test_directions_and_rolls_are_evenly_spread():
    nearest = (sphere(200) @ sphere(200).T).fill_diagonal_(-1).amax(1).acos().rad2deg()
    assert nearest.min() > 10
    assert nearest.max() < 18
    turn = rolls(8)
    angles = rotation_angle(turn, turn.roll(1, 0)).rad2deg()
    torch.testing.assert_close(angles, torch.full((8,), 45.0))


def test_a_batch_is_proposed_what_its_views_are_one_by_one():
    views, _ = sighted(10, seed=42)
    bank = ViewBank.rendered(template(), still(torch.linspace(0, 1, 4)[:, None]), None, 60)
    together = bank.propose(views, 6)
    single = cat([bank.propose(take(views, torch.tensor([b])), 6) for b in range(10)])
    for name in ("rotation", "translation", "log_scale", "state"):
        ours, theirs = getattr(together, name), getattr(single, name)
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)


def test_views_are_proposed_about_where_they_are():
    views, truth = sighted(16, seed=43)
    bank = ViewBank.rendered(template(), still(torch.linspace(0, 1, 5)[:, None]), None)
    found = bank.propose(views, 4)
    errors = rotation_angle(
        found.rotation.unflatten(0, (16, 4)), truth.rotation[:, None].expand(-1, 4, -1, -1)
    )
    assert (errors.rad2deg().amin(1) < 25).float().mean() > 0.9
    best = errors.argmin(1) + 4 * torch.arange(16)
    assert (found.translation[best] - truth.translation).norm(dim=-1).median() < 0.08
    assert found.log_scale[best].abs().median() < 0.1


def test_only_cameras_near_those_given_are_tried():
    front = torch.tensor([[0.0, 0.0, 1.0]])
    bank = ViewBank.rendered(template(), still(torch.zeros(1, 1)), front)
    assert len(bank.look) < 150
    assert (-bank.look[:, 2] @ front[0] > 0.29).all()


PLINTH = torch.tensor([0.15, 0.11, 0.04])


def on_a_plinth(seed: int, count: int) -> ArticulatedTemplate:
    """A cabinet with a drawer out of its middle, on a plinth that tells what is below."""
    g = generator(seed)
    sizes = (BODY, PLINTH, torch.tensor([0.07, 0.12, 0.05]))
    shapes = [box(half, count // 3, g) for half in sizes]
    points, normals = (torch.cat(columns) for columns in zip(*shapes, strict=True))
    part = torch.arange(len(points)) // (count // 3)
    points[part == 1] -= (BODY[2] + PLINTH[2]) * UP
    points[part == 2] += (BODY[0] + 0.07) * OUT
    made = ArticulatedTemplate(("prismatic",), len(points))
    made.assign(points, normals, 20.0 * torch.nn.functional.one_hot(part // 2, 2))
    with torch.no_grad():
        made.axis.copy_(OUT[None])
    return made


def photographed(template: ArticulatedTemplate, placement: Placement) -> PartialViews:
    """What a camera in front, a little above, sees of the placed template, hidden points left out.

    Points lie in pixels of 0.02 and are seen if none in theirs is nearer by more than 0.03.
    """
    away = torch.nn.functional.normalize(torch.tensor([-1.5, 0.7, 0.1]), dim=0)
    camera, clouds = 2.0 * placement.rotation @ away, []
    with torch.no_grad():
        points, normals = template.place(placement)
    for cloud, normal, eye in zip(points, normals, camera, strict=True):
        forward = torch.nn.functional.normalize(-eye, dim=0)
        frame = torch.linalg.qr(torch.cat([forward[:, None], torch.eye(3)[:, :2]], 1)).Q
        pixel = ((cloud @ frame[:, 1:]) / 0.02).round()
        same = (pixel[:, None] == pixel).all(-1)
        depth = cloud @ forward
        first = torch.where(same, depth, torch.inf).amin(1)
        visible = (depth < first + 0.03) & (((eye - cloud) * normal).sum(-1) > 0)
        kept = cloud[visible]
        clouds.append(kept[torch.linspace(0, len(kept) - 1, 700).long()])
    return observe(torch.stack(clouds), camera)


def test_high_drawers_are_proposed_where_they_are():
    count = 8
    turn = random_rotations(count, generator(5))
    truth = Placement.at(turn, torch.zeros(count, 3), torch.zeros(count, 1))
    truth = replace(truth, shift=(0.17 * UP).expand(count, 1, 3))
    views = photographed(on_a_plinth(9, 4800), truth)
    heights = torch.tensor([-0.17, 0.0, 0.17])
    modes = replace(still(torch.zeros(3, 1)), shift=heights[:, None, None] * UP)
    found = ViewBank.rendered(on_a_plinth(0, 900), modes, None).propose(views, 4)
    errors = rotation_angle(
        found.rotation.unflatten(0, (count, 4)), turn[:, None].expand(-1, 4, -1, -1)
    )
    assert errors.rad2deg().amin(1).max() < 30
    best = take(found, errors.argmin(1) + 4 * torch.arange(count))
    assert (best.shift @ UP > 0.1).all()


def test_sizes_follow_what_is_seen():
    views, truth = sighted(6, seed=44)
    larger = replace(still(torch.linspace(0, 1, 5)[:, None]), log_scale=torch.full((5, 3), 0.5))
    plain = ViewBank.rendered(template(), still(torch.linspace(0, 1, 5)[:, None]), None, 60)
    grown = ViewBank.rendered(template(), larger, None, 60)
    one, other = (bank.propose(views, 2) for bank in (plain, grown))
    torch.testing.assert_close(one.log_scale, other.log_scale, atol=0.2, rtol=0)
    assert (views.points.norm(dim=-1).mean() - MEAN_RADIUS).abs() < 0.05
    assert len(truth.state) == 6


def test_placed_views_propose_and_tell_what_is_like_them():
    views, truth = sighted(40, seed=45)
    known, asked = torch.arange(8, 40), torch.arange(8)
    placement = take(truth, known)
    seen = take(views, known)
    camera = (placement.rotation.mT @ seen.direction()[..., None])[..., 0]
    bank = ViewBank.placed(template(), ShownPoints.of(seen), placement, camera)
    found = bank.propose(take(views, asked), 3)
    right = truth.rotation[asked]
    errors = rotation_angle(
        found.rotation.unflatten(0, (8, 3)), right[:, None].expand(-1, 3, -1, -1)
    )
    assert (errors.rad2deg().amin(1) < 30).float().mean() > 0.6
    upside = right @ torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    odd = bank.unlikeness(take(views, asked), torch.stack([right, upside], 1))
    assert (odd[:, 0] <= odd[:, 1]).all()
    assert (odd[:, 0] < odd[:, 1] - 0.05).float().mean() > 0.6
    assert odd.max() <= UNLIKE * UNLIKE_WEIGHT + 1e-6


@pytest.mark.parametrize("turned", [False, True])
def test_a_placed_view_is_not_compared_with_itself(turned: bool):
    views, truth = sighted(2, seed=46)
    camera = (truth.rotation.mT @ views.direction()[..., None])[..., 0]
    alone = take(truth, torch.tensor([0]))
    bank = ViewBank.placed(
        template(), ShownPoints.of(take(views, torch.tensor([0]))), alone, camera[:1]
    )
    if turned:  # as clouds are looked at in frames of their own
        turn = random_rotations(2, generator(47))
        truth = turn_placement(truth, turn)
        views = replace(
            views,
            points=views.points @ turn.mT,
            normals=views.normals @ turn.mT,
            camera=(turn @ views.camera[..., None])[..., 0],
        )
    odd = bank.unlikeness(views, truth.rotation[:, None])
    assert odd[0, 0].item() == pytest.approx(UNLIKE * UNLIKE_WEIGHT)
    stranger = replace(bank, key=None).unlikeness(views, truth.rotation[:, None])
    assert stranger[0, 0].item() == pytest.approx(0, abs=1e-5)


def from_the_other_side(
    views: PartialViews, placement: Placement
) -> tuple[PartialViews, Placement]:
    """Mirror images of views, which show mirror images of objects: of these, themselves."""
    flip, across = torch.diag(torch.tensor([-1.0, 1, 1])), torch.diag(torch.tensor([1.0, -1, 1]))
    seen = observe(views.points @ flip, views.camera @ flip)
    turned = replace(placement, rotation=flip @ placement.rotation @ across)
    return seen, replace(turned, translation=placement.translation @ flip)


@pytest.mark.parametrize("either", [True, False])
def test_views_from_the_side_where_no_camera_stood_look_like_mirror_images(either: bool) -> None:
    views, truth = sighted(60, seed=48)
    camera = (truth.rotation.mT @ views.direction()[..., None])[..., 0]
    left = (camera[:, 1] > 0.4).nonzero()[:, 0]
    views, truth, camera = take(views, left), take(truth, left), camera[left]
    shape = template()
    shape.mirrored = either
    bank = ViewBank.placed(shape, ShownPoints.of(views), truth, camera)
    assert len(bank.look) == len(left) * (1 + either)
    right, placed = from_the_other_side(views, truth)
    odd = replace(bank, key=None).unlikeness(right, placed.rotation[:, None])[:, 0]
    own = replace(bank, key=None).unlikeness(views, truth.rotation[:, None])[:, 0]
    most = UNLIKE * UNLIKE_WEIGHT
    if not either:
        assert (odd > 0.95 * most).float().mean() > 0.8
        return
    torch.testing.assert_close(odd, own, atol=0.1 * most, rtol=0)
    found = bank.propose(right, 1)  # each its own image, or one as like it
    off = rotation_angle(found.rotation, placed.rotation).rad2deg()
    assert off.median() < 20
    torch.testing.assert_close(
        bank.centre[len(left) :, 0], bank.centre[: len(left), 0] * torch.tensor([1.0, -1, 1]),
        atol=0.02, rtol=0,
    )  # fmt: skip
    there = ViewBank.rendered(shape, still(torch.zeros(1, 1)), camera)
    assert (-there.look[:, 2, 1]).amin() < -0.5


def test_what_is_turned_as_wanted_has_the_state_that_looks_alike():
    views, truth = sighted(16, seed=43)
    bank = ViewBank.rendered(template(), still(torch.linspace(0, 1, 5)[:, None]), None)
    found = bank.turned(views, truth.rotation, 3)
    rotation = found.rotation.unflatten(0, (16, 3))
    apart = rotation_angle(rotation, truth.rotation[:, None].expand_as(rotation)).rad2deg()
    assert apart.max() < WANTED + 5  # the nearest of the bank's, where none is as near
    off = (found.state.view(16, 3) - truth.state).abs()
    assert off[:, 0].median() < 0.2
    upside_down = truth.rotation @ torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    other = bank.turned(views, upside_down, 1)
    assert rotation_angle(other.rotation, upside_down).rad2deg().max() < WANTED + 5
