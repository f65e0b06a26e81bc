# SPDX-License-Identifier: MIT
"""EPN's convolutions: as their sums are written, and turning with the cloud."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.equivariant.anchors import icosahedron
from scapo.equivariant.epn import GroupConv, PointConv, least_turns
from scapo.equivariant.levels import (
    KERNEL,
    SIGMA,
    Neighbourhood,
    kernel_points,
    neighbourhood,
)
from tests.helpers.strategies import normal

GROUP = icosahedron()


def some(seed: int = 0, count: int = 12) -> tuple[Tensor, Neighbourhood]:
    points = normal(seed, 2, count, 3)
    return points, neighbourhood(points, torch.tensor([[0], [3]]), 1.4, 4)


def naive(conv: PointConv, features: Tensor, points: Tensor, near: Neighbourhood) -> Tensor:
    """The sum as its docstring has it: the kernel turned by each anchor in turn."""
    matrices = conv.linear.weight.mT.unflatten(0, (KERNEL, -1))
    out = torch.zeros(2, 1, 60, matrices.shape[2], dtype=torch.float64)
    for b in range(2):
        steps = points[b, near.index[b, 0]] - points[b, near.centre[b, 0]]
        inside = steps.norm(dim=1) <= 1.4
        for a in range(60):
            feature = features[b, near.index[b, 0], a if features.shape[2] == 60 else 0]
            for k, point in enumerate(kernel_points(1.4)):
                off = (steps - GROUP.rotations[a] @ point).square().sum(1)
                weight = (1 - off / (SIGMA * 1.4**2)).clamp_min(0) * inside / inside.sum()
                out[b, 0, a] += (weight @ feature) @ matrices[k]
    return out


@pytest.mark.parametrize("anchors", [60, 1])
def test_the_point_convolution_is_its_sum(anchors: int) -> None:
    points, near = some()
    conv, features = PointConv(2, 3).double(), normal(1, 2, 12, anchors, 2)
    assert_close(conv(features, near), naive(conv, features, points, near))


def test_the_group_convolution_is_its_sum() -> None:
    conv, features = GroupConv(2, 3).double(), normal(2, 1, 2, 60, 2)
    matrices, near = conv.linear.weight.mT.unflatten(0, (13, 2)), least_turns()
    wanted = torch.zeros(1, 2, 60, 3, dtype=torch.float64)
    for a in range(60):
        for j, h in enumerate(near):
            turn = GROUP.rotations[a] @ GROUP.rotations[h]
            other = (GROUP.rotations - turn).flatten(1).norm(dim=1).argmin()
            wanted[:, :, a] += features[:, :, other] @ matrices[j]
    assert_close(conv(features), wanted)


def test_the_group_kernel_is_the_identity_and_the_fifth_turns() -> None:
    near = least_turns()
    assert near[0] == 0
    trace = GROUP.rotations[near].diagonal(dim1=1, dim2=2).sum(-1)
    fifth = 1 + 2 * torch.cos(torch.tensor(2 * torch.pi / 5, dtype=torch.float64))
    assert_close(trace[1:], fifth.expand(12))


def test_gradients_are_the_numerical_ones() -> None:
    points = normal(4, 1, 5, 3)
    near = neighbourhood(points, torch.tensor([[0]]), 1.4, 3)
    conv, group = PointConv(1, 1).double(), GroupConv(1, 1).double()
    features = normal(5, 1, 5, 60, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: conv(x, near), (features,))
    assert torch.autograd.gradcheck(group, (features[:, :1].detach().requires_grad_(),))
