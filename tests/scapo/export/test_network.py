# SPDX-License-Identifier: MIT
"""The network of template registration answers alike as a graph and as an ONNX file."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from scapo.export.network import export_network, write_onnx
from scapo.registered.view_network import PlainViewVotes, ViewNetwork, ViewVotes
from tests.helpers.strategies import generator


def network() -> ViewNetwork:
    made = ViewNetwork(2, 1, channels=4).eval()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator(0)))
    return made


def votes(made: ViewNetwork, cloud: torch.Tensor) -> ViewVotes:
    return made(cloud[..., :3], cloud[..., 3:], cloud.shape[1])


def clouds(count: int) -> torch.Tensor:
    return 0.2 * torch.randn(count, 40, 6, generator=generator(count))


@torch.no_grad()
def test_plain_operations_give_the_votes():
    made = network()
    for name, found in zip(PlainViewVotes.OUTPUTS, PlainViewVotes(made)(clouds(3)), strict=True):
        assert_close(found, getattr(votes(made, clouds(3)), name), atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_the_graph_gives_the_votes_for_any_number_of_clouds():
    made = network()
    graph = export_network(PlainViewVotes(made), clouds(2)).module()
    for count in (1, 2, 5):
        wanted = votes(made, clouds(count))
        for name, found in zip(PlainViewVotes.OUTPUTS, graph(clouds(count)), strict=True):
            assert_close(found, getattr(wanted, name), atol=1e-4, rtol=0)


@torch.no_grad()
def test_the_file_is_the_graph_with_named_outputs_as_the_exporter_gives_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The exporter left out: it comes with the extra."""
    asked: dict[str, Any] = {}

    def exporting(program: Any, **options: Any) -> SimpleNamespace:
        asked.update(options, program=program)
        return SimpleNamespace(model_proto=SimpleNamespace(SerializeToString=lambda: b"a graph"))

    monkeypatch.setattr(torch.onnx, "export", exporting)
    layer, path = torch.nn.Linear(6, 2), tmp_path / "votes.onnx"
    write_onnx(layer, clouds(2), ("votes",), path)
    assert path.read_bytes() == b"a graph"
    assert (asked["input_names"], asked["output_names"]) == (["cloud"], ["votes"])
    for count in (1, 4):
        assert_close(asked["program"].module()(clouds(count)), layer(clouds(count)))


@pytest.mark.slow
@torch.no_grad()
def test_the_onnx_file_gives_the_votes(tmp_path: Path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    made, path = network(), tmp_path / "votes.onnx"
    write_onnx(PlainViewVotes(made), clouds(2), PlainViewVotes.OUTPUTS, path)
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert [item.name for item in session.get_outputs()] == list(PlainViewVotes.OUTPUTS)
    for count in (1, 4):
        wanted = votes(made, clouds(count))
        answers = session.run(None, {"cloud": clouds(count).numpy()})
        for name, found in zip(PlainViewVotes.OUTPUTS, answers, strict=True):
            assert_close(torch.from_numpy(found), getattr(wanted, name), atol=1e-4, rtol=0)
