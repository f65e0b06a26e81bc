# SPDX-License-Identifier: MIT
"""`predict`: a trained method's answers to a split, as a predictions file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int

from bench.methods import check_points, find, load
from bench.requests import PredictRequest
from bench.run_files import TIMING, read_timing
from bench.runs.train import pick_device
from bench.scoring.scores import to_arrays
from scapo.alignment import Alignment, ObjectFrame
from scapo.answer import answered
from scapo.method import AbstractMethod, OracleMethod, evenly
from scapo.records import map_tensors
from scapo.released import find as find_checkpoint
from scapo.store import Split, open_split
from scapo.store.checkpoint import check_header, require_fields
from scapo.store.definitions import foreign
from scapo.store.files import Arrays, require_suffix
from scapo.store.files import Header as StoredHeader
from scapo.store.predictions import Header, write_predictions
from scapo.store.provenance import machine
from scapo.store.samples import SampleDataset, label, observe, observed

RUN_FIELDS = ("commit", "config", "data_digest", "machine", "seed", "training")
"""Of the checkpoint's header, handed on to scores and tables."""


Watch = Callable[[Sequence[torch.Tensor]], Iterable[torch.Tensor]]
"""Passes batches on."""


def predict(request: PredictRequest, watch: Watch = iter) -> tuple[int, float]:
    """Load the method, predict batch by batch and write the file.

    Args:
        request: What is predicted, and how.
        watch: Passes the batches on, and may show how far it is.

    Returns:
        How many clouds were answered, and the seconds of each: the method's alone, without
        what it takes to load it and to read the clouds.

    Raises:
        ValueError: `oracle` for a method that cannot use labels, `up` for one that has no use for
            it; no clouds at all, or at a time; clouds of fewer points than the method needs.
        StoreError: No checkpoint, no such data, or a file of another suffix to write.
    """
    require_suffix(request.out, ".safetensors")
    request.out.parent.mkdir(parents=True, exist_ok=True)  # fails before an hour's work, not after
    for name, count in (("limit", request.limit), ("batch", request.batch)):
        if count is not None and count < 1:
            raise ValueError(f"{name}: expected 1 or more, found {count}")
    run = find_checkpoint(request.checkpoint)
    method, header = load(run)
    require_fields(header, ("seed", "steps"), run)
    device = pick_device(request.device)
    method.to(device)
    known = check_header(header, str(run)).alignment
    alignment = None if request.own_frame else known
    oracle = _oracle_words(method) if request.oracle else []
    _tell_up(method, known, request)
    split = open_split(request.data, header["category"], request.split)
    check_points(method, split)
    samples = SampleDataset(split, observed(split))
    chosen = evenly(len(samples), request.limit)
    parts, seconds = list[Arrays](), 0.0
    for index in watch(chosen.split(request.batch)):
        batch = samples.batch(index)
        started = time.perf_counter()
        parts.append(_answer(request, method, batch, device, alignment))  # waits for the device
        seconds += time.perf_counter() - started
    words = [request.row or method.variant, "" if request.mode == "fast" else request.mode, *oracle]
    words += ["up"] * request.up
    budget = {
        "device": device,
        "processor": _processor(device),
        "batch": request.batch,
        "parameters": sum(item.numel() for item in method.parameters()),
        "steps": header["steps"],
        **timing(run),
        "seconds_per_cloud": round(seconds / len(chosen), 6),
    }
    made = _made(method, header, "-".join(word for word in words if word), split, budget)
    made = replace(made, object_frame=ObjectFrame.of(alignment))
    write_predictions(request.out, made, joined(parts, chosen.numpy(), len(samples)))
    return len(chosen), seconds / len(chosen)


def _tell_up(method: AbstractMethod, known: Alignment | None, request: PredictRequest) -> None:
    """Which way is up in the method's own frame.

    Raises:
        ValueError: It is to be told more and cannot use it.
    """
    method.up = None if known is None else known.up(method.axes())
    if request.up and not (method.takes_up and method.up is not None):
        raise ValueError(f"--up: expected a model that can use it, found {method.name}")


def _made(
    method: AbstractMethod, header: StoredHeader, variant: str, split: Split, budget: dict[str, Any]
) -> Header:
    """The header of the predictions of a checkpoint with this header."""
    entry = find(header["method"])
    return Header(
        method=method.name,
        variant=variant,
        category=header["category"],
        split=split.manifest.split,
        seed=header["seed"],
        data_digest=split.manifest.digest,
        supervision=tuple(sorted(method.supervision)),
        camera=entry.camera if entry is not None and method.camera is None else method.camera,
        budget=budget,
        run={name: header[name] for name in RUN_FIELDS if name in header},
        definition=foreign(method.category),
    )


def _processor(device: str) -> str:
    """The name of what computes, with the number of cores and threads of a CPU."""
    found = machine(device)
    cores = f"{found['cpu']}, {found['cores']} cores, {found['threads']} threads"
    return str(found.get("gpu", cores))


def _oracle_words(method: AbstractMethod) -> list[str]:
    """What the variant says of labels at test time.

    Raises:
        ValueError: The method cannot use any.
    """
    if not isinstance(method, OracleMethod):
        raise ValueError(f"--oracle: expected a method that takes one, found {method.name}")
    return [f"oracle-{'-'.join(sorted(method.oracle))}"]


def _answer(
    request: PredictRequest,
    method: AbstractMethod,
    samples: dict[str, torch.Tensor],
    device: str,
    alignment: Alignment | None,
) -> Arrays:
    """The tensors of a predictions file for some samples."""
    batch = map_tensors(samples, lambda tensor: tensor.to(device))
    observation = observe(batch)
    if request.up:
        observation = replace(observation, up=batch["camera_T_part"][:, 0, :3, 2])
    if request.oracle and isinstance(method, OracleMethod):
        return to_arrays(method.predict_given(observation, label(batch).keep(method.oracle)))
    return to_arrays(answered(method, observation, request.mode, alignment))


def joined(parts: Sequence[Arrays], chosen: Int[np.ndarray, " K"], count: int) -> Arrays:
    """The answers of batches one after the other, NaN for the samples that are not `chosen`."""
    out = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if len(chosen) == count:
        return out
    full = {name: np.full((count, *array.shape[1:]), np.nan, array.dtype)
            for name, array in out.items()}  # fmt: skip
    for name, array in full.items():
        array[chosen] = out[name]
    return full


def timing(run: Path) -> dict[str, Any]:
    """Seconds of training and memory at its peak (1e9 bytes), where the run folder is at hand."""
    folder = run if run.is_dir() else run.parent
    if not (folder / TIMING).is_file():
        return {}
    told = read_timing(folder)
    memory = {"training_gigabytes": round(told.memory / 1e9, 2)} if told.memory else {}
    return {"training_seconds": round(told.seconds, 1), **memory}
