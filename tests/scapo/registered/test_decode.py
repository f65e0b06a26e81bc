# SPDX-License-Identifier: MIT
"""Predictions from placements: metres, the camera frame, one joint motion between the parts."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, invert, joint_motion, random_rotations
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.registered.decode import (
    canonical_surface,
    lying_rest,
    metric_limits,
    nearest_weights,
    placed_prediction,
)
from scapo.registered.joint_limits import limits_of
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import surface_normals
from tests.helpers.sighted import AXIS, PIVOT, sighted, template
from tests.helpers.strategies import generator

SIZES = (1.3, 0.9, 0.7)
"""By which a stretched object is larger along each direction."""


def half_open(angle: float) -> ArticulatedTemplate:
    """The template with its flap turned by an angle at state 0."""
    shape = template()
    with torch.no_grad():
        flap = shape.logit.argmax(-1) == 1
        turn = rotvec_to_rotmat(angle * AXIS)
        shape.points[flap] = (shape.points[flap] - PIVOT) @ turn.T + PIVOT
        shape.normals[flap] = shape.normals[flap] @ turn.T
    return shape


@pytest.mark.parametrize("deviation", [0.0, 0.2])
@pytest.mark.parametrize("own_hinges", [False, True])
@pytest.mark.parametrize("stretched", [False, True])
@torch.no_grad()
def test_parts_and_joint_of_a_prediction_belong_together(
    deviation: float, own_hinges: bool, stretched: bool
):
    cloud = torch.randn(3, 50, 3, generator=generator(0)) + torch.tensor([0, 0, 4.0])
    _, similarity = normalise(cloud)
    rotation = random_rotations(3, generator(1))
    state = torch.tensor([[0.2], [0.7], [1.1]])
    placement = Placement.at(rotation, 0.1 * torch.randn(3, 3, generator=generator(2)), state)
    aside = deviation * torch.randn(3, 1, 3, generator=generator(3))
    across = torch.tensor([0.05, 0, -0.08])  # hinges sit elsewhere on each body
    shift = torch.randn(3, 1, 3, generator=generator(4)) * across
    placement = replace(placement, deviation=aside, shift=shift)
    shape = template()
    if stretched:
        shape = half_open(0.7)
        sizes = torch.tensor([SIZES, (1.0, 1.0, 1.0), SIZES[::-1]])
        placement = replace(placement, log_scale=sizes.log())
    size = placement.log_scale.exp()
    away = torch.tensor([0.1, 0.2, -0.1])  # part frames sit at the base's middle, not the origin
    shape.points.add_(away)
    shape.pivot.add_(away)
    if deviation:
        shape.rest.fill_(-0.3)
        shape.load.fill_(0.1)
    if own_hinges:
        elsewhere = torch.tensor([0.07, -0.02, 0.05])
        placement = replace(placement, pivot=shape.pivots(placement) + elsewhere)
    weight, rest = torch.full((3, 50, 2), 0.5), lying_rest(shape, placement)
    origin = shape.part_centres()[0]
    found = placed_prediction(shape, placement, rest, origin, weight, similarity)
    assert found.camera_T_part is not None
    assert found.joints is not None
    base, lid = found.camera_T_part.unbind(1)
    motion = joint_motion(
        found.joints.pivot[:, 0], found.joints.axis[:, 0], found.joints.state[:, 0], "revolute"
    )
    assert bool(((rest - shape.rest).abs() > 1e-3).any()) == stretched
    assert_close(found.joints.state, state - rest)
    assert_close(lid, motion @ base, atol=1e-4, rtol=0)
    centre = apply(base, shape.part_centres()[0].expand(3, 1, 3) * 0)
    expected = similarity.inverse(
        (rotation @ (size * shape.part_centres()[0])[..., None]).mT + placement.translation[:, None]
    )
    assert_close(centre, expected, atol=1e-5, rtol=1e-5)
    assert_close(invert(base) @ base, torch.eye(4).expand(3, 4, 4), atol=1e-5, rtol=0)
    assert found.canonical_points is not None  # what the poses map from
    points = similarity.inverse(shape.place(placement)[0])
    for part, pose in ((0, base), (1, lid)):
        own = shape.logit.softmax(-1)[:, part] > 0.999
        carried = apply(pose, found.canonical_points[:, own])
        assert_close(carried, points[:, own], atol=2e-3, rtol=0)
    assert found.canonical_normals is not None
    assert found.canonical_part is not None
    facing = (base[:, None, :3, :3] @ found.canonical_normals[..., None])[..., 0]
    body = found.canonical_part[0] == 0
    assert_close(facing[:, body], shape.place(placement)[1][:, body], atol=2e-3, rtol=0)
    assert (found.canonical_part == shape.logit.argmax(-1)).all()
    still = canonical_surface(shape, placement, rest)[0] / size[:, None]
    assert_close(still[0, body], still[2, body], atol=2e-4, rtol=0)  # parts are blended a little


@pytest.mark.parametrize("angle", [-1.1, -0.3, 0.4, 0.8, 1.4])
@torch.no_grad()
def test_a_part_is_posed_as_it_lies_where_the_object_is_stretched(angle: float):
    shape, state = half_open(angle), torch.tensor([[0.0], [0.4], [-0.9]])
    still = Placement.at(torch.eye(3).expand(3, 3, 3), torch.zeros(3, 3), state)
    placement = replace(still, log_scale=torch.tensor(SIZES).log().expand(3, 3))
    # The flap is a plate from its hinge towards -x: where that goes, by trigonometry.
    lies = math.atan2(SIZES[2] * math.sin(angle), SIZES[0] * math.cos(angle))
    rest = lying_rest(shape, placement)
    assert_close(rest, torch.full((3, 1), angle - lies), atol=0.02, rtol=0)
    assert not lying_rest(shape, still).abs().max() > 1e-6
    _, similarity = normalise(torch.randn(3, 50, 3, generator=generator(0)))
    weight = torch.full((3, 50, 2), 0.5)
    origin = shape.part_centres()[0]
    found = placed_prediction(shape, placement, rest, origin, weight, similarity)
    assert found.camera_T_part is not None
    closed = found.camera_T_part[:, 1, :3, :3] @ rotvec_to_rotmat(angle * AXIS)
    flap = shape.logit.argmax(-1) == 1
    points = shape.place(placement)[0][:, flap]
    across = torch.linalg.svd(points - points.mean(1, keepdim=True)).Vh[:, -1]
    # Without stretching it is open by `angle` in the frame that it shares with the base.
    along = (across[:, None] @ closed)[:, 0, 2].abs()
    assert_close(along, torch.ones(3), atol=1e-3, rtol=0)


def test_weights_come_from_the_part_that_is_there():
    views, truth = sighted(2, seed=70)
    normals = surface_normals(views.points, views.points, views.camera)
    weight = nearest_weights(template(), views.points, normals, truth)
    fine = nearest_weights(template(seed=9, count=3000), views.points, normals, truth)
    assert (weight.argmax(-1) == fine.argmax(-1)).float().mean() > 0.95
    assert_close(weight.sum(-1), torch.ones(2, views.points.shape[1]), atol=1e-5, rtol=0)


def test_limits_are_in_the_units_and_from_the_zero_of_the_states():
    state = torch.linspace(0.2, 1.2, 101)[:, None]
    _, similarity = normalise(torch.randn(2, 50, 3, generator=generator(0)) * 3)
    turning, sliding = ArticulatedTemplate(("revolute",)), ArticulatedTemplate(("prismatic",))
    rest = torch.full((2, 1), 0.5)
    found = metric_limits(turning, limits_of(state, ("revolute",)), rest, similarity)
    assert_close(found, torch.tensor([[[-0.28, 0.68]]]).expand(2, 1, 2), atol=1e-5, rtol=0)
    found = metric_limits(sliding, limits_of(state, ("prismatic",)), rest, similarity)
    wanted = torch.tensor([0.22, 1.18]) / similarity.scale[:, None]
    assert_close(found[:, 0], wanted, atol=1e-5, rtol=1e-5)
