# SPDX-License-Identifier: MIT
"""Refinement: derivatives against differences, perturbed placements brought back, states found."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch

from scapo.categories import JointKind
from scapo.geometry.rigid import random_rotations, rotation_angle
from scapo.registered.pose_refinement import (
    Motion,
    Skin,
    StepOptions,
    _move,
    refine_gauss_newton,
    search_states,
)
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_loss import view_loss
from tests.helpers.sighted import sighted, template
from tests.helpers.sliding import OUT, UP, cabinet, placements, seen
from tests.helpers.strategies import generator


@pytest.mark.parametrize("aside", [0.0, 0.2])
@pytest.mark.parametrize(
    "kinds", [("revolute", "revolute"), ("prismatic",), ("revolute", "prismatic")]
)
def test_derivatives_agree_with_differences(kinds: tuple[JointKind, ...], aside: float):
    g, joints = generator(0), len(kinds)
    made = ArticulatedTemplate(kinds, 20).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=g))
    axis = made.directions().detach()
    shift = 0.1 * torch.randn(3, joints, 3, generator=g).double()
    sliding = torch.tensor([[float(kind == "prismatic")] for kind in kinds])
    placement = replace(
        Placement.at(
            random_rotations(3, g).double(),
            torch.randn(3, 3, generator=g).double(),
            torch.randn(3, joints, generator=g).double(),
        ),
        log_scale=0.2 * torch.randn(3, 3, generator=g).double(),
        shift=(shift - (shift * axis).sum(-1, keepdim=True) * axis) * sliding,
        deviation=aside * torch.randn(3, joints, 3, generator=g).double() * (1 - sliding),
    )
    made.rest.copy_(torch.randn(joints, generator=g))
    with torch.no_grad():
        motion, skin = Motion.of(made, placement), Skin.of(made)
        for ours, theirs in zip(motion.place(skin), made.place(placement), strict=True):
            torch.testing.assert_close(ours, theirs)
        for column in range(motion.jacobian.shape[-1]):
            step = torch.zeros(3, motion.jacobian.shape[-1]).double()
            step[:, column] = 1e-6
            after, before = (made.place(_move(made, placement, sign * step))[0] for sign in (1, -1))
            torch.testing.assert_close(
                (after - before) / 2e-6,
                skin.points @ motion.jacobian[..., column],
                atol=1e-6,
                rtol=1e-5,
            )


def test_perturbed_placements_come_back():
    views, truth = sighted(12, seed=70)
    g = generator(1)
    start = replace(
        truth,
        rotation=roma.rotvec_to_rotmat(0.2 * torch.randn(12, 3, generator=g)) @ truth.rotation,
        translation=truth.translation + 0.02 * torch.randn(12, 3, generator=g),
        state=truth.state + 0.2 * torch.randn(12, 1, generator=g),
    )
    made = template()
    found = refine_gauss_newton(made, views, start, StepOptions(steps=12, points=192))
    errors = rotation_angle(found.rotation, truth.rotation).rad2deg()
    assert errors.median() < 2
    assert (found.state - truth.state).abs().median() < 0.04
    with torch.no_grad():
        after, before = (view_loss(views, made.place(p), 250.0) for p in (found, start))
    assert (after < before).all()


def test_states_are_found_on_a_grid():
    views, truth = sighted(4, seed=11)
    start = replace(truth, state=torch.full_like(truth.state, -1.0))
    grid = torch.linspace(-1, 1.5, 26)[None]
    found = search_states(template(), views.thinned(torch.arange(128)), start, grid, 150.0)
    assert (found.state - truth.state).abs().max() < 0.16


def test_the_place_of_a_sliding_part_is_searched_too():
    template, truth = cabinet(OUT), placements(4)
    truth = replace(truth, state=torch.full((4, 1), 0.1), shift=truth.state[..., None] * UP)
    views = seen(cabinet(OUT, 7, 4000), truth)
    lost = replace(truth, shift=torch.zeros_like(truth.shift))
    found = lost
    for _ in range(2):  # the state was first sought at a wrong place
        found = search_states(template, views, found, torch.linspace(-0.2, 0.2, 9)[None], 120.0)
    assert (truth.shift.norm(dim=-1) > 0.1).any()
    assert (found.shift - truth.shift).norm(dim=-1).max() < 0.04
    assert (found.state - truth.state).abs().max() < 0.06
