# SPDX-License-Identifier: MIT
"""Predictions from placements: metres, the camera frame, one joint motion between the parts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, invert, joint_motion, random_rotations
from scapo.registered.decode import (
    canonical_surface,
    metric_limits,
    nearest_weights,
    placed_prediction,
)
from scapo.registered.joint_limits import limits_of
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import surface_normals
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator


@pytest.mark.parametrize("deviation", [0.0, 0.2])
@pytest.mark.parametrize("own_hinges", [False, True])
@torch.no_grad()
def test_parts_and_joint_of_a_prediction_belong_together(deviation: float, own_hinges: bool):
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
    away = torch.tensor([0.1, 0.2, -0.1])  # part frames sit at the base's middle, not the origin
    shape.points.add_(away)
    shape.pivot.add_(away)
    if deviation:
        shape.rest.fill_(-0.3)
        shape.load.fill_(0.1)
    if own_hinges:
        elsewhere = torch.tensor([0.07, -0.02, 0.05])
        placement = replace(placement, pivot=shape.pivots(placement) + elsewhere)
    weight = torch.full((3, 50, 2), 0.5)
    found = placed_prediction(shape, placement, weight, similarity, torch.ones(3))
    assert found.camera_T_part is not None
    assert found.joints is not None
    base, lid = found.camera_T_part.unbind(1)
    motion = joint_motion(
        found.joints.pivot[:, 0], found.joints.axis[:, 0], found.joints.state[:, 0], "revolute"
    )
    assert_close(found.joints.state, state - shape.rest)
    assert_close(lid, motion @ base, atol=1e-4, rtol=0)
    centre = apply(base, shape.part_centres()[0].expand(3, 1, 3) * 0)
    expected = similarity.inverse(
        (rotation @ shape.part_centres()[0])[:, None] + placement.translation[:, None]
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
    turned = (base[:, None, :3, :3] @ found.canonical_normals[..., None])[..., 0]
    body = found.canonical_part[0] == 0
    assert_close(turned[:, body], shape.place(placement)[1][:, body], atol=2e-3, rtol=0)
    assert (found.canonical_part == shape.logit.argmax(-1)).all()
    still = canonical_surface(shape, placement)[0]
    assert_close(still[0, body], still[2, body], atol=2e-4, rtol=0)  # parts are blended a little


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
    turning.rest.fill_(0.5)
    found = metric_limits(turning, limits_of(state, ("revolute",)), similarity)
    assert_close(found, torch.tensor([[[-0.28, 0.68]]]).expand(2, 1, 2), atol=1e-5, rtol=0)
    found = metric_limits(sliding, limits_of(state, ("prismatic",)), similarity)
    wanted = torch.tensor([0.22, 1.18]) / similarity.scale[:, None]
    assert_close(found[:, 0], wanted, atol=1e-5, rtol=1e-5)
