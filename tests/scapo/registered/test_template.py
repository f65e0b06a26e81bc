# SPDX-License-Identifier: MIT
"""The template's motions against the library's joint motion, for both kinds of joint."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.categories import JointKind
from scapo.geometry.rigid import apply, joint_motion, random_rotations, rigid
from scapo.records import cat, take
from scapo.registered.template import (
    PART_LENGTH,
    ArticulatedTemplate,
    Placement,
    across_axis,
    interleave,
    spread_out,
    surface_features,
    turn_placement,
)
from tests.helpers.sliding import OUT, UP
from tests.helpers.strategies import generator


def drawn(kind: JointKind) -> tuple[ArticulatedTemplate, Placement]:
    """A template and a placement with everything drawn."""
    g = generator(6)
    template = ArticulatedTemplate((kind,), 20)
    points, normals = torch.randn(2, 20, 3, generator=g)
    part = torch.nn.functional.one_hot(torch.arange(20) % 2, 2)
    template.assign(points, torch.nn.functional.normalize(normals, dim=-1), 60.0 * part)
    with torch.no_grad():
        template.axis.copy_(torch.randn(1, 3, generator=g))
        template.pivot.copy_(torch.randn(1, 3, generator=g))
    return template, Placement(
        rotation=random_rotations(4, g),
        translation=torch.randn(4, 3, generator=g),
        log_scale=0.2 * torch.randn(4, 3, generator=g),
        state=torch.randn(4, 1, generator=g),
        shift=torch.randn(4, 1, 3, generator=g),
        deviation=torch.zeros(4, 1, 3),
    )


@torch.no_grad()
def test_joints_of_either_kind_move_their_own_parts_as_they_would_alone() -> None:
    alone = [drawn("revolute"), drawn("prismatic")]
    both = ArticulatedTemplate(("revolute", "prismatic"), 20)
    for j, (one, _) in enumerate(alone):
        both.axis[j], both.pivot[j] = one.axis[0], one.pivot[0]
    placement = alone[0][1]
    wide = replace(
        placement,
        **{name: torch.cat([getattr(p, name) for _, p in alone], 1)
           for name in ("state", "shift", "deviation")},
    )  # fmt: skip
    poses = both.part_poses(wide)
    for j, (one, own) in enumerate(alone):
        told = one.part_poses(replace(placement, state=own.state, shift=own.shift))
        assert_close(poses.rotation[:, j + 1], told.rotation[:, 1])
        assert_close(poses.translation[:, j + 1], told.translation[:, 1])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@torch.no_grad()
def test_parts_move_as_their_joint_says(kind: JointKind):
    template, placement = drawn(kind)
    points, normals = template.place(placement)
    scaled = template.points * placement.log_scale.exp()[:, None]
    axis = template.directions().expand(4, 3)
    pivot = template.pivot * placement.log_scale.exp()
    motion = joint_motion(pivot, axis, placement.state[:, 0], kind)
    motion[:, :3, 3] += placement.shift[:, 0]
    view_T_base = rigid(placement.rotation, placement.translation)
    assert_close(points[:, ::2], apply(view_T_base, scaled[:, ::2]))
    assert_close(points[:, 1::2], apply(view_T_base @ motion, scaled[:, 1::2]))
    assert_close(normals.norm(dim=-1), torch.ones(4, 20))
    seen, direction = template.joints_in_view(placement)
    middle = template.part_centres()[1:] if kind == "prismatic" else template.pivot
    spot = middle * placement.log_scale.exp() + placement.shift[:, 0]
    assert_close(seen, apply(view_T_base, spot[:, None]))
    assert_close(direction[:, 0], (placement.rotation @ axis[..., None])[..., 0])


@torch.no_grad()
def test_a_hinge_turns_its_part_about_its_own_axis_from_its_rest():
    template, placement = drawn("revolute")
    template.rest.copy_(torch.tensor([0.4]))
    straight = replace(placement, shift=torch.zeros(4, 1, 3))
    aside = replace(straight, deviation=0.2 * torch.randn(4, 1, 3, generator=generator(7)))
    at_rest = torch.full((4, 1), 0.4)
    still = template.part_poses(replace(aside, state=at_rest))
    upright = template.part_poses(replace(straight, state=at_rest))
    assert_close(still.rotation, upright.rotation)
    assert_close(still.translation, upright.translation)
    pivot, axis = (x[:, 0] for x in template.joints_in_view(aside))
    onward = joint_motion(pivot, axis, (aside.state - at_rest)[:, 0], "revolute")
    moved = template.part_poses(aside)
    view_T_part = onward @ rigid(still.rotation[:, 1], still.translation[:, 1])
    assert_close(rigid(moved.rotation[:, 1], moved.translation[:, 1]), view_T_part)
    turned = roma.rotvec_to_rotmat(aside.deviation[:, 0]) @ template.directions()[0]
    assert_close(axis, (aside.rotation @ turned[..., None])[..., 0])


def test_placements_are_taken_and_joined():
    _, placement = drawn("revolute")
    back = cat([take(placement, torch.tensor([2, 3])), take(placement, torch.tensor([0]))])
    assert_close(back.state, placement.state[[2, 3, 0]])
    assert_close(back.shift, placement.shift[[2, 3, 0]])


def test_hypotheses_of_a_view_stand_together():
    turn = torch.eye(3).expand(6, 3, 3)
    pairs = Placement.at(turn, torch.zeros(6, 3), torch.arange(6.0)[:, None])
    singles = Placement.at(turn[:3], torch.zeros(3, 3), 10 + torch.arange(3.0)[:, None])
    mixed = interleave([pairs, singles], 3)
    assert mixed.state[:, 0].tolist() == [0, 1, 10, 2, 3, 11, 4, 5, 12]


@torch.no_grad()
@pytest.mark.parametrize("joints", [1, 2])
def test_the_mirror_image_of_what_is_placed_is_the_placed_mirror_image(joints: int) -> None:
    """Of an object that mirrors itself left and right, wherever it stands and in any state."""
    g, axis = generator(31), torch.tensor([0.0, 0, 1]) if joints == 2 else torch.tensor([0, 1.0, 0])
    across, aside = torch.diag(torch.tensor([1.0, -1, 1])), torch.tensor([0.0, 0.2, 0])
    half, side = torch.randn(40, 3, generator=g), torch.arange(40) % 2
    points = torch.cat([half, half @ across]) + aside
    part = torch.cat([side, side * joints])  # of two each is the other's image
    template = ArticulatedTemplate(("revolute",) * joints, 80)
    template.assign(points, points, 60.0 * torch.eye(joints + 1)[part])
    away = torch.tensor([[0.3, 0.5, 0.1], [0.3, -0.5, 0.1]])[:joints]
    template.axis.copy_(axis * torch.tensor([[1.0], [-1.0]])[:joints])
    template.pivot.copy_(aside + (away if joints == 2 else away * torch.tensor([1.0, 0, 1])))
    state = torch.randn(5, joints, generator=g)
    placement = Placement.at(random_rotations(5, g), torch.randn(5, 3, generator=g), state)
    shift = torch.randn(5, joints, 3, generator=g)
    placement = replace(placement, shift=shift, log_scale=0.2 * torch.randn(5, 3, generator=g))
    mirror = template.mirror()
    assert_close(mirror.flip, across, atol=1e-6, rtol=0)
    assert_close(mirror.middle, aside, atol=1e-5, rtol=0)
    found, _ = template.place(mirror.placement(placement))
    expected = template.place(placement)[0] @ mirror.flip
    swapped = torch.cat([expected[:, 40:], expected[:, :40]], 1)
    assert_close(found, swapped, atol=1e-4, rtol=1e-4)
    again = mirror.placement(mirror.placement(placement))
    assert_close(template.place(again)[0], template.place(placement)[0], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_turned_placement_turns_the_points():
    template, placement = drawn("revolute")
    turn = random_rotations(4, generator(9))
    points, _ = template.place(turn_placement(placement, turn))
    assert_close(points, template.place(placement)[0] @ turn.mT, atol=1e-4, rtol=1e-4)


def test_a_lighter_template_has_the_first_points_and_the_same_joints():
    template, placement = drawn("revolute")
    template.mirrored = True
    light, repeated = template.with_points(8), template.with_points(50)
    assert light.mirrored
    assert_close(light.place(placement)[0], template.place(placement)[0][:, :8])
    assert_close(light.joints_in_view(placement), template.joints_in_view(placement))
    assert torch.equal(repeated.points[20:40], template.points)


@pytest.mark.parametrize("axis", [OUT, UP, torch.tensor([0.6, 0.0, 0.8])])
def test_across_an_axis(axis: Tensor):
    frame = torch.stack([axis, *across_axis(axis)])
    assert_close(frame @ frame.T, torch.eye(3))


def test_farthest_features_spread_out():
    line = torch.arange(11.0)[:, None]
    assert sorted(spread_out(line, 3).tolist()) == [0, 5, 10]


def test_slides_are_marked():
    shape = ArticulatedTemplate(("revolute", "prismatic"), 5)
    assert shape.sliding.tolist() == [[0.0], [1.0]]


def test_a_plate_is_sampled_on_both_faces_and_parts_along_their_border():
    flat = torch.cat([torch.rand(100, 2, generator=generator(1)), torch.zeros(100, 1)], -1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(100, 3)
    part = torch.tensor([1.0, 0.0]).expand(200, 2)
    points, normals = torch.cat([flat, flat]), torch.cat([up, -up])
    index = spread_out(surface_features(points, normals, part), 20)
    assert 5 <= int((index < 100).sum()) <= 15
    two = surface_features(points[:1].expand(2, 3), normals[:1].expand(2, 3), torch.eye(2))
    assert (two[0] - two[1]).norm() == pytest.approx(PART_LENGTH * 2**0.5)
