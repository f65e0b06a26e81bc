# SPDX-License-Identifier: MIT
"""What each process of `torchrun` does in test_ranks.py: a few short trainings, one after another.

Arguments: a folder. Leaves runs there, and RANK.json with what this rank ended with.
"""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from scapo.categories import CATEGORIES
from scapo.geometry.points import normalise
from scapo.method import AbstractMethod, Mode, Stage, Step
from scapo.paper.losses import orthonormality, reconstruction
from scapo.paper.method import Scapo
from scapo.paper.objectives import LossConfig
from scapo.training import fit
from scapo.training.distributed import Ranks, average_buffers, joined, sum_gradients
from scapo.types import Labels, Observation, Prediction
from tests.helpers.tiny import TINY, tiny_data

CONFIG = fit.FitConfig(log_every=2, checkpoint_every=0.0, pictures_every=None)
BATCH = 7  # of 24, over two ranks: shares of 4 and 3


class Line(AbstractMethod):
    """A linear map of points to their distance from the origin: no noise, no statistics."""

    name = "line"
    networks = ("map",)

    def __init__(self, *, nan_rank: int | None = None) -> None:
        super().__init__()
        self.config = CONFIG
        self.category = CATEGORIES["laptop"]
        self.supervision = frozenset()
        self.map = nn.Linear(3, 1)
        self.register_buffer("drawn", torch.zeros(5))
        with torch.no_grad():
            self.map.weight.copy_(torch.tensor([[0.3, -0.2, 0.1]]))
            self.map.bias.zero_()
        self.nan_rank, self.steps = nan_rank, 0

    @property
    def variant(self) -> str:
        return ""

    def stages(self) -> tuple[Stage, ...]:
        return tuple(Stage(name=name, epochs=2, lr=0.03, batch=BATCH) for name in ("one", "two"))

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        del stage, observation, labels
        self.drawn = torch.rand(5, generator=generator)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        del labels, step
        self.steps += 1
        points = observation.points
        error = self.map(points)[..., 0] - points.norm(dim=-1)
        broken = self.nan_rank is not None and self.steps == 3
        if broken and torch.distributed.get_rank() == self.nan_rank:
            error = error * torch.nan
        return {"square": error.square().mean(), "far": 0.1 * error.abs().amax(1).mean()}

    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        del mode
        return Prediction(part_weight=torch.ones(*observation.points.shape[:-1], 1))


class Still(Scapo):
    """Stage 1's reconstruction without random poses and disturbances."""

    name = "still"

    def stages(self) -> tuple[Stage, ...]:
        return super().stages()[:1]

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        del labels, step
        points, _ = normalise(observation.points)
        encoding = self.encoder(points)
        shape, _ = self.decoder(encoding.code)
        return {
            "rec": reconstruction(encoding.align(points), shape),
            "ortho": orthonormality(encoding.frame),
        }


def still() -> Still:
    config = replace(TINY, epochs=(4, 4), loss=LossConfig())
    return Still(config, CATEGORIES["laptop"], torch.Generator().manual_seed(0))


class StoppedError(Exception):
    """Stands for a kill."""


def stop_after(steps: int) -> fit.Listener:
    done = 0

    def listener(progress: fit.Progress) -> None:
        nonlocal done
        del progress
        done += 1
        if done == steps:
            raise StoppedError

    return listener


def digest(module: nn.Module) -> str:
    state = b"".join(value.numpy().tobytes() for value in module.state_dict().values())
    return hashlib.sha256(state).hexdigest()


def main(folder: Path) -> None:
    with joined("cpu") as ranks:
        said: dict[str, object] = {"collectives": collectives(ranks)}
        method = Line()
        fit.fit(method, tiny_data(), folder / "line", CONFIG)
        said["line"] = digest(method)
        try:
            fit.fit(Line(), tiny_data(), folder / "resumed", CONFIG, listener=stop_after(8))
        except StoppedError:
            ranks.wait()
            fit.fit(Line(), tiny_data(), folder / "resumed", CONFIG, resume=True)
        scapo = still()
        fit.fit(scapo, tiny_data(), folder / "still", CONFIG)
        said["still"] = digest(scapo)
        try:
            fit.fit(Line(nan_rank=1), tiny_data(), folder / "nan", CONFIG)
        except fit.TrainingError as error:
            said["nan"] = str(error)
        (folder / f"{ranks.rank}.json").write_text(json.dumps(said))


def collectives(ranks: Ranks) -> dict[str, object]:
    """What the exchanges give on small numbers."""
    one, two = nn.Linear(2, 1, bias=False), nn.Linear(1, 1)
    norm = nn.BatchNorm1d(1)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    if ranks.first:  # one rank has a gradient that the other lacks
        one.weight.grad = torch.tensor([[1.0, 2.0]])
    two.weight.grad = torch.tensor([[1.0 + ranks.rank]])
    said = sum_gradients(nn.Sequential(one, two), 0.75 if ranks.first else 0.25, True, ranks)
    norm.running_mean.fill_(ranks.rank)
    norm.running_var.fill_(1 / 3)
    average_buffers(norm, ranks)
    assert one.weight.grad is not None
    return {
        "said": said,
        "first": one.weight.grad.tolist(),
        "second": two.weight.grad.tolist(),
        "none": two.bias.grad is None,
        "mean": norm.running_mean.tolist(),
        "kept": torch.equal(norm.running_var, torch.tensor([1 / 3])),
        "bytes": len(ranks.from_first(b"abc" if ranks.first else b"", "cpu")),
        "every": [v.tolist() for v in ranks.every(torch.tensor([ranks.rank]), "cpu")],
        "share": ranks.share(torch.arange(7)).tolist(),
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
