# SPDX-License-Identifier: MIT
"""What the convolutions of EPN and E2PN have in common: they turn with a cloud, and compile."""

from __future__ import annotations

import copy
import subprocess
import sys

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.equivariant.anchors import icosahedron, turned
from scapo.equivariant.e2pn import QuotientBlock, QuotientConv, to_rotations
from scapo.equivariant.epn import PointConv, SeparableBlock
from scapo.equivariant.levels import LevelConfig, levels, neighbourhood
from scapo.records import map_tensors
from tests.helpers.strategies import normal

LAYERS = (
    LevelConfig(radius=1.0, neighbours=8, stride=2),
    LevelConfig(radius=1.6, neighbours=8, stride=2),
)
Block = type[SeparableBlock] | type[QuotientBlock]
each_block = pytest.mark.parametrize(
    ("kind", "anchors"), [(SeparableBlock, 60), (QuotientBlock, 12)]
)


@each_block
@torch.no_grad()
def test_a_network_turns_with_its_cloud_by_all_sixty(kind: Block, anchors: int) -> None:
    blocks = [kind(1, 8, slope=0.1), kind(8, 8)]
    points = normal(3, 2, 64, 3, dtype=torch.float32)

    def network(points: Tensor) -> Tensor:
        near, _ = levels(points, LAYERS)
        features = torch.ones(*points.shape[:2], 1, 1)
        for block, one in zip(blocks, near, strict=True):
            features = block(features, one)
        return features

    for _ in range(20):
        network(points)  # batch statistics
    for block in blocks:
        block.eval()
    out = network(points)
    assert (out.amax(2) - out.amin(2)).max() > 0.1  # anchors differ
    for g in range(60):
        moved = network(points @ icosahedron().rotations[g].float().mT + 1)
        assert_close(moved[:, :, turned(g, anchors)], out, atol=1e-4, rtol=0)
        assert_close(moved.amax(2), out.amax(2), atol=1e-4, rtol=0)
        if anchors == 12:
            lifted = to_rotations(moved)[:, :, turned(g, 60)]
            assert_close(lifted, to_rotations(out), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("kind", "anchors"), [(PointConv, 60), (QuotientConv, 12)])
def test_recomputed_correlations_change_no_gradient(
    kind: type[PointConv] | type[QuotientConv], anchors: int
) -> None:
    near = neighbourhood(normal(0, 2, 12, 3), torch.tensor([[0, 5], [3, 1]]), 1.4, 3)
    kept, features = kind(2, 3).double(), normal(6, 2, 12, anchors, 2)
    again = copy.deepcopy(kept)
    again.recompute = True
    found = []
    for conv in (kept, again):
        x = features.clone().requires_grad_()
        conv(x, near).square().sum().backward()
        assert conv.linear.weight.grad is not None
        found.append((x.grad, conv.linear.weight.grad))
    assert_close(found[0], found[1])


@each_block
def test_blocks_ask_no_tensor_for_its_values(kind: Block, anchors: int) -> None:
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
