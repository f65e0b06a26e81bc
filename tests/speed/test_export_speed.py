# SPDX-License-Identifier: MIT
"""The network of template registration beside its graph and its ONNX file, one thread."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

from scapo.export.network import export_network, write_onnx
from scapo.registered.network import PlainVotes, PointVotes

CLOUDS, POINTS = 4, 256
"""The four frames of one cloud, as `fast` asks."""


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def network() -> PointVotes:
    return PointVotes(2, 1).eval()


@pytest.fixture
def clouds() -> Tensor:
    return 0.15 * torch.randn(CLOUDS, POINTS, 3, generator=torch.Generator().manual_seed(0))


@torch.no_grad()
def test_eager(benchmark: BenchmarkFixture, network: PointVotes, clouds: Tensor):
    assert benchmark(network, clouds).points.shape == clouds.shape


@torch.no_grad()
def test_graph(benchmark: BenchmarkFixture, network: PointVotes, clouds: Tensor):
    graph = export_network(PlainVotes(network), clouds).module()
    assert benchmark(graph, clouds)[0].shape == clouds.shape


@torch.no_grad()
def test_onnx(benchmark: BenchmarkFixture, network: PointVotes, clouds: Tensor, tmp_path: Path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    path = tmp_path / "votes.onnx"
    write_onnx(PlainVotes(network), clouds, PlainVotes.OUTPUTS, path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    assert benchmark(session.run, None, {"cloud": clouds.numpy()})[0].shape == clouds.shape
