# SPDX-License-Identifier: MIT
"""The training loop, for any method: stages, batches, log, checkpoint, resume, stop at NaN.

All data lie on the device, batches are drawn by index there, randomness comes from two generators
of one seed (order of the data on the host, augmentation on the device). A run that was killed
continues from its last checkpoint with the same batches: on a CPU, bit for bit the same curve.

Where the process belongs to a group (`ranks`, torchrun), each rank takes its share of every
batch, gradients are summed, and the first rank alone starts stages, writes and logs.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Int
from safetensors.numpy import load, save
from torch import Tensor
from torch.optim import Optimizer

from scapo.method import AbstractMethod, Journal, Stage, Step
from scapo.store import checkpoint
from scapo.store.files import Arrays, remove_half_written
from scapo.store.folders import alone
from scapo.store.samples import TrainingData
from scapo.store.schema import StoreError
from scapo.training import precision
from scapo.training.distributed import average_buffers, present
from scapo.training.log import BAD_BATCH, Log, draw_progress, save_batch
from scapo.training.optimiser import Descent, NotFiniteError, make_optimiser, schedule
from scapo.training.precision import Arithmetic
from scapo.training.run_folder import Position, RunFolder, State, kept


class TrainingError(ArithmeticError):
    """The loss or its gradient is not finite; the message names the file with the batch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a run is driven; nothing here is a property of the method."""

    seed: int = 1
    """Seed of the first weights, the order of the data and the augmentation."""
    device: str = "cpu"
    """Where the networks run: cpu, cuda, cuda:1, ..."""
    log_every: int = 10
    """Steps between two lines of metrics.jsonl, which hold means over them."""
    checkpoint_every: float = 60.0
    """Seconds after which the end of an epoch saves the state."""
    clip: float = 10.0
    """Largest norm of the gradient; longer ones are scaled down."""
    workers: int = 0
    """Processes for what a start can do side by side; with fewer than two, this process alone."""
    arithmetic: Arithmetic = field(default_factory=Arithmetic)
    """Precision and compilation of the networks."""
    pictures_every: float | None = 300.0
    """Seconds after which the end of an epoch draws the method's pictures, as does the end of a
    stage; None: never."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """What a listener hears after each step, and before each step of a start."""

    stage: Stage
    epoch: int
    done: float
    """Share of the stage, or of its start."""
    loss: float | None
    """Mean of the last lines of the log; None between them."""
    step: str = ""
    """What the start of the stage is at; "" once it is over."""
    left: float | None = None
    """Seconds that the rest of the start will take, by estimate."""


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

    Stages with a validation pass take `data.validation`, or else every tenth object of `data`,
    which is then not trained on.

    Writes config.json, metrics.jsonl, tensorboard/ (where that package is installed), pictures/
    (where matplotlib is), checkpoint.safetensors and training.safetensors, and start/ as long as a
    method's start goes on. With `resume` a run in that folder is continued, or left as it is when
    it was finished.

    Raises:
        TrainingError: The loss or its gradient is not finite.
        StoreError: `resume` with another configuration or other data, or a run is there without
            `resume`; another training goes on in the folder; or it cannot be written, what was
            saved before is whole.
        ValueError: Fewer samples in a batch than ranks or method need, or a precision that the
            method lacks.
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
        self.config, self.listener, self.ranks = config, listener, present()
        self.validated = any(stage.validate_every for stage in method.stages())
        if self.validated and data.validation is None:
            data = data.held_out()
        self.data = data.keep(method.supervision).to(config.device)
        seed = config.seed + (self.ranks.rank << 32)  # every rank augments in its own way
        self.state = State(
            position=Position(),
            order=torch.Generator().manual_seed(config.seed),
            noise=torch.Generator(config.device).manual_seed(seed),
        )
        self.folder = RunFolder(folder, method, self._about(), config.device)
        self.descent = Descent(
            method=method,
            clip=config.clip,
            arithmetic=config.arithmetic,
            device=config.device,
            ranks=self.ranks,
            scaler=precision.scaler(config.arithmetic.precision, config.device),
        )
        self.saved = self.drawn = time.monotonic()

    def _about(self) -> dict[str, Any]:
        training = {**asdict(self.config.arithmetic), "clip": self.config.clip}
        if self.validated and self.data.validation is not None:
            training["validation"] = self.data.validation.digest
        return {
            "seed": self.config.seed,
            "data_digest": self.data.digest,
            "training": {**training, "ranks": self.ranks.count},
        }

    def run(self, *, resume: bool) -> None:
        """All stages that are left."""
        finished, moments = False, None
        precision.require_networks(self.method, self.config.arithmetic)
        path = self.folder.path
        held = alone(path, "training") if self.ranks.first else contextlib.nullcontext()
        with self._explained(), held:
            if self.ranks.first:
                remove_half_written(path)
            if self.folder.found(resume=resume):
                finished, moments = self.folder.load(self.state, self.ranks.rank)
            elif self.ranks.first:
                self.folder.begin()
            if finished:
                return
            self.ranks.wait()  # no rank looks for a run that another has begun
            logged = path if self.ranks.first else None
            self.log = Log(logged, self.state.position.step, self.ranks.total)
            with contextlib.closing(self.log):
                self._stages(moments)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """A full disk or a file that cannot be written, as one line with what is left."""
        try:
            yield
        except OSError as error:
            raise StoreError(
                f"{error.filename or self.folder.path}: expected to be written, found: "
                f"{error.strerror or error}; {kept(self.folder.path)}"
            ) from error

    def _stages(self, moments: Arrays | None) -> None:
        position, stages = self.state.position, self.method.stages()
        if position.scaler:
            self._load_scaler(position.scaler)
        if not stages:
            self._start(Stage(name="", epochs=0, lr=0.0))
        while position.stage < len(stages):
            stage = stages[position.stage]
            if not position.started:
                self._start(stage)
            if position.epoch < stage.epochs:
                self._recall(stage)
            optimizer = make_optimiser(self.method, stage)
            if moments is not None:
                checkpoint.load_optimiser(optimizer, moments, self.folder.path)
                moments = None
            # Not the start: what it does side by side sends the method to other processes.
            arithmetic, device = self.config.arithmetic, self.config.device
            with precision.applied(self.method, arithmetic, device):
                self._stage(stage, optimizer)
            self._take_best()
            position.stage, position.epoch, position.started = position.stage + 1, 0, False
            self._draw(stage)
            self._save(None)
        self._save(None, finished=True)

    def _load_scaler(self, state: dict[str, int | float]) -> None:
        try:
            self.descent.scaler.load_state_dict(state)
        except (KeyError, RuntimeError) as error:
            raise StoreError(
                f"{self.folder.path / checkpoint.TRAINING}: header: position: scaler: expected the "
                f"state of a gradient scaler, found one without {error}"
            ) from error

    def _start(self, stage: Stage) -> None:
        """The method's start of a stage, by the first rank for all; saved, as it may take long."""
        began, earlier = time.monotonic(), 0.0
        if self.ranks.first:
            data, noise = self.data, self.state.noise
            begin = partial(self.method.start, stage.name, data.observation, data.labels, noise)
            earlier = self._journalled(stage, begin)
        if self.ranks.count > 1:
            state = save(checkpoint.to_arrays(self.method)) if self.ranks.first else b""
            arrays = load(self.ranks.from_first(state, self.config.device))
            checkpoint.load_arrays(self.method, arrays, self.folder.path)
        self.state.position.spend(stage.name, time.monotonic() - began + earlier)
        self.state.position.started = True
        if stage.epochs:
            self._save(None)

    def _recall(self, stage: Stage) -> None:
        """What the method needs in the stage and no file of the run holds, on every rank."""
        began, earlier = time.monotonic(), 0.0
        again = partial(self.method.recall, stage.name, self.data.observation, self.state.noise)
        if self.ranks.first:
            earlier = self._journalled(stage, again)
        else:
            again()
        self.state.position.spend(stage.name, time.monotonic() - began + earlier)

    def _journalled(self, stage: Stage, begin: Callable[[], None]) -> float:
        """Told and kept step by step; seconds of steps done before."""

        def tell(words: str, done: float, left: float) -> None:
            self.listener(
                Progress(stage=stage, epoch=0, done=done, loss=None, step=words, left=left)
            )

        with self.folder.journal(stage.name, tell, self.config.workers) as journal:
            self.method.journal = journal
            try:
                begin()
            finally:
                self.method.journal = Journal()
        return journal.earlier

    def _stage(self, stage: Stage, optimizer: Optimizer) -> None:
        """The epochs of a stage that are left."""
        position = self.state.position
        total = self.data.observation.points.shape[0]
        used, samples = self.method.rows(stage, total), min(total, stage.clouds or total)
        size, least = min(stage.batch, samples), self.method.least_batch * self.ranks.count
        if size < least:
            raise ValueError(
                f"batch: expected at least {least} clouds in a step of {self.method.name} on "
                f"{self.ranks.count} ranks, found {size}"
            )
        steps = samples // size
        for epoch in range(position.epoch, stage.epochs):
            began = time.monotonic()
            self.method.train()
            order = used[self._order(len(used), samples)[: steps * size]]
            for number, index in enumerate(order.split(size)):
                done = (epoch * steps + number) / (stage.epochs * steps)
                self._step(stage, optimizer, index, done)
                self.listener(Progress(stage=stage, epoch=epoch, done=done, loss=self.log.latest))
            self.log.write(position.step, stage.name)
            average_buffers(self.method, self.ranks)
            position.epoch = epoch + 1
            seconds = time.monotonic() - began
            position.spend(stage.name, seconds)
            position.rates[stage.name] = steps * size / seconds
            self.log.scalar("samples_per_second", steps * size / seconds, position.step)
            if stage.validate_every and position.epoch % stage.validate_every == 0:
                self._validate(stage)
            if self._due(self.saved, self.config.checkpoint_every):
                self._save(optimizer)
            every = self.config.pictures_every
            if every is not None and self._due(self.drawn, every) and epoch + 1 < stage.epochs:
                self._draw(stage)

    def _order(self, count: int, samples: int) -> Int[Tensor, " N"]:
        """So many numbers below `count`, or more: all in random order, and again.

        Raises:
            ValueError: There is no such number.
        """
        if not count:
            raise ValueError("rows: expected one cloud or more to learn from, found none")
        passes = range(-(-samples // count))
        return torch.cat([torch.randperm(count, generator=self.state.order) for _ in passes])

    @torch.no_grad()
    def _validate(self, stage: Stage) -> None:
        """One pass over the validation clouds; the best state so far is kept."""
        data, position, total = cast("TrainingData", self.data.validation), self.state.position, 0.0
        count = data.observation.points.shape[0]
        self.method.eval()
        noise = torch.Generator(self.config.device).manual_seed(self.config.seed)
        done = position.epoch / stage.epochs
        for index in torch.arange(count, device=self.config.device).split(stage.batch):
            step = Step(stage=stage.name, progress=done, generator=noise, index=index, total=count)
            loss = self.method.validation_loss(*data.batch(index), step)
            total += float(loss) * len(index) / count
        # All ranks hold the same weights, but for rounding: what the first one finds decides.
        mean = float(self.ranks.every(torch.tensor([total]).double(), self.config.device)[0])
        self.log.validation(position.step, stage.name, mean)
        if math.isfinite(mean) and (position.best is None or mean < position.best):
            state = self.method.state_dict()
            position.best = mean
            self.state.best = {name: value.detach().cpu().clone() for name, value in state.items()}

    def _take_best(self) -> None:
        """The method as it was at the least validation loss of the stage that ends."""
        if self.state.best:
            self.method.load_state_dict(self.state.best)
        self.state.best, self.state.position.best = {}, None

    def _due(self, last: float, every: float) -> bool:
        """Whether so many seconds are over; the ranks agree, as each has its own clock."""
        over = torch.tensor([float(time.monotonic() - last > every)], device=self.config.device)
        return bool(self.ranks.total(over) > 0)

    def _step(self, stage: Stage, optimizer: Optimizer, index: Tensor, done: float) -> None:
        """One batch."""
        rate = schedule(stage, optimizer, done)
        own = self.ranks.share(index)
        share = len(own) / len(index)
        own = own.to(self.config.device)
        total = self.data.observation.points.shape[0]
        step = Step(
            stage=stage.name, progress=done, generator=self.state.noise, index=own, total=total
        )
        observation, labels = self.data.batch(own)
        compute = partial(self.method.losses, observation, labels, step)
        try:
            values = self.descent.step(optimizer, compute, share)
        except NotFiniteError as problem:
            message = self._post_mortem(problem, stage, own)
            self.ranks.wait()  # the first to end takes the others with it
            raise TrainingError(message) from None
        self.state.position.step += 1
        if values is not None:
            weighted = {name: value.detach() * share for name, value in values.items()}
            self.log.collect(weighted, rate)
        if self.state.position.step % self.config.log_every == 0:
            self.log.write(self.state.position.step, stage.name)

    def _post_mortem(self, problem: NotFiniteError, stage: Stage, index: Tensor) -> str:
        """Save the batch where it is this rank's; the message that names it."""
        path, step = self.folder.path / BAD_BATCH, self.state.position.step
        found = f"rank {problem.rank} with another"
        if problem.rank == self.ranks.rank:
            observation, _ = self.data.batch(index)
            found = save_batch(path, stage.name, observation.points, index, problem.terms)
        return (
            f"{path}: expected a finite {problem.what} in stage {stage.name!r} at step {step}, "
            f"found {found}; the batch is saved there"
        )

    def _draw(self, stage: Stage) -> None:
        """The method's pictures of a few fixed clouds, by the first rank."""
        self.drawn = time.monotonic()
        if self.config.pictures_every is not None and self.ranks.first:
            draw_progress(
                self.method, self.data.observation, stage.name, self.log, self.state.position.step
            )

    def _save(self, optimizer: Optimizer | None, *, finished: bool = False) -> None:
        noises = self.ranks.every(self.state.noise.get_state(), self.config.device)
        self.state.position.scaler = self.descent.scaler.state_dict()
        if self.ranks.first:
            self.folder.save(self.state, noises, optimizer, finished=finished)
        self.saved = time.monotonic()
