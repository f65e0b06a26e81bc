# SPDX-License-Identifier: MIT
"""Views: normals of a sphere, and what a camera that sees a plate says of points about it."""

from __future__ import annotations

import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from scapo.records import take
from scapo.registered.views import observe, surface_normals
from tests.helpers.strategies import generator


def plate(count: int = 900) -> torch.Tensor:
    """A square of side 0.6 in the plane z = 0."""
    flat = 0.6 * torch.rand(count, 2, generator=generator(0)) - 0.3
    return torch.cat([flat, torch.zeros(count, 1)], -1)


def test_normals_of_a_sphere_point_outwards():
    cloud = normalize(torch.randn(1, 3000, 3, generator=generator(1)), dim=-1) * 0.25
    seen = cloud[:, cloud[0, :, 2] > 0.05]
    normals = surface_normals(seen[:, :50], seen, torch.tensor([[0.0, 0.0, 3.0]]))
    cosine = (normals * normalize(seen[:, :50], dim=-1)).sum(-1)
    assert cosine.min() > 0.95


def test_free_in_front_hidden_behind_and_free_beside():
    views = observe(plate()[None], torch.tensor([[0.3, -0.2, 2.0]]))
    points = torch.tensor([[[0.0, 0, 0], [0.05, 0, 0.2], [0.05, 0, -0.2], [0.6, 0, 0]]])
    free, hidden = views.free_and_hidden(points, 0.05)
    assert free.tolist() == [[False, True, False, True]]
    assert hidden.tolist() == [[False, False, True, False]]


def test_views_turn_with_the_cloud():
    turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    cloud, camera = plate()[None], torch.tensor([[0.3, -0.2, 2.0]])
    plain, turned = observe(cloud, camera), observe(cloud @ turn.T, camera @ turn.T)
    assert_close(turned.points, plain.points @ turn.T)
    assert_close(turned.normals, plain.normals @ turn.T, atol=1e-3, rtol=0)
    assert_close(take(plain, torch.tensor([0])).camera, camera)
