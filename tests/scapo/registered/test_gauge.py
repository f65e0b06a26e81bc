# SPDX-License-Identifier: MIT
"""The gauge: a sliding part's axis is the way out of the body, the frame that of the base."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import roma
import torch
from torch.testing import assert_close

from scapo.geometry.rigid import random_rotations
from scapo.registered.gauge import (
    along_main_directions,
    choose_axes,
    principal_frame,
    protrusion,
    seat_hinges,
    settle_hinges,
    tells_frame,
    touch,
)
from scapo.registered.template import ArticulatedTemplate, Placement
from tests.helpers.sighted import AXIS, PIVOT, template
from tests.helpers.sliding import OUT, UP, cabinet, placements
from tests.helpers.strategies import generator


def test_the_axis_is_the_way_out_of_the_body():
    template, start = cabinet(UP), placements()
    before, _ = template.place(start)
    found = choose_axes(template, start, torch.eye(3))
    assert_close(template.directions().detach(), OUT[None])
    assert_close(template.place(found)[0], before, atol=1e-5, rtol=0)
    assert_close(found.state.mean(0), torch.zeros(1), atol=1e-6, rtol=0)
    opened = (start.shift[:, 0] @ OUT)[:, None]
    assert_close(found.state, opened - opened.mean(), atol=1e-6, rtol=0)
    assert_close(found.shift[:, 0] @ UP, start.state[:, 0], atol=1e-6, rtol=0)


def test_the_placed_template_stays_under_any_scales():
    template, start = cabinet(UP), placements()
    start = replace(start, log_scale=0.2 * torch.randn(40, 3, generator=generator(4)))
    before, _ = template.place(start)
    found = choose_axes(template, start, torch.eye(3))
    assert_close(template.directions().detach(), OUT[None])
    assert_close(template.place(found)[0], before, atol=1e-5, rtol=0)


def test_a_part_that_comes_out_nowhere_keeps_its_axis():
    template = cabinet(UP)
    start = Placement.at(torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3), torch.zeros(4, 1))
    found = choose_axes(template, start, torch.eye(3))
    assert_close(template.directions().detach(), UP[None])
    assert torch.equal(found.state, start.state)
    assert torch.equal(found.shift, start.shift)


def test_what_sticks_out_is_measured_from_the_scaled_body():
    template, start = cabinet(OUT), placements(2)
    start = replace(start, log_scale=torch.tensor([[0.0, 0, 0], [0.3, 0, 0]]))
    offset = torch.tensor([[-0.1, 0, 0], [0.1, 0.0, 0.0]])
    out = protrusion(template, start, offset, 0, torch.stack([OUT, -OUT]))
    grown = 0.09 - 0.01 * (torch.tensor(0.3).exp() - 1)
    assert_close(out, torch.tensor([[0.09, 0.0], [0.0, float(grown)]]), atol=2e-3, rtol=0)


def test_revolute_joints_are_left_alone():
    template = ArticulatedTemplate(("revolute",), 10)
    start = Placement.at(torch.eye(3)[None], torch.zeros(1, 3), torch.ones(1, 1))
    axis = template.axis.detach().clone()
    found = choose_axes(template, start, torch.eye(3))
    assert torch.equal(template.axis.detach(), axis)
    assert torch.equal(found.state, start.state)


def test_the_frame_follows_most_normals():
    turn = random_rotations(1, generator(1))[0]
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).repeat(20, 1)
    noise = 0.05 * torch.randn(120, 3, generator=generator(2))
    frame = principal_frame(torch.nn.functional.normalize(axes @ turn.T + noise, dim=-1))
    aligned = (frame @ turn).abs()
    assert aligned.amax(1).min() > 0.995
    assert torch.allclose(torch.linalg.det(frame), torch.tensor(1.0), atol=1e-4)


@torch.no_grad()
def test_the_frame_turns_back_to_the_main_directions_of_the_base():
    shape, start = (
        template(),
        Placement.at(random_rotations(3, generator(1)), torch.zeros(3, 3), torch.zeros(3, 1)),
    )
    before, _ = shape.place(start)
    aside = roma.rotvec_to_rotmat(torch.tensor([0.15, -0.1, 0.2]))
    for vectors in (shape.points, shape.normals, shape.axis, shape.pivot):
        vectors.copy_(vectors @ aside.T)
    turned = replace(start, rotation=start.rotation @ aside.T)
    found = along_main_directions(shape, turned)
    assert tells_frame(shape)
    assert_close(found.rotation, start.rotation, atol=2e-3, rtol=0)
    assert_close(shape.directions()[0], AXIS, atol=2e-3, rtol=0)
    assert_close(shape.place(found)[0], before, atol=1e-4, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("degrees", [30.0, 45.0])
def test_the_frame_of_a_plate_follows_its_normal_and_its_hinge(degrees: float):
    g = generator(7)
    points = torch.rand(300, 3, generator=g) * torch.tensor([0.6, 0.4, 0.0])
    up = (torch.rand(300, 1, generator=g) < 0.5) * 2.0 - 1
    normals = up * torch.tensor([0.0, 0.0, 1.0]) + 0.05 * torch.randn(300, 3, generator=g)
    plate = ArticulatedTemplate(("revolute",), 300)
    plate.assign(
        points,
        torch.nn.functional.normalize(normals, dim=-1),
        torch.tensor([[8.0, 0.0]]).expand(300, 2),
    )
    plate.axis.copy_(torch.tensor([[0.8, 0.6, 0.0]]))
    turn = roma.rotvec_to_rotmat(torch.deg2rad(torch.tensor([degrees, 0.0, 0.0])))
    for vectors in (plate.points, plate.normals, plate.axis):
        vectors.copy_(vectors @ turn.T)
    start = Placement.at(random_rotations(2, g), torch.zeros(2, 3), torch.zeros(2, 1))
    before, _ = plate.place(start)
    found = along_main_directions(plate, start)
    assert not tells_frame(plate)
    assert plate.normals.abs().mean(0).max() > 0.98
    assert plate.directions()[0].abs().max() > 0.999
    assert_close(plate.place(found)[0], before, atol=1e-4, rtol=0)


def hinged_elsewhere(count: int, seed: int) -> Placement:
    """Views of objects of several sizes whose hinges sit about the template's own."""
    g = generator(seed)
    state = 1.4 * torch.rand(count, 1, generator=g) - 0.3
    placement = Placement.at(random_rotations(count, g), torch.zeros(count, 3), state)
    shift = 0.01 * torch.randn(count, 1, 3, generator=g)
    shift[: count // 5] *= 20  # placed wrongly
    return replace(
        placement,
        log_scale=0.2 * torch.randn(count, 3, generator=g),
        shift=shift - (shift @ AXIS)[..., None] * AXIS,
    )


def test_a_hinge_settles_where_its_part_turns_without_shifts():
    shape, placement = template(), hinged_elsewhere(200, 5)
    before, _ = shape.place(placement)
    aside = torch.tensor([0.15, 0.4, -0.1])
    # the same motions told as turns about a hinge elsewhere, with shifts that make up for it
    wrong = template()
    with torch.no_grad():
        wrong.pivot.add_(aside)
    own = (wrong.turns(placement)[:, 0] @ (placement.log_scale.exp() * aside)[..., None])[..., 0]
    shift = placement.shift[:, 0] + own - placement.log_scale.exp() * aside
    told = replace(placement, shift=(shift - (shift @ AXIS)[:, None] * AXIS)[:, None])
    found = settle_hinges(wrong, told)
    across = torch.tensor([1.0, 0.0, 1.0])
    off = (wrong.pivot.detach()[0] - PIVOT) * across
    assert off.norm() < 0.01 < 0.1 * (aside * across).norm()
    assert_close(wrong.pivot.detach()[0, 1], PIVOT[1] + aside[1])
    placed, _ = wrong.place(found)
    assert_close(placed, before, atol=2e-4, rtol=0)
    assert found.shift[40:].norm(dim=-1).mean() < 0.03 < told.shift[40:].norm(dim=-1).mean()


def test_a_hinge_that_is_right_stays():
    shape, placement = template(), hinged_elsewhere(200, 6)
    settle_hinges(shape, replace(placement, shift=torch.zeros_like(placement.shift)))
    assert_close(shape.pivot.detach()[0], PIVOT, atol=1e-4, rtol=0)


def plates(opened: float, strays: int = 4) -> ArticulatedTemplate:
    """A base of 1 x 0.8 and a lid at its edge x = -0.5, hinged along y, with a few stray points."""
    g = generator(3)
    flat = torch.rand(800, 3, generator=g) * torch.tensor([1.0, 0.8, 0.0])
    flat -= torch.tensor([0.5, 0.4, 0.0])
    part = (torch.arange(800) >= 400).long()
    along = flat[:, 0] + 0.5
    lid = torch.stack([math.cos(opened) * along - 0.5, flat[:, 1], math.sin(opened) * along], -1)
    points = torch.where(part[:, None] == 1, lid, flat)
    points[:strays] = torch.tensor([-0.42, 0.0, 0.1])
    made = ArticulatedTemplate(("revolute",), len(points))
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3)
    made.assign(points, normals, 8.0 * torch.nn.functional.one_hot(part, 2))
    with torch.no_grad():
        made.axis.copy_(torch.tensor([[0.0, 1.0, 0.0]]))
        made.pivot.copy_(torch.tensor([[-0.42, 0.3, 0.1]]))
    return made


def test_a_hinge_is_pulled_to_where_its_parts_touch():
    made, placement = plates(1.3), hinged_elsewhere(200, 7)
    placement = replace(placement, shift=torch.zeros_like(placement.shift))
    before, _ = made.place(placement)
    edge = torch.tensor([-0.5, 0.3, 0.0])
    assert (touch(made, 0) - edge).norm() < 0.03
    held = plates(1.3)
    settle_hinges(held, placement)
    assert_close(held.pivot[0].detach(), torch.tensor([-0.42, 0.3, 0.1]), atol=1e-3, rtol=0)
    found = settle_hinges(made, placement, touching=True)
    assert (made.pivot[0].detach() - edge).norm() < 0.04
    assert_close(made.place(found)[0], before, atol=2e-4, rtol=0)  # the shifts make up for it


def test_a_hinge_that_nothing_touches_or_within_both_parts_stays():
    made = plates(0.0, strays=0)  # the lid lies on the base
    with torch.no_grad():
        made.pivot.copy_(torch.tensor([[0.0, 0.0, 0.0]]))
    assert (touch(made, 0) - made.pivot[0]).norm() < 0.03
    with torch.no_grad():
        made.logit.copy_(torch.tensor([8.0, 0.0]).expand_as(made.logit))  # no lid at all
    assert_close(touch(made, 0), made.pivot[0].detach())


def test_pivots_slide_to_their_part_and_axes_have_length_one() -> None:
    made = template()
    with torch.no_grad():
        made.pivot[0, 1] += 0.7
        made.axis[0] *= 8
    seat_hinges(made, placements(3))
    assert made.pivot[0, 1].abs() < 0.1
    assert_close(made.pivot[0, [0, 2]].detach(), torch.tensor([-0.2, -0.15]))
    assert_close(made.axis[0].norm().detach(), torch.tensor(1.0))


@pytest.mark.parametrize("axis", [[0.0, 1.0, 0.0], [0.5, 1.0, 0.3]])
def test_no_part_moves_where_pivots_slide(axis: list[float]) -> None:
    made, placement = plates(1.3), hinged_elsewhere(40, 8)  # of all sizes
    along = torch.nn.functional.normalize(torch.tensor(axis), dim=0)
    with torch.no_grad():
        made.axis[0] = along
        made.pivot[0] += 0.7 * along
    shift = placement.shift - (placement.shift @ along)[..., None] * along
    placement = replace(placement, shift=shift)
    before, _ = made.place(placement)
    found = seat_hinges(made, placement)
    assert_close(made.place(found)[0], before, atol=1e-5, rtol=0)
    assert_close(found.shift @ along, torch.zeros(40, 1), atol=1e-6, rtol=0)
