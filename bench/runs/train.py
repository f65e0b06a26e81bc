# SPDX-License-Identifier: MIT
"""`scapo-bench train METHOD`: fit a method to the training split of a data set."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar, Union

import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bench.methods import METHODS
from bench.runs.report import REPORT, write_report
from scapo.categories import category
from scapo.store import open_split
from scapo.store.checkpoint import WEIGHTS
from scapo.store.samples import read_training_data
from scapo.training import fit
from scapo.training.distributed import joined, own_device
from scapo.training.precision import Arithmetic, Precision
from scapo.training.run_folder import TIMING, kept

M = TypeVar("M")


@dataclass(frozen=True, slots=True, kw_only=True)
class Train(Generic[M]):
    """Fit a method to one category; the run folder keeps config, log, curve and checkpoint."""

    method: Annotated[M, tyro.conf.arg(name="")]
    category: str
    """Category of the data."""
    data: Path
    """Data set: the folder above CATEGORY/train, or above that of a benchmark."""
    out: Path
    """Run folder."""
    split: str = "train"
    """Split to train on."""
    device: str = "auto"
    """auto (CUDA where there is a GPU), cpu, cuda, cuda:1, ..."""
    seed: int = 1
    """Of the first weights, the order of the data and the augmentation."""
    resume: bool = False
    """Continue the run in that folder, or begin it where there is none."""
    log_every: int = 10
    """Steps between two lines of metrics.jsonl."""
    checkpoint_every: float = 60.0
    """Seconds after which the end of an epoch saves the state."""
    precision: Precision = "float32"
    """Of the networks' matrix products; geometry and losses stay float32."""
    compile: bool = False
    """Compile the networks, on CUDA with CUDA graphs."""
    tf32: bool = True
    """On CUDA, float32 matrix products of networks with 10-bit mantissas."""
    pictures_every: float = 300.0
    """Seconds after which the end of an epoch draws pictures, as does the end of a stage."""
    pictures: bool = True
    """Draw pictures at all."""

    def run(self, console: Console) -> None:
        """Fit the method, one process or as one of torchrun's, and write the report."""
        device = own_device(pick_device(self.device))
        try:
            with joined(device) as ranks:
                try:
                    self._fit(device, console if ranks.first else Console(quiet=True))
                finally:  # a run that stops early has its page too
                    if ranks.first and (self.out / TIMING).is_file():
                        write_report(self.out)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(f"{self.out}: interrupted; {kept(self.out)}") from stop
        if ranks.first:
            console.print(f"Run: {self.out / WEIGHTS}, {self.out / REPORT}", soft_wrap=True)

    def _fit(self, device: str, console: Console) -> None:
        """Read the split, build the method, fit it with a progress bar."""
        name = next(name for name, entry in METHODS.items() if isinstance(self.method, entry.kind))
        kind = category(self.category)
        split = open_split(self.data, self.category, self.split)
        generator = torch.Generator().manual_seed(self.seed)
        method = METHODS[name].build(self.method, kind, generator)
        config = fit.FitConfig(
            seed=self.seed,
            device=device,
            log_every=self.log_every,
            checkpoint_every=self.checkpoint_every,
            arithmetic=Arithmetic(precision=self.precision, compiled=self.compile, tf32=self.tf32),
            pictures_every=self.pictures_every if self.pictures else None,
        )
        size = sum(parameter.numel() for parameter in method.parameters())
        console.print(
            f"{name} on {split.manifest.count} clouds of {self.category}: {size:,} parameters, "
            f"device {config.device}"
        )
        data = read_training_data(split)
        logging.getLogger("scapo").setLevel(logging.WARNING if console.quiet else logging.INFO)
        with _bars(console) as progress:
            fit.fit(method, data, self.out, config, resume=self.resume, listener=_Bar(progress))


def train_verb(preset: str | None) -> Any:  # noqa: ANN401 - a type made at run time
    """`Train` over all methods, their flags defaulting to the preset of that name."""
    methods = [
        Annotated[entry.kind, tyro.conf.subcommand(name, default=entry.preset(preset))]
        for name, entry in METHODS.items()
    ]
    return Train[Union[tuple(methods)]]  # noqa: UP007 - the tuple is not known to the type checker


def prepare(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    """Words for tyro, and the preset that `--preset` names.

    The preset decides the other flags' defaults, so it is looked up before they are parsed.
    `--supervision` takes its labels with commas as well as with spaces.

    >>> prepare(["train", "scapo", "--preset", "cpu", "--supervision", "segmentation,joint"])
    (['train', 'scapo', '--preset', 'cpu', '--supervision', 'segmentation', 'joint'], 'cpu')
    """
    words: list[str] = []
    for word in arguments:
        flag, _, value = word.partition("=")
        words += [flag, value] if flag in ("--preset", "--supervision") and value else [word]
    pairs = list(zip(["", *words], words, strict=False))
    preset = next((word for before, word in pairs if before == "--preset"), None)
    split = [word.split(",") if before == "--supervision" else [word] for before, word in pairs]
    return [piece for pieces in split for piece in pieces], preset


def pick_device(name: str) -> str:
    """The device of a flag; `auto` prefers CUDA.

    Raises:
        ValueError: No such device here.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        found = str(error).splitlines()[0]
        raise ValueError(f"--device {name}: expected a device of this machine: {found}") from error
    return name


def _bars(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>5.1f} %  loss {task.fields[loss]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


class _Bar:
    """One progress bar per stage."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.tasks: dict[str, Any] = {}

    def __call__(self, step: fit.Progress) -> None:
        name = step.stage.name
        if name not in self.tasks:
            self.tasks[name] = self.progress.add_task(name, total=1.0, loss="")
        loss = "" if step.loss is None else f"{step.loss:.4f}"
        self.progress.update(self.tasks[name], completed=step.done, loss=loss)
