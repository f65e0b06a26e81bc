# SPDX-License-Identifier: MIT
"""The folder of a run: what it says of itself, and the state from which it continues."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scapo.method import AbstractMethod
from scapo.store import checkpoint, provenance
from scapo.store.files import Arrays, Header, canonical_json, read, read_header, write, write_bytes
from scapo.store.schema import StoreError

CONFIG = "config.json"
TIMING = "timing.json"
"""What differs from run to run, apart from all that does not."""
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
    scaler: dict[str, float] = field(default_factory=dict)
    """State of the gradient scaler of float16."""

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


class RunFolder:
    """Files of one run; only the first rank writes."""

    def __init__(self, path: Path, method: AbstractMethod, about: Header, device: str) -> None:
        """Of a method, with `about` (seed, data digest, training) to be told in its headers."""
        self.path, self.method, self.about, self.device = path, method, about, device

    def header(self, position: Position, *, finished: bool) -> Header:
        """What checkpoint and config.json say."""
        extra: dict[str, Any] = {
            **self.about,
            "supervision": sorted(self.method.supervision),
            "parameters": sum(item.numel() for item in self.method.parameters()),
            "steps": position.step,
            "finished": finished,
            "commit": provenance.commit(),
            "machine": provenance.machine(self.device),
        }
        return checkpoint.checkpoint_header(
            self.method.name, self.method.config, self.method.category.name, extra
        )

    def begin(self) -> None:
        """Write config.json."""
        text = json.dumps(self.header(Position(), finished=False), indent=1, sort_keys=True)
        write_bytes(self.path / CONFIG, (text + "\n").encode())

    def found(self, *, resume: bool) -> bool:
        """Whether there is a run to continue.

        Raises:
            StoreError: There is one, and `resume` is not asked for.
        """
        there = (self.path / checkpoint.TRAINING).is_file()
        if there and not resume:
            raise StoreError(f"{self.path}: expected no run there, found one; resume continues it")
        return there

    def load(self, state: State, rank: int = 0) -> tuple[bool, Arrays | None]:
        """Load the method and `state`; whether the run is finished, and Adam's part of it.

        Raises:
            StoreError: The run there is of another method, configuration, seed or data.
        """
        path = self.path / checkpoint.TRAINING
        arrays, header = read(path, checkpoint.TRAINING_FORMAT)
        self._check_same(path, header["header"])
        checkpoint.load_arrays(self.method, arrays, path, "weights/")
        state.order.set_state(torch.from_numpy(arrays["generator/order"].copy()))
        state.noise.set_state(torch.from_numpy(arrays[noise_name(rank)].copy()))
        state.position = Position(**header["position"])
        return header["header"]["finished"], arrays if header["optimizer"] else None

    def _check_same(self, path: Path, found: Header) -> None:
        expected = json.loads(canonical_json(self.header(Position(), finished=False)))
        for name in SAME:
            if found.get(name) != expected[name]:
                raise StoreError(
                    f"{path}: {name}: expected {canonical_json(expected[name])} to resume, "
                    f"found {canonical_json(found.get(name))}"
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
            optimizer: Adam in the middle of a stage.
            finished: Whether nothing is left to do.
        """
        arrays = checkpoint.to_arrays(self.method, "weights/")
        arrays |= {} if optimizer is None else checkpoint.adam_arrays(optimizer)
        arrays["generator/order"] = checkpoint.array(state.order.get_state())
        for rank, noise in enumerate(noises):
            arrays[noise_name(rank)] = checkpoint.array(noise)
        header = self.header(state.position, finished=finished)
        training = {
            "format": checkpoint.TRAINING_FORMAT,
            "position": asdict(state.position),
            "optimizer": optimizer is not None,
            "header": header,
        }
        checkpoint.write_checkpoint(self.path / checkpoint.WEIGHTS, self.method, header)
        timing = {
            "seconds": state.position.seconds,
            "samples_per_second": state.position.rates,
            "stage_seconds": state.position.spent,
        }
        write_bytes(self.path / TIMING, (json.dumps(timing, indent=1) + "\n").encode())
        write(self.path / checkpoint.TRAINING, arrays, training)


def noise_name(rank: int) -> str:
    """Where the generator of a rank is kept."""
    return f"generator/noise/{rank}" if rank else "generator/noise"


def kept(run: Path) -> str:
    """What an interrupted run leaves in its folder, in words."""
    path = run / checkpoint.TRAINING
    try:
        step = read_header(path, checkpoint.TRAINING_FORMAT)["position"]["step"]
    except (StoreError, OSError):
        return "nothing was saved yet"
    return f"saved after step {step}, resume continues from there"
