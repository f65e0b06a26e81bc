# SPDX-License-Identifier: MIT
"""`train`: fit a method to the training split of a data set, and find the object's frame."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from bench.methods import all_methods, check_points
from bench.requests import TrainRequest
from bench.run_files import TIMING
from bench.runs.align import align
from bench.runs.report import REPORT, write_report
from scapo.categories import CATEGORIES
from scapo.interrupt import interrupted_imports
from scapo.method import AbstractMethod
from scapo.store import Split, open_split
from scapo.store.checkpoint import WEIGHTS
from scapo.store.definitions import category_of
from scapo.store.samples import TrainingData, read_training_data
from scapo.store.schema import StoreError
from scapo.text import UsageError, unknown_word
from scapo.training import fit
from scapo.training.distributed import joined, own_device
from scapo.training.precision import Arithmetic
from scapo.training.run_folder import kept


def train(
    request: TrainRequest[Any], say: Callable[[str], None], listener: fit.Listener = fit.silent
) -> tuple[Path, Path] | None:
    """Fit a method, in one process or as one of torchrun's, and write the report of the run.

    Args:
        request: What is fitted to what.
        say: Told what begins.
        listener: Told of the progress. Both hear from the first process alone.

    Returns:
        Checkpoint and report; None in the other processes.

    Raises:
        StoreError: No such data, or a run that must not be continued.
        KeyboardInterrupt: Interrupted; the message says what was kept.
    """
    device = own_device(pick_device(request.device))
    try:
        with interrupted_imports(), joined(device) as ranks:
            try:
                _fit(request, device, say if ranks.first else None, listener)
                if ranks.first:
                    align(request.out, _training_split(request), device, say)
            finally:  # a run that stops early has its page too
                if ranks.first and (request.out / TIMING).is_file():
                    write_report(request.out)
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(f"{request.out}: interrupted; {kept(request.out)}") from stop
    return (request.out / WEIGHTS, request.out / REPORT) if ranks.first else None


def _fit(
    request: TrainRequest[Any],
    device: str,
    say: Callable[[str], None] | None,
    listener: fit.Listener,
) -> None:
    """Read the split, build the method and fit it."""
    methods, config_type = all_methods(), type(request.method)
    name = next(name for name, entry in methods.items() if entry.kind is config_type)
    split = _training_split(request)
    kind = category_of(split.manifest)
    generator = torch.Generator().manual_seed(request.seed)
    method = methods[name].build(request.method, kind, generator)
    if method.name != name:
        raise ValueError(f"{name}: expected a method of that name, found {method.name}")
    check_points(method, split)
    precision = Arithmetic(precision=request.precision, compiled=request.compile, tf32=request.tf32)
    config = fit.FitConfig(
        seed=request.seed,
        device=device,
        log_every=request.log_every,
        checkpoint_every=request.checkpoint_every,
        arithmetic=precision,
        pictures_every=request.pictures_every if request.pictures else None,
        workers=torch.get_num_threads() if request.workers is None else request.workers,
    )
    size = sum(parameter.numel() for parameter in method.parameters())
    if say is not None:
        say(
            f"{name} on {split.manifest.count} clouds of {request.category}: {size:,} parameters, "
            f"device {config.device}"
        )
    data = read_training_data(split)
    if any(stage.validate_every for stage in method.stages()):
        data = replace(data, validation=_validation(request, method))
    logging.getLogger("scapo").setLevel(logging.WARNING if say is None else logging.INFO)
    shown = fit.silent if say is None else listener
    fit.fit(method, data, request.out, config, resume=request.resume, listener=shown)


def _training_split(request: TrainRequest[Any]) -> Split:
    """The split to train on.

    Raises:
        StoreError: The data have none of that category.
        UsageError: Neither have they, nor is there such a category.
    """
    try:
        return open_split(request.data, request.category, request.split)
    except StoreError as error:
        if request.category in CATEGORIES:
            raise
        said = unknown_word("category", request.category, CATEGORIES)  # the likelier mistake
        raise UsageError(said) from error


def _validation(request: TrainRequest[Any], method: AbstractMethod) -> TrainingData | None:
    """The split for validation, where the data have it."""
    try:
        split = open_split(request.data, request.category, request.val_split)
    except StoreError:
        return None
    check_points(method, split)
    return read_training_data(split)


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
