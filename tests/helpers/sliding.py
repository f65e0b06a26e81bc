# SPDX-License-Identifier: MIT
"""A cabinet with a drawer: templates, placements and views for the tests of sliding parts."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from scapo.geometry.rigid import random_rotations
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import PartialViews, observe
from tests.helpers.sighted import box
from tests.helpers.strategies import generator

OUT, UP = torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
BODY, DRAWER = torch.tensor([0.2, 0.15, 0.25]), torch.tensor([0.19, 0.12, 0.05])


def cabinet(axis: Tensor, seed: int = 0, count: int = 400) -> ArticulatedTemplate:
    """A body with a drawer, their joint along `axis`."""
    halves = [box(half, count // 2, generator(seed)) for half in (BODY, DRAWER)]
    made = ArticulatedTemplate(("prismatic",), count)
    part = torch.arange(count) // (count // 2)
    points, normals = (torch.cat(columns) for columns in zip(*halves, strict=True))
    made.assign(points, normals, 20.0 * torch.nn.functional.one_hot(part, 2))
    with torch.no_grad():
        made.axis.copy_(axis[None])
    return made


def placements(count: int = 40) -> Placement:
    """Drawers opened by up to 0.15 at heights that differ more than that, as states along UP."""
    g = generator(3)
    opened, height = 0.15 * torch.rand(count, generator=g), 0.4 * torch.rand(count, generator=g)
    at = Placement.at(random_rotations(count, g), torch.zeros(count, 3), height[:, None] - 0.2)
    return replace(at, shift=opened[:, None, None] * OUT)


def seen(template: ArticulatedTemplate, placement: Placement) -> PartialViews:
    """Views of the placed template from in front, to the side and above."""
    away = torch.nn.functional.normalize(torch.tensor([-1.5, 0.7, 0.8]), dim=0)
    camera = 2.0 * placement.rotation @ away
    with torch.no_grad():
        points, normals = template.place(placement)
    facing = ((camera[:, None] - points) * normals).sum(-1)
    index = facing.topk(1200, dim=1).indices[..., None].expand(-1, -1, 3)
    return observe(points.gather(1, index), camera)
