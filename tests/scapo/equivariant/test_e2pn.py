# SPDX-License-Identifier: MIT
"""E2PN's convolution on the 12 vertices: as its sum is written, and turning with the cloud."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.equivariant.anchors import icosahedron
from scapo.equivariant.e2pn import ORBITS, QuotientConv, orbits, to_rotations
from scapo.equivariant.levels import (
    SIGMA,
    Neighbourhood,
    kernel_points,
    neighbourhood,
)
from tests.helpers.strategies import normal

GROUP = icosahedron()


def test_orbits_share_what_the_turns_about_a_vertex_cannot_tell_apart() -> None:
    found = orbits()
    assert len(found) == ORBITS
    assert sorted(pair for row in found for pair in row) == list(range(13 * 12))
    points = kernel_points(1.0)
    for row in found:
        measured = set()
        for pair in row:
            k, u = points[pair // 12], GROUP.vertices[pair % 12]
            sizes = (k @ GROUP.vertices[0], u @ GROUP.vertices[0], k @ u,
                     torch.linalg.det(torch.stack([k, u, GROUP.vertices[0]])))  # fmt: skip
            measured.add(tuple(round(float(size), 6) + 0.0 for size in sizes))
        assert len(measured) == 1  # the invariants of two vectors and an axis


def naive(conv: QuotientConv, features: Tensor, points: Tensor, near: Neighbourhood) -> Tensor:
    """The sum as its docstring has it: every pair turned by a rotation that leads to v."""
    matrices = conv.linear.weight.mT.unflatten(0, (ORBITS, -1))
    out = torch.zeros(1, 1, 12, matrices.shape[2], dtype=torch.float64)
    steps = points[0, near.index[0, 0]] - points[0, near.centre[0, 0]]
    inside = steps.norm(dim=1) <= 1.4
    for v in range(12):
        turn = GROUP.rotations[5 * v + 3]  # any of the five
        for o, pairs in enumerate(orbits()):
            for pair in pairs:
                off = (steps - turn @ kernel_points(1.4)[pair // 12]).square().sum(1)
                weight = (1 - off / (SIGMA * 1.4**2)).clamp_min(0) * inside / inside.sum()
                u = (GROUP.vertices - turn @ GROUP.vertices[pair % 12]).norm(dim=1).argmin()
                feature = features[0, near.index[0, 0], u if features.shape[2] == 12 else 0]
                out[0, 0, v] += (weight @ feature) @ matrices[o]
    return out


@pytest.mark.parametrize("anchors", [12, 1])
def test_the_convolution_is_its_sum(anchors: int) -> None:
    points = normal(0, 1, 12, 3)
    near = neighbourhood(points, torch.tensor([[5]]), 1.4, 4)
    conv, features = QuotientConv(2, 3).double(), normal(1, 1, 12, anchors, 2)
    assert_close(conv(features, near), naive(conv, features, points, near))


def test_rotations_see_the_vertices_in_their_own_order() -> None:
    seen = to_rotations(GROUP.vertices).view(60, 12, 3)
    for a in range(60):
        assert_close(seen[a], GROUP.vertices @ GROUP.rotations[a].mT)


def test_gradients_are_the_numerical_ones() -> None:
    points = normal(4, 1, 5, 3)
    near = neighbourhood(points, torch.tensor([[0]]), 1.4, 3)
    conv = QuotientConv(1, 1).double()
    features = normal(5, 1, 5, 12, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: conv(x, near), (features,))
