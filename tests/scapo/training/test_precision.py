# SPDX-License-Identifier: MIT
"""Networks in half precision or compiled: close to float32, and nothing else is touched."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from bench.baselines.icp import Icp, IcpConfig
from scapo.categories import CATEGORIES
from scapo.geometry.points import normalise
from scapo.geometry.rigid import project_rotation
from scapo.method import Step
from scapo.paper.method import Scapo
from scapo.store.checkpoint import TRAINING, WEIGHTS
from scapo.store.files import read_header
from scapo.training import fit
from scapo.training import precision as precision_module
from scapo.training.precision import (
    Arithmetic,
    Precision,
    applied,
    full,
    require_networks,
)
from scapo.types import Labels, Observation
from tests.conftest import REPOSITORY
from tests.helpers.tiny import tiny, tiny_data
from tests.helpers.two_ranks import CONFIG, Line, StoppedError, stop_after

HALF: tuple[Precision, ...] = ("bfloat16", "float16")
CLOUDS, _ = normalise(tiny_data().observation.points)


def answers(model: Scapo) -> dict[str, Tensor]:
    """With the batch's own statistics, which give drawn weights features of a size near 1."""
    with torch.no_grad():
        e = model.train().explain(CLOUDS)
    return {
        "frame": e.encoding.frame,
        "code": e.encoding.code,
        "rotation": e.encoding.rotation,
        "template": e.template,
        "axis": e.joints.axis,
        "pivot": e.joints.pivot,
    }


@pytest.mark.parametrize("precision", HALF)
def test_networks_lose_digits_and_geometry_does_not(precision: Precision) -> None:
    model = tiny()
    exact = answers(model)
    with applied(model, Arithmetic(precision=precision), "cpu"):
        rough = answers(model)
    assert all(value.dtype == torch.float32 for value in rough.values())
    lost = (rough["code"] - exact["code"]).abs().mean() / exact["code"].abs().mean()
    assert 1e-5 < float(lost) < (0.3 if precision == "bfloat16" else 0.05)
    expected = project_rotation(rough["frame"])  # of what the network says, in float32
    assert torch.allclose(rough["rotation"], expected, atol=1e-6)
    assert torch.allclose(rough["axis"].norm(dim=-1), torch.ones(()), atol=1e-5)
    again = answers(model)  # as before, to the bit
    assert all(torch.equal(exact[name], again[name]) for name in exact)


@pytest.mark.parametrize("precision", HALF)
def test_training_is_close_to_float32(precision: Precision, tmp_path: Path) -> None:
    curves = []
    for name in ("float32", precision):
        config = replace(CONFIG, arithmetic=Arithmetic(precision=name))
        method = Line()
        fit.fit(method, tiny_data(), tmp_path / name, config)
        curves.append(method.map.weight.detach())
        header = read_header(tmp_path / name / WEIGHTS)
        assert header["training"]["precision"] == name
    # In float16 the first steps are left out, until the scale of the loss fits.
    most = 0.01 if precision == "bfloat16" else 0.15
    assert 1e-6 < float((curves[1] - curves[0]).abs().max()) < most


class Steep(Line):
    """A loss whose gradient overflows float16 at the first scales."""

    name = "steep"

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        terms = super().losses(observation, labels, step)
        return {name: 100 * value for name, value in terms.items()}


def test_overflowing_steps_are_left_out_until_the_scale_fits(tmp_path: Path) -> None:
    config = replace(CONFIG, arithmetic=Arithmetic(precision="float16"))
    method = Steep()
    fit.fit(method, tiny_data(), tmp_path, config)
    position = read_header(tmp_path / TRAINING)["position"]
    assert position["scaler"]["scale"] < 2**16
    assert torch.isfinite(method.map.weight).all()
    assert not torch.equal(method.map.weight, Line().map.weight)
    assert not (tmp_path / "bad-batch.safetensors").exists()


@pytest.mark.parametrize("stop", [5, 7])  # steps of six in a stage
def test_a_run_in_float16_continues_bit_for_bit(tmp_path: Path, stop: int) -> None:
    config = replace(CONFIG, arithmetic=Arithmetic(precision="float16"))
    fit.fit(Steep(), tiny_data(), tmp_path / "whole", config)
    with pytest.raises(StoppedError):
        fit.fit(Steep(), tiny_data(), tmp_path / "cut", config, listener=stop_after(stop))
    fit.fit(Steep(), tiny_data(), tmp_path / "cut", config, resume=True)
    for name in (WEIGHTS, "metrics.jsonl"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_method_without_networks_is_refused(tmp_path: Path) -> None:
    method = Line()
    method.networks = ()  # pyright: ignore[reportAttributeAccessIssue]
    config = replace(CONFIG, arithmetic=Arithmetic(precision="bfloat16"))
    with pytest.raises(ValueError, match="bfloat16: expected a method with networks"):
        fit.fit(method, tiny_data(), tmp_path, config)
    icp = Icp(IcpConfig(), CATEGORIES["laptop"], torch.Generator())
    require_networks(icp, Arithmetic(compiled=True))  # nothing is trained: nothing to refuse


class Sent(Line):
    """Its starts send its network to another process."""

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        assert len(ForkingPickler.dumps(self.map))
        self.sent = [*getattr(self, "sent", []), stage]
        super().start(stage, observation, labels, generator)


def test_starts_may_send_networks_to_other_processes(tmp_path: Path) -> None:
    method = Sent()
    fit.fit(
        method, tiny_data(), tmp_path, replace(CONFIG, arithmetic=Arithmetic(precision="bfloat16"))
    )
    assert method.sent == ["one", "two"]
    with applied(method, Arithmetic(precision="bfloat16"), "cpu"), pytest.raises(AttributeError):
        ForkingPickler.dumps(method.map)


def test_only_half_precision_is_widened() -> None:
    double = torch.zeros(1, dtype=torch.float64)
    assert full(double) is double
    half, number = full((torch.zeros(1, dtype=torch.float16), torch.zeros(1, dtype=torch.long)))
    assert (half.dtype, number.dtype) == (torch.float32, torch.long)


def test_every_network_is_handed_to_the_compiler_and_put_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stand-in for the compiler, which adds one to what `Line` says."""
    asked: list[dict[str, Any]] = []

    def compiling(forward: Callable[[Tensor], Tensor], **options: Any) -> Callable[..., Tensor]:
        asked.append(options)
        return lambda points: forward(points) + 1

    monkeypatch.setattr(torch, "compile", compiling)
    monkeypatch.setattr(precision_module, "before_compiling", lambda: None)
    method = Line()
    before = method.map(CLOUDS)
    with applied(method, Arithmetic(compiled=True), "cpu"):
        within = method.map(CLOUDS)
    assert asked == [{"mode": "default", "dynamic": False}]
    assert torch.equal(within, before + 1)
    assert torch.equal(method.map(CLOUDS), before)
    with applied(method, Arithmetic(), "cpu"):
        assert torch.equal(method.map(CLOUDS), before)


COMPILED = """
import sys, warnings
import torch
warnings.simplefilter("ignore")
from tests.helpers.tiny import tiny, tiny_data
from scapo.geometry.points import normalise
from scapo.training.precision import Arithmetic, applied
points, _ = normalise(tiny_data(8).observation.points)
model = tiny().eval()
before = model.explain(points)
model.networks = ("encoder",)
with applied(model, Arithmetic(compiled=True), "cpu"):
    after = model.explain(points)
code = (before.encoding.code - after.encoding.code).abs().max()
turn = (before.encoding.rotation - after.encoding.rotation).abs().max()
print(float(code), float(turn), torch._dynamo.utils.counters["stats"]["unique_graphs"])
"""


@pytest.mark.slow
def test_a_compiled_encoder_gives_the_same_numbers() -> None:
    helpers = REPOSITORY / "tests/helpers"
    script = f"import sys; sys.path[:0] = {[str(helpers), str(REPOSITORY)]}\n{COMPILED}"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    code, turn, graphs = (float(word) for word in done.stdout.split())
    assert code < 1e-4
    assert turn < 1e-4
    assert graphs > 0
