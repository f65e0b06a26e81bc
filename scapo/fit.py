# SPDX-License-Identifier: MIT
"""The training loop, for any method: stages, batches, log, checkpoint, resume, stop at NaN.

All data lie on the device, batches are drawn by index there, randomness comes from two generators
of one seed (order of the data on the host, augmentation on the device). A run that was killed
continues from its last checkpoint with the same batches: on a CPU, bit for bit the same curve.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from scapo import checkpoint
from scapo.files import Arrays, Header, canonical_json, read, write, write_bytes
from scapo.layout import StoreError
from scapo.log import Log
from scapo.method import AbstractMethod, Stage, Step
from scapo.resident import TrainingData

TIMING = "timing.json"
"""What differs from run to run, apart from all that does not."""


class TrainingError(ArithmeticError):
    """The loss or its gradient is not finite; the message names the file with the batch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a run is driven; nothing here is a property of the method."""

    seed: int = 1
    device: str = "cpu"
    log_every: int = 10
    """Steps between two lines of metrics.jsonl, which hold means over them."""
    checkpoint_every: float = 60.0
    """Seconds after which the end of an epoch saves the state."""
    clip: float = 10.0
    """Largest norm of the gradient; longer ones are scaled down."""


@dataclass(slots=True)
class Position:
    """Where a run is: the next stage and epoch, and the steps done in all."""

    stage: int = 0
    epoch: int = 0
    step: int = 0
    seconds: float = 0.0
    rates: dict[str, float] = field(default_factory=dict)
    """Samples per second of each stage."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """What a listener hears after each step."""

    stage: Stage
    epoch: int
    done: float
    """Share of the stage."""
    loss: float | None
    """Mean of the last lines of the log; None between them."""


Listener = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """A listener that does nothing."""
    del progress


def fit(
    method: AbstractMethod,
    data: TrainingData,
    folder: Path,
    config: FitConfig,
    *,
    resume: bool = False,
    listener: Listener = silent,
) -> None:
    """Run all stages of a method and leave the run in `folder`.

    Writes config.json, metrics.jsonl, tensorboard/ (where that package is installed),
    checkpoint.safetensors and training.safetensors. With `resume` a run in that folder is
    continued, or left as it is when it was finished.

    Raises:
        TrainingError: The loss or its gradient is not finite.
        StoreError: `resume` with another configuration or other data, or a run is there without
            `resume`.
    """
    Trainer(method, data, folder, config, listener).run(resume=resume)


class Trainer:
    """One run: what `fit` needs at hand from step to step."""

    def __init__(
        self,
        method: AbstractMethod,
        data: TrainingData,
        folder: Path,
        config: FitConfig,
        listener: Listener,
    ) -> None:
        """Move method and data to the device."""
        self.method = method.to(config.device)
        allowed = data.labels.keep(method.supervision)
        self.data = TrainingData(
            observation=data.observation, labels=allowed, digest=data.digest
        ).to(config.device)
        self.folder, self.config, self.listener = folder, config, listener
        self.order = torch.Generator().manual_seed(config.seed)
        self.noise = torch.Generator(config.device).manual_seed(config.seed)
        self.position = Position()
        self.finished = False
        self.saved = time.monotonic()

    def run(self, *, resume: bool) -> None:
        """All stages that are left."""
        adam = self._open(resume=resume)
        if self.finished:
            return
        self.log = Log(self.folder, self.position.step)
        with contextlib.closing(self.log):
            self._stages(adam)

    def _stages(self, adam: Arrays | None) -> None:
        stages = self.method.stages()
        if not stages:
            self._start(Stage(name="", epochs=0, lr=0.0))
        while self.position.stage < len(stages):
            stage = stages[self.position.stage]
            if self.position.epoch == 0:
                self._start(stage)
            optimizer = self._optimizer(stage)
            if adam is not None:
                checkpoint.load_adam(optimizer, adam)
                adam = None
            self._stage(stage, optimizer)
            self.position.stage, self.position.epoch = self.position.stage + 1, 0
            self._save(None)
        self._save(None, finished=True)

    def _open(self, *, resume: bool) -> Arrays | None:
        """Begin a run, or load the state of the one that is there; Adam's part of it."""
        path = self.folder / checkpoint.TRAINING
        if not path.is_file():
            text = json.dumps(self._header(finished=False), indent=1, sort_keys=True)
            write_bytes(self.folder / "config.json", (text + "\n").encode())
            return None
        if not resume:
            raise StoreError(
                f"{self.folder}: expected no run there, found one; resume continues it"
            )
        arrays, header = read(path, checkpoint.TRAINING_FORMAT)
        self._check_same(path, header["header"])
        checkpoint.load_arrays(self.method, arrays, path, "weights/")
        self.order.set_state(torch.from_numpy(arrays["generator/order"].copy()))
        self.noise.set_state(torch.from_numpy(arrays["generator/noise"].copy()))
        self.position = Position(**header["position"])
        self.finished = header["header"]["finished"]
        return arrays if header["optimizer"] else None

    def _check_same(self, path: Path, found: Header) -> None:
        """Refuse to continue a run of another method, configuration, seed or data."""
        expected = json.loads(canonical_json(self._header(finished=False)))
        for name in ("method", "category", "config", "seed", "data_digest", "supervision"):
            if found[name] != expected[name]:
                raise StoreError(
                    f"{path}: {name}: expected {canonical_json(expected[name])} to resume, "
                    f"found {canonical_json(found[name])}"
                )

    def _start(self, stage: Stage) -> None:
        self.method.start(stage.name, self.data.observation, self.data.labels, self.noise)

    def _optimizer(self, stage: Stage) -> torch.optim.Adam:
        groups = [
            {"params": list(part.parameters()), "lr": stage.lr * group.rate}
            for group in stage.parameters
            for part in [self._part(group.module)]
        ]
        self.method.requires_grad_(False)
        return torch.optim.Adam(groups, lr=stage.lr, weight_decay=stage.weight_decay, fused=True)

    def _part(self, name: str) -> nn.Module:
        return self.method.get_submodule(name) if name else self.method

    def _stage(self, stage: Stage, optimizer: torch.optim.Adam) -> None:
        """The epochs of a stage that are left."""
        samples = self.data.observation.points.shape[0]
        size = min(stage.batch, samples)
        steps = samples // size
        for epoch in range(self.position.epoch, stage.epochs):
            began = time.monotonic()
            self.method.train()
            order = torch.randperm(samples, generator=self.order)[: steps * size]
            for number, index in enumerate(order.split(size)):
                done = (epoch * steps + number) / (stage.epochs * steps)
                self._step(stage, optimizer, index, done)
                self.listener(Progress(stage=stage, epoch=epoch, done=done, loss=self.log.latest))
            self.log.write(self.position.step, stage.name)
            self.position.epoch = epoch + 1
            seconds = time.monotonic() - began
            self.position.seconds += seconds
            self.position.rates[stage.name] = steps * size / seconds
            self.log.scalar("samples_per_second", steps * size / seconds, self.position.step)
            if time.monotonic() - self.saved > self.config.checkpoint_every:
                self._save(optimizer)

    def _step(self, stage: Stage, optimizer: torch.optim.Adam, index: Tensor, done: float) -> None:
        """One batch."""
        rate = cosine(stage, done)
        for group, settings in zip(stage.parameters, optimizer.param_groups, strict=True):
            settings["lr"] = rate * group.rate
            for parameter in settings["params"]:
                parameter.requires_grad_(done >= group.begin)
        observation, labels = self.data.batch(index.to(self.config.device))
        step = Step(stage=stage.name, progress=done, generator=self.noise)
        terms = self.method.losses(observation, labels, step)
        total = torch.stack(list(terms.values())).sum()
        if not bool(torch.isfinite(total)):
            raise TrainingError(self._post_mortem("loss", stage, index, terms))
        optimizer.zero_grad()
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.method.parameters(), self.config.clip)
        if not bool(torch.isfinite(norm)):
            raise TrainingError(self._post_mortem("gradient", stage, index, terms))
        optimizer.step()
        self.position.step += 1
        named = {f"loss/{name}": value for name, value in terms.items()}
        self.log.collect({"loss": total, **named, "gradient": norm}, rate)
        if self.position.step % self.config.log_every == 0:
            self.log.write(self.position.step, stage.name)

    def _post_mortem(self, what: str, stage: Stage, index: Tensor, terms: dict[str, Tensor]) -> str:
        """Save the batch; the message that names it."""
        path = self.folder / "bad-batch.safetensors"
        observation, _ = self.data.batch(index.to(self.config.device))
        arrays = {"points": observation.points, "index": index}
        values = {name: str(float(value.detach())) for name, value in terms.items()}
        header = {"format": "scapo-bad-batch/1", "stage": stage.name, "terms": values}
        write(path, {name: checkpoint.array(value) for name, value in arrays.items()}, header)
        bad = [name for name, value in values.items() if not math.isfinite(float(value))]
        return (
            f"{path}: expected a finite {what} in stage {stage.name!r} at step "
            f"{self.position.step}, found {', '.join(bad) or 'finite terms with a bad gradient'}; "
            "the batch is saved there"
        )

    def _header(self, *, finished: bool) -> Header:
        extra: dict[str, Any] = {
            "seed": self.config.seed,
            "data_digest": self.data.digest,
            "supervision": sorted(self.method.supervision),
            "steps": self.position.step,
            "finished": finished,
        }
        return checkpoint.checkpoint_header(
            self.method.name, self.method.config, self.method.category.name, extra
        )

    def _save(self, optimizer: torch.optim.Adam | None, *, finished: bool = False) -> None:
        """First the state that resume reads, whole in one file, then the weights alone."""
        arrays = checkpoint.to_arrays(self.method, "weights/")
        arrays |= {} if optimizer is None else checkpoint.adam_arrays(optimizer)
        arrays["generator/order"] = checkpoint.array(self.order.get_state())
        arrays["generator/noise"] = checkpoint.array(self.noise.get_state())
        header = self._header(finished=finished)
        training = {
            "format": checkpoint.TRAINING_FORMAT,
            "position": asdict(self.position),
            "optimizer": optimizer is not None,
            "header": header,
        }
        write(self.folder / checkpoint.TRAINING, arrays, training)
        checkpoint.write_checkpoint(self.folder / checkpoint.WEIGHTS, self.method, header)
        timing = {"seconds": self.position.seconds, "samples_per_second": self.position.rates}
        write_bytes(self.folder / TIMING, (json.dumps(timing, indent=1) + "\n").encode())
        self.saved = time.monotonic()


def cosine(stage: Stage, done: float) -> float:
    """Learning rate when this share of the stage is done: half a cosine from lr to min_lr."""
    return stage.min_lr + (stage.lr - stage.min_lr) * (1 + math.cos(math.pi * done)) / 2
