# SPDX-License-Identifier: MIT
"""Pictures of the registered variant: as many panels as asked, parts and joints in them."""

from __future__ import annotations

import torch

from scapo.registered.figures import template_pictures
from scapo.registered.joint_limits import JointLimits
from scapo.registered.template import Placement
from tests.helpers.sighted import template


def test_the_template_opens_and_lies_on_its_own_points():
    made = template()
    states = JointLimits(low=torch.zeros(1), high=torch.ones(1), unit=torch.ones(1))
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))[None]
    placement = Placement.at(turn, torch.tensor([[0.1, 0.0, 0.0]]), torch.tensor([[0.4]]))
    with torch.no_grad():
        cloud, _ = made.place(placement)
        shown = template_pictures(made, states, cloud, placement)
    closed, _, opened = shown["template"].panels
    moved = (closed.points - opened.points).norm(dim=-1)
    assert opened.part is not None
    assert moved[opened.part == 0].max() < 1e-2
    assert moved[opened.part == 1].max() > 0.2
    over = shown["reconstruction"].panels[0]
    assert over.beneath is not None
    assert torch.allclose(over.points, over.beneath)
    base = made.logit.argmax(-1) == 0
    canonical = shown["canonical"].panels[0].beneath
    assert canonical is not None
    assert torch.allclose(canonical[base], made.points[base], atol=1e-2)
