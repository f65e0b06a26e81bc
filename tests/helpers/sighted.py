# SPDX-License-Identifier: MIT
"""A box with a hinged flap, seen by a camera: views, placements and truth for the search tests."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from scapo.geometry.rigid import random_rotations
from scapo.records import cat
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.views import PartialViews, observe
from tests.helpers.strategies import generator

AXIS = torch.tensor([0.0, 1.0, 0.0])
PIVOT = torch.tensor([-0.2, 0.0, -0.15])


def box(half: Tensor, count: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points on the surface of a box about the origin, its half sides given, and normals."""
    face = torch.randint(3, (count,), generator=g)
    side = torch.randint(0, 2, (count,), generator=g) * 2.0 - 1
    points = (2 * torch.rand(count, 3, generator=g) - 1) * half
    rows = torch.arange(count)
    points[rows, face] = side * half[face]
    normals = torch.zeros(count, 3)
    normals[rows, face] = side
    return points, normals


def surface(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points, outward normals and parts of an oblong box (0) with a flap (1) at state 0."""
    g = generator(seed)
    points, normals = box(torch.tensor([0.2, 0.28, 0.15]), count, g)
    flap = torch.rand(count, generator=g) < 0.4
    u, v = torch.rand(2, count, generator=g)
    lid = torch.stack([-0.2 - 0.3 * u, 0.5 * v - 0.25, torch.full((count,), -0.15)], -1)
    up = (torch.rand(count, generator=g) < 0.5).float() * 2 - 1
    lid[:, 2] += 0.01 * up
    points = torch.where(flap[:, None], lid, points)
    normals = torch.where(flap[:, None], up[:, None] * torch.tensor([0.0, 0.0, 1.0]), normals)
    return points, normals, flap.long()


def template(seed: int = 0, count: int = 400) -> ArticulatedTemplate:
    """The object itself as a template."""
    points, normals, part = surface(count, seed)
    made = ArticulatedTemplate(("revolute",), count)
    made.assign(points, normals, 8.0 * torch.nn.functional.one_hot(part, 2))
    with torch.no_grad():
        made.axis.copy_(AXIS[None])
        made.pivot.copy_(PIVOT[None])
    return made


def without_a_side() -> ArticulatedTemplate:
    """The box with its flap, but without its side at positive y."""
    whole = template(count=500)
    kept = (whole.normals[:, 1] < 0.8) | (whole.logit.argmax(-1) == 1)
    cut = whole.with_points(400)
    cut.assign(whole.points[kept][:400], whole.normals[kept][:400], whole.logit[kept][:400])
    return cut


def sighted(count: int, seed: int = 0, deviation: float = 0.0) -> tuple[PartialViews, Placement]:
    """Views of the object from about one side, at states 0 to 1, with their true placements.

    Only back faces are left out, as a convex object's view would.

    Args:
        count: Of views.
        seed: Of all that is drawn.
        deviation: Every other view's axis deviates by this angle (rad) to one side, the others' to
            the other; the flap rests flat at state 0.
    """
    g = generator(seed)
    rotation = random_rotations(count, g)
    offset = 0.7 * torch.randn(count, 3, generator=g)
    away = torch.nn.functional.normalize(torch.tensor([-1.5, 0.0, 1.0]) + offset, dim=-1)
    camera = 2.0 * (rotation @ away[..., None])[..., 0]
    state = torch.rand(count, 1, generator=g)
    clouds, placements = [], []
    for b in range(count):
        whole = template(seed + b + 1, 4000)
        placement = Placement.at(rotation[b : b + 1], torch.zeros(1, 3), state[b : b + 1])
        placement.deviation[..., 0] = deviation * (-1) ** b
        with torch.no_grad():
            points, normals = (x[0] for x in whole.place(placement))
        seen = ((camera[b] - points) * normals).sum(-1) > 0
        kept = points[seen][:600]
        centre = kept.mean(0)
        clouds.append((kept - centre)[torch.randperm(600, generator=g)])
        camera[b] -= centre
        placements.append(replace(placement, translation=-centre[None]))
    return observe(torch.stack(clouds), camera), cat(placements)
