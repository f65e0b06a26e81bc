# SPDX-License-Identifier: MIT
"""A sliding part's axis: the way out of the body, not the way in which its place differs most."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.registered.bundle_adjustment import across_axis, search_states
from scapo.registered.gauge import choose_axes, protrusion
from scapo.registered.template import ArticulatedTemplate, Placement
from tests.helpers.sliding import OUT, UP, cabinet, placements, seen
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


@pytest.mark.parametrize("axis", [OUT, UP, torch.tensor([0.6, 0.0, 0.8])])
def test_across_an_axis(axis: Tensor):
    frame = torch.stack([axis, *across_axis(axis)])
    assert_close(frame @ frame.T, torch.eye(3))


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
