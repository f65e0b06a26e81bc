# SPDX-License-Identifier: MIT
"""How fast the hot parts are, one thread: `make bench`. Nothing here is run by `make test`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

from scapo.first_weights import initialise
from scapo.geometry import points
from scapo.paper.autoencoder import Encoder, EncoderConfig
from scapo.paper.skinning import Bones
from scapo.paper.vector_neurons import VNBlock

pytestmark = pytest.mark.usefixtures("one_thread")

BATCH, POINTS, PARTS = 8, 1024, 2
SAMPLES = 64


@pytest.fixture
def clouds() -> Tensor:
    """Two sets of clouds of mean radius about 0.25 m, (2, B, N, 3)."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, BATCH, POINTS, 3, generator=generator) * 0.15


def forward_backward(function: Callable[[], Tensor]) -> Callable[[], None]:
    return lambda: function().sum().backward()


def test_chamfer_with_gradients(benchmark: BenchmarkFixture, clouds: Tensor):
    a, b = clouds[0].requires_grad_(), clouds[1]
    benchmark(forward_backward(lambda: points.chamfer(a, b)))
    assert a.grad is not None


def test_k_nearest(benchmark: BenchmarkFixture, clouds: Tensor):
    found = benchmark(points.k_nearest, clouds[0], clouds[0], 20)
    assert found.shape == (BATCH, POINTS, 20)


def test_farthest_points(benchmark: BenchmarkFixture, clouds: Tensor):
    assert benchmark(points.farthest_points, clouds[0], 128).shape == (BATCH, 128)


def test_skinning_weights(benchmark: BenchmarkFixture, clouds: Tensor):
    bones = Bones(PARTS, 0.01)
    weights = benchmark(bones.weights, clouds[0], clouds[1][:, :PARTS])
    assert weights.shape == (BATCH, POINTS, PARTS)


def test_vector_neuron_block(benchmark: BenchmarkFixture):
    generator = torch.Generator().manual_seed(0)
    block = VNBlock(32, 32)
    initialise(block, generator)
    features = torch.randn(BATCH, POINTS, 3, 32, generator=generator)
    benchmark(forward_backward(lambda: block(features)))


def test_encoder(benchmark: BenchmarkFixture, clouds: Tensor):
    encoder = Encoder(EncoderConfig()).eval()
    initialise(encoder, torch.Generator().manual_seed(0))
    one = clouds[0, :1]
    with torch.no_grad():
        assert benchmark(encoder, one).translation.shape == (1, 3)


@pytest.mark.parametrize("backend", ["sapien", "raycast"])
@pytest.mark.parametrize("category", ["laptop", "oven"])
def test_generate(benchmark: BenchmarkFixture, category: str, backend: str):
    """Labelled clouds of one instance at 256 x 256; clouds per second are 64 over the median."""
    from sim_assets import generate_samples
    from sim_assets.rendering import doctor

    if not doctor.probe(backend).works:
        pytest.skip(f"{backend} does not work here")

    def run() -> list[Any]:
        return list(generate_samples(category, count=SAMPLES, instances=1, backend=backend))

    assert len(benchmark.pedantic(run, rounds=3, warmup_rounds=1)) == SAMPLES
