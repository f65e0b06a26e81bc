# SPDX-License-Identifier: MIT
"""The joint fit: its loss at the truth, states found on a grid, a wrong joint put right."""

from __future__ import annotations

from dataclasses import replace

import torch

from scapo.geometry.rigid import axis_angle, point_line_distance
from scapo.registered.bundle_adjustment import (
    FitOptions,
    fit,
    oriented_nearest,
    search_states,
    thin,
    view_loss,
)
from tests.helpers.sighted import AXIS, PIVOT, sighted, template
from tests.helpers.strategies import generator


@torch.no_grad()
def test_the_loss_is_least_at_the_truth():
    views, truth = sighted(4, seed=10)
    shape = template()
    right = view_loss(views, shape.place(truth), 250.0)
    for wrong in (
        replace(truth, state=truth.state + 0.4),
        replace(truth, translation=truth.translation + 0.1),
        replace(truth, rotation=truth.rotation @ torch.diag(torch.tensor([-1.0, -1.0, 1.0]))),
    ):
        loss = view_loss(views, shape.place(wrong), 250.0)
        assert loss.mean() > right.mean() + 0.05
        assert (loss > right).sum() >= 3  # the flap is edge-on in one view


def test_the_two_faces_of_a_plate_are_told_apart():
    up, point = torch.tensor([[[0.0, 0, 1]]]), torch.zeros(1, 1, 3)
    faces = torch.cat([point, point + torch.tensor([0, 0, 0.01])], 1)
    normals = torch.cat([up, -up], 1)
    assert oriented_nearest(point + 0.004 * up, up, faces, normals).item() == 0
    assert oriented_nearest(point + 0.004 * up, -up, faces, normals).item() == 1


def test_states_are_found_on_a_grid():
    views, truth = sighted(4, seed=11)
    start = replace(truth, state=torch.full_like(truth.state, -1.0))
    grid = torch.linspace(-1, 1.5, 26)[None]
    found = search_states(template(), thin(views, torch.arange(128)), start, grid, 150.0)
    assert (found.state - truth.state).abs().max() < 0.16


def test_a_wrong_joint_is_put_right():
    views, truth = sighted(12, seed=12)
    shape = template()
    with torch.no_grad():
        shape.axis.copy_(torch.nn.functional.normalize(AXIS + 0.3 * torch.ones(3), dim=0)[None])
        shape.pivot.copy_((PIVOT + torch.tensor([0.06, 0, 0.05]))[None])
    before = axis_angle(shape.directions()[0].detach(), AXIS).rad2deg()
    options = FitOptions(steps=60)
    _, loss = fit(shape, views, truth, options, generator=generator(0))
    axis = shape.directions()[0].detach()
    assert axis_angle(axis, AXIS).rad2deg() < before / 3
    assert point_line_distance(shape.pivot[0].detach(), PIVOT, AXIS) < 0.05
    assert loss.mean() < 0.35
