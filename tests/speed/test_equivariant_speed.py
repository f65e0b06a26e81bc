# SPDX-License-Identifier: MIT
"""Equivariant convolutions against the plain way of writing them: time and kept memory."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

from scapo.equivariant.anchors import icosahedron
from scapo.equivariant.e2pn import QuotientConv
from scapo.equivariant.epn import PointConv
from scapo.equivariant.layers import rows
from scapo.equivariant.levels import SIGMA, Neighbourhood, kernel_points, neighbourhood

pytestmark = pytest.mark.usefixtures("one_thread")

BATCH, POINTS, CENTRES, NEAR, CHANNELS = 2, 256, 128, 16, 16
RADIUS = 0.15


def data(anchors: int) -> tuple[Tensor, Neighbourhood, Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = 0.15 * torch.randn(BATCH, POINTS, 3, generator=generator)
    centre = torch.arange(0, POINTS, POINTS // CENTRES).expand(BATCH, -1)
    features = torch.randn(BATCH, POINTS, anchors, CHANNELS, generator=generator)
    return points, neighbourhood(points, centre, RADIUS, NEAR), features.requires_grad_()


def plain(conv: PointConv, points: Tensor, near: Neighbourhood, features: Tensor) -> Tensor:
    """The kernel turned by every anchor, its weights with every neighbour, (B, K, 60, 13, L)."""
    kernel = torch.einsum("aij,pj->api", icosahedron().rotations, kernel_points(RADIUS)).float()
    step = rows(points, near.index) - rows(points, near.centre)[:, :, None]
    inside = step.norm(dim=-1) <= RADIUS
    off = (step[:, :, None, None] - kernel[:, :, None]).square().sum(-1)
    weight = (1 - off / (SIGMA * RADIUS**2)).relu() * inside[:, :, None, None]
    weight = weight / inside.sum(-1).clamp_min(1)[..., None, None, None]
    group = rows(features.flatten(2), near.index).unflatten(3, (60, CHANNELS))
    found = torch.einsum("bkapl,bklac->bkapc", weight, group)
    return conv.linear(found.flatten(3))


def kept_bytes(run: Callable[[], Tensor]) -> int:
    """What the graph of a forward pass keeps for the backward pass, each storage once."""
    storages: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        run()
    return sum(storages.values())


@pytest.mark.parametrize("form", ["ours", "recomputed", "plain"])
def test_point_convolution(benchmark: BenchmarkFixture, form: str):
    points, near, features = data(60)
    conv = PointConv(CHANNELS, CHANNELS, recompute=form == "recomputed")

    def run() -> Tensor:
        if form == "plain":
            return plain(conv, points, near, features)
        return conv(features, near)

    torch.testing.assert_close(run(), plain(conv, points, near, features), atol=1e-5, rtol=1e-4)
    benchmark.extra_info["kept_MiB"] = kept_bytes(run) / 2**20
    benchmark(lambda: run().sum().backward())


@pytest.mark.parametrize("recompute", [False, True])
def test_quotient_convolution(benchmark: BenchmarkFixture, recompute: bool):
    _, near, features = data(12)
    conv = QuotientConv(CHANNELS, CHANNELS, recompute=recompute)
    benchmark.extra_info["kept_MiB"] = kept_bytes(lambda: conv(features, near)) / 2**20
    benchmark(lambda: conv(features, near).sum().backward())
