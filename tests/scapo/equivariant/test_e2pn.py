# SPDX-License-Identifier: MIT
"""E2PN's convolution on the 12 vertices: as its sum is written, and turning with the cloud."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from scapo.equivariant.anchors import icosahedron, turned
from scapo.equivariant.e2pn import ORBITS, QuotientBlock, QuotientConv, orbits, to_rotations
from scapo.equivariant.epn import SeparableBlock
from scapo.equivariant.levels import (
    SIGMA,
    LevelConfig,
    Neighbourhood,
    kernel_points,
    levels,
    neighbourhood,
)
from scapo.records import map_tensors
from tests.helpers.strategies import normal

GROUP = icosahedron()
LAYERS = (
    LevelConfig(radius=1.0, neighbours=8, stride=2),
    LevelConfig(radius=1.6, neighbours=8, stride=2),
)


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


def network(points: Tensor, blocks: list[QuotientBlock]) -> Tensor:
    near, _ = levels(points, LAYERS)
    features = torch.ones(*points.shape[:2], 1, 1)
    for block, one in zip(blocks, near, strict=True):
        features = block(features, one)
    return features


def test_a_network_turns_with_its_cloud_by_all_sixty() -> None:
    blocks = [QuotientBlock(1, 8, slope=0.1), QuotientBlock(8, 8)]
    points = normal(3, 2, 64, 3, dtype=torch.float32)
    with torch.no_grad():
        for _ in range(20):
            network(points, blocks)  # batch statistics
        for block in blocks:
            block.eval()
        out = network(points, blocks)
        lifted = to_rotations(out)
        assert (out.amax(2) - out.amin(2)).max() > 0.1  # anchors differ
        for g in range(60):
            moved = network(points @ GROUP.rotations[g].float().mT + 1, blocks)
            assert_close(moved[:, :, turned(g, 12)], out, atol=1e-4, rtol=0)
            assert_close(moved.amax(2), out.amax(2), atol=1e-4, rtol=0)
            assert_close(to_rotations(moved)[:, :, turned(g, 60)], lifted, atol=1e-4, rtol=0)


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


def test_recomputed_correlations_change_no_gradient() -> None:
    near = neighbourhood(normal(0, 2, 12, 3), torch.tensor([[0, 5], [3, 1]]), 1.4, 3)
    kept, features = QuotientConv(2, 3).double(), normal(6, 2, 12, 12, 2)
    again = copy.deepcopy(kept)
    again.recompute = True
    found = []
    for conv in (kept, again):
        x = features.clone().requires_grad_()
        conv(x, near).square().sum().backward()
        assert conv.linear.weight.grad is not None
        found.append((x.grad, conv.linear.weight.grad))
    assert_close(found[0], found[1])


@pytest.mark.parametrize(("kind", "anchors"), [(SeparableBlock, 60), (QuotientBlock, 12)])
def test_blocks_ask_no_tensor_for_its_values(
    kind: Callable[[int, int], nn.Module], anchors: int
) -> None:
    """Which would cut a compiler's graph in two: these have none to tell."""
    near = neighbourhood(normal(0, 1, 9, 3).float(), torch.tensor([[0, 5]]), 1.4, 4)
    block = kind(2, 3).to("meta")
    x = torch.zeros(1, 9, anchors, 2, device="meta", requires_grad=True)
    out = block(x, map_tensors(near, lambda one: one.to("meta")))
    out.square().sum().backward()
    assert out.shape == (1, 2, anchors, 3)
    assert x.grad is not None
    assert (out.is_meta, x.grad.is_meta) == (True, True)


@pytest.mark.slow
def test_blocks_compile_into_one_graph() -> None:
    """In a process of its own, without shape checks; the compiler's front alone, which is quick."""
    program = """
import torch
from scapo.equivariant.e2pn import QuotientBlock
from scapo.equivariant.epn import SeparableBlock
from scapo.equivariant.levels import neighbourhood

points = torch.randn(1, 9, 3)
near = neighbourhood(points, torch.tensor([[0, 5]]), 1.4, 4)
for block, anchors in ((SeparableBlock(2, 3), 60), (QuotientBlock(2, 3), 12)):
    found, start = [], torch.randn(1, 9, anchors, 2)
    for forward in (block, torch.compile(block, backend="aot_eager", fullgraph=True)):
        x = start.clone().requires_grad_()
        forward(x, near).square().sum().backward()
        found.append(x.grad)
    torch.testing.assert_close(*found)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
