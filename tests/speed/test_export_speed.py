# SPDX-License-Identifier: MIT
"""The network of template registration beside its graph and its ONNX file, one thread."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from torch import Tensor

from scapo.export.network import export_network, write_onnx
from scapo.registered.view_network import PlainViewVotes, ViewNetwork

pytestmark = pytest.mark.usefixtures("one_thread")

CLOUDS, POINTS = 1, 1024
"""One cloud, as `fast` asks."""


@pytest.fixture
def network() -> ViewNetwork:
    return ViewNetwork(2, 1, channels=16).eval()


@pytest.fixture
def clouds() -> Tensor:
    return 0.15 * torch.randn(CLOUDS, POINTS, 6, generator=torch.Generator().manual_seed(0))


@torch.no_grad()
def test_eager(benchmark: BenchmarkFixture, network: ViewNetwork, clouds: Tensor):
    votes = benchmark(network, clouds[..., :3], clouds[..., 3:], POINTS)
    assert votes.points.shape == (CLOUDS, POINTS, 2, 3)


@torch.no_grad()
def test_graph(benchmark: BenchmarkFixture, network: ViewNetwork, clouds: Tensor):
    graph = export_network(PlainViewVotes(network), clouds.expand(2, -1, -1)).module()
    assert benchmark(graph, clouds)[0].shape == (CLOUDS, POINTS, 2, 3)


@torch.no_grad()
def test_onnx(benchmark: BenchmarkFixture, network: ViewNetwork, clouds: Tensor, tmp_path: Path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    path = tmp_path / "votes.onnx"
    write_onnx(PlainViewVotes(network), clouds.expand(2, -1, -1), PlainViewVotes.OUTPUTS, path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    assert benchmark(session.run, None, {"cloud": clouds.numpy()})[0].shape == (
        CLOUDS,
        POINTS,
        2,
        3,
    )
