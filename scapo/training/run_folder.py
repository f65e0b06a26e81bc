# SPDX-License-Identifier: MIT
"""The folder of a run: what it says of itself, and the state from which it continues."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from scapo.method import AbstractMethod
from scapo.store import checkpoint, provenance
from scapo.store.definitions import definition
from scapo.store.files import (
    Arrays,
    Header,
    canonical_json,
    read,
    read_header,
    require,
    write,
    write_bytes,
)
from scapo.store.json_records import StoreError, from_json, readable_json
from scapo.training.journal import FORMAT, StepHeader, StoredJournal

CONFIG = "config.json"
START = "start"
"""Folder of what the steps of a start made, as long as it goes on."""
TIMING = "timing.json"
"""What differs from run to run, apart from all that does not."""
NOW, BEST = "weights/", "best/"
"""Of the names of the method's tensors in training.safetensors, now and at the best validation."""
SAME = ("method", "category", "config", "seed", "data_digest", "supervision", "training")
"""Fields of the header in which a run and its continuation agree."""


@dataclass(slots=True)
class Position:
    """Where a run is: the next stage and epoch, and the steps done in all."""

    stage: int = 0
    epoch: int = 0
    step: int = 0
    seconds: float = 0.0
    rates: dict[str, float] = field(default_factory=dict)
    """Samples per second of each stage, its last epoch."""
    started: bool = False
    """Whether the method's `start` of the stage is done."""
    spent: dict[str, float] = field(default_factory=dict)
    """Seconds of each stage, the start included."""
    scaler: dict[str, int | float] = field(default_factory=dict)
    """State of the gradient scaler of float16."""
    best: float | None = None
    """The least validation loss of this stage."""
    memory: int = 0
    """Bytes of the first rank at its peak; 0 where the system does not tell."""

    def spend(self, stage: str, seconds: float) -> None:
        """Count time."""
        self.seconds += seconds
        self.spent[stage] = self.spent.get(stage, 0.0) + seconds


@dataclass(slots=True, kw_only=True)
class State:
    """All that a run continues from, beside the method's own tensors."""

    position: Position
    order: torch.Generator
    noise: torch.Generator
    """Of this rank."""
    best: dict[str, Tensor] = field(default_factory=dict)
    """The method's tensors at the least validation loss of this stage."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingHeader:
    """What training.safetensors says of itself."""

    position: Position
    optimizer: bool
    """Whether the state of an optimiser is there."""
    header: dict[str, Any]
    """As the checkpoint's."""


def apart(one: object, other: object) -> tuple[object, object]:
    """Two JSON values, of objects only the keys at which they differ.

    >>> apart({"a": 1, "b": {"c": 2, "d": 3}}, {"a": 1, "b": {"c": 2, "d": 4}})
    ({'b': {'d': 3}}, {'b': {'d': 4}})
    """
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return one, other
    mine, its = cast("dict[str, object]", one), cast("dict[str, object]", other)
    pairs: tuple[dict[str, object], dict[str, object]] = ({}, {})
    for key in sorted({*mine, *its}):
        if key in mine and key in its and mine[key] != its[key]:
            pairs[0][key], pairs[1][key] = apart(mine[key], its[key])
        elif key not in its:
            pairs[0][key] = mine[key]
        elif key not in mine:
            pairs[1][key] = its[key]
    return pairs


class RunFolder:
    """Files of one run; only the first rank writes."""

    def __init__(self, path: Path, method: AbstractMethod, about: Header, device: str) -> None:
        """Of a method, with `about` (seed, data digest, training) to be told in its headers."""
        self.path, self.method, self.about, self.device = path, method, about, device

    def header(self, position: Position, *, finished: bool) -> Header:
        """What checkpoint and config.json say."""
        extra: dict[str, Any] = {
            **self.about,
            **definition(self.method.category),
            "supervision": sorted(self.method.supervision),
            "parameters": sum(item.numel() for item in self.method.parameters()),
            "steps": position.step,
            "moment": [position.stage, int(position.started), position.epoch],
            "finished": finished,
            "commit": provenance.commit(),
            "machine": provenance.machine(self.device),
        }
        return checkpoint.checkpoint_header(
            self.method.name, self.method.config, self.method.category.name, extra
        )

    def begin(self) -> None:
        """Write config.json."""
        header = self.header(Position(), finished=False)
        write_bytes(self.path / CONFIG, readable_json(header).encode())

    def found(self, *, resume: bool) -> bool:
        """Whether there is a run to continue.

        Raises:
            StoreError: There is one, and `resume` is not asked for.
        """
        there, steps = (self.path / checkpoint.TRAINING).is_file(), started(self.path)
        if (there or steps) and not resume:
            raise StoreError(
                f"{self.path}: expected no run there, found one; --resume continues it"
            )
        for path in () if there else steps:
            try:
                known = from_json(StepHeader, read_header(path, FORMAT), f"{path}: header")
            except StoreError:  # the journal says so, and has the step done again
                continue
            self._check_same(path, known.run)
        return there

    def journal(
        self, stage: str, tell: Callable[[str, float, float], None], workers: int = 0
    ) -> StoredJournal:
        """That of a start which begins or goes on, with so many worker processes."""
        header = json.loads(canonical_json(self.header(Position(), finished=False)))
        same = {name: header[name] for name in SAME}
        return StoredJournal(self.path / START, same, stage, tell, workers)

    def load(self, state: State, rank: int = 0) -> tuple[bool, Arrays | None]:
        """Load the method and `state`; whether the run is finished, and the optimiser's part of it.

        Raises:
            StoreError: The run there is of another method, configuration, seed or data, its files
                are damaged, or the checkpoint beside it is not its own.
        """
        path = self.path / checkpoint.TRAINING
        arrays, header = read(path, checkpoint.TRAINING_FORMAT)
        known = from_json(TrainingHeader, header, f"{path}: header")
        checkpoint.check_header(known.header, f"{path}: header: header")
        checkpoint.require_fields(known.header, checkpoint.RUN_FIELDS, path)
        self._check_same(path, known.header)
        self._check_position(path, known.position)
        require(path, ("generator/order", noise_name(rank)), arrays)
        checkpoint.load_arrays(self.method, arrays, path, NOW)
        self._check_checkpoint(path, arrays, known.header)
        try:
            state.order.set_state(torch.from_numpy(arrays["generator/order"].copy()))
            state.noise.set_state(torch.from_numpy(arrays[noise_name(rank)].copy()))
        except (RuntimeError, TypeError) as error:
            raise StoreError(f"{path}: expected states of generators, found {error}") from error
        state.position = known.position
        state.best = {
            name.removeprefix(BEST): torch.from_numpy(value.copy())
            for name, value in arrays.items()
            if name.startswith(BEST)
        }
        return known.header["finished"], arrays if known.optimizer else None

    def _check_position(self, path: Path, position: Position) -> None:
        stages = len(self.method.stages())
        whole = min(position.epoch, position.step, stages - position.stage) >= 0
        if not (whole and position.stage >= 0):
            raise StoreError(
                f"{path}: header: position: expected one in {stages} stages, found stage "
                f"{position.stage}, epoch {position.epoch}, step {position.step}"
            )

    def _check_checkpoint(self, path: Path, arrays: Arrays, training: Header) -> None:
        """Refuse a checkpoint that was not written with this state, or after it.

        A run that was killed between the two files has the newer checkpoint.
        """
        beside = self.path / checkpoint.WEIGHTS
        if not beside.is_file():
            return
        weights, header = checkpoint.read_checkpoint(beside)
        there, here = moment_of(header), moment_of(training)
        own = all(header.get(name) == training.get(name) for name in SAME) and there >= here
        if own and there == here and "moment" in header:
            names = [name.removeprefix(NOW) for name in arrays if name.startswith(NOW)]
            own = set(names) == set(weights) and all(
                np.array_equal(weights[name], arrays[NOW + name]) for name in names
            )
        if not own:
            raise StoreError(
                f"{beside}: expected the weights that belong to {path.name} (step "
                f"{training['steps']}), found those of another run or moment (step "
                f"{header.get('steps')})"
            )

    def _check_same(self, path: Path, found: Header) -> None:
        expected = json.loads(canonical_json(self.header(Position(), finished=False)))
        names = [name for name in SAME if found.get(name) != expected[name]]
        if names:
            asked, there = apart(expected[names[0]], found.get(names[0]))
            more = f" (and another {', '.join(names[1:])})" if names[1:] else ""
            raise StoreError(
                f"{path}: {names[0]}: expected {canonical_json(asked)} to resume, found "
                f"{canonical_json(there)}{more}; --resume takes the flags and data of before, "
                "another --out begins anew"
            )

    def save(
        self,
        state: State,
        noises: Iterable[Tensor],
        optimizer: torch.optim.Optimizer | None,
        *,
        finished: bool = False,
    ) -> None:
        """First the weights alone, then the state that resume reads, whole in one file.

        In that order a run whose state says that it is finished has its weights.

        Args:
            state: Of this rank, the first.
            noises: State of the noise generator of every rank.
            optimizer: In the middle of a stage.
            finished: Whether nothing is left to do.
        """
        position = state.position
        position.memory = max(position.memory, provenance.peak_memory() or 0)
        arrays = checkpoint.to_arrays(self.method, NOW)
        arrays |= {} if optimizer is None else checkpoint.optimiser_arrays(optimizer)
        arrays |= {f"{BEST}{name}": checkpoint.array(value) for name, value in state.best.items()}
        arrays["generator/order"] = checkpoint.array(state.order.get_state())
        for rank, noise in enumerate(noises):
            arrays[noise_name(rank)] = checkpoint.array(noise)
        header = self.header(position, finished=finished)
        training = {
            "format": checkpoint.TRAINING_FORMAT,
            "position": asdict(position),
            "optimizer": optimizer is not None,
            "header": header,
        }
        checkpoint.write_checkpoint(self.path / checkpoint.WEIGHTS, self.method, header)
        timing = {
            "seconds": position.seconds,
            "samples_per_second": position.rates,
            "stage_seconds": position.spent,
            "memory": position.memory,
        }
        write_bytes(self.path / TIMING, (json.dumps(timing, indent=1) + "\n").encode())
        write(self.path / checkpoint.TRAINING, arrays, training)
        shutil.rmtree(self.path / START, ignore_errors=True)  # no start goes on


def moment_of(header: Header) -> tuple[int, ...]:
    """When a file was saved: later ones are greater. Files of before `moment` have steps alone."""
    finished = int(header.get("finished", False))
    return (header.get("steps", 0), *header.get("moment", ()), finished)


def noise_name(rank: int) -> str:
    """Where the generator of a rank is kept."""
    return f"generator/noise/{rank}" if rank else "generator/noise"


def started(run: Path) -> list[Path]:
    """Files of the steps of a start that is not over."""
    return sorted((run / START).glob("*.safetensors"))


def kept(run: Path) -> str:
    """What an interrupted run leaves in its folder, in words."""
    path, steps = run / checkpoint.TRAINING, len(started(run))
    try:
        header = read_header(path, checkpoint.TRAINING_FORMAT)
        step = from_json(TrainingHeader, header, str(path)).position.step
    except (StoreError, OSError):
        if steps:
            return f"saved {steps} steps of its start, resume continues from there"
        return "nothing was saved yet"
    return f"saved after step {step}, resume continues from there"
