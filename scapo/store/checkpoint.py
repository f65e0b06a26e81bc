# SPDX-License-Identifier: MIT
"""Weights and training state on disk: safetensors with one header, no pickle.

`checkpoint.safetensors` holds the weights and all that is needed to build the method again;
`training.safetensors` beside it holds weights, optimiser and generators at one moment, in one
file so that a killed run can never pair the weights of one step with the state of another.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from scapo.alignment import Alignment
from scapo.categories import CATEGORIES, Category
from scapo.geometry.points import MEAN_RADIUS
from scapo.store.definitions import DEFINITION, defined
from scapo.store.files import CHECKPOINT, Arrays, Header, canonical_json, read, write
from scapo.store.json_records import StoreError, from_json
from scapo.types import Supervision

T = TypeVar("T")

WEIGHTS = "checkpoint.safetensors"
TRAINING = "training.safetensors"
TRAINING_FORMAT = "scapo-training/1"


def to_arrays(module: nn.Module, prefix: str = "") -> Arrays:
    """The state dict as numpy arrays."""
    return {f"{prefix}{name}": array(tensor) for name, tensor in module.state_dict().items()}


def array(tensor: Tensor) -> np.ndarray:
    """A copy on the host."""
    return tensor.detach().cpu().numpy().copy()


def load_arrays(module: nn.Module, arrays: Arrays, where: Path, prefix: str = "") -> None:
    """Fill a module's state dict; numbers of half precision, as released models have, are widened.

    Raises:
        StoreError: A tensor is missing, left over, of another shape, or not finite.
    """
    state = {
        name.removeprefix(prefix): _single(torch.from_numpy(value.copy()))
        for name, value in arrays.items()
        if name.startswith(prefix)
    }
    for name, tensor in state.items():
        if not bool(torch.isfinite(tensor).all()):
            raise StoreError(f"{where}: tensor {name!r}: expected finite numbers, found others")
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        found = " ".join(str(error).split())
        raise StoreError(f"{where}: expected the method's tensors, found {found}") from error


def _single(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.dtype == torch.float16 else tensor


def optimiser_arrays(optimizer: torch.optim.Optimizer) -> Arrays:
    """Its state as `adam/<parameter number>/<name>`, numbered as its parameter groups are."""
    state: dict[int, dict[str, Tensor]] = optimizer.state_dict()["state"]
    return {
        f"{_prefix(optimizer)}{number}/{name}": array(value)
        for number, values in state.items()
        for name, value in values.items()
        if isinstance(value, Tensor)
    }


def load_optimiser(optimizer: torch.optim.Optimizer, arrays: Arrays, where: Path) -> None:
    """The inverse of `optimiser_arrays`; learning rates stay as they are.

    Raises:
        StoreError: The arrays are not those of such an optimiser.
    """
    parameters = [one for group in optimizer.param_groups for one in group["params"]]
    prefix = _prefix(optimizer)
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in arrays.items():
        if key.startswith(prefix):
            number, _, name = key.removeprefix(prefix).partition("/")
            known = number.isascii() and number.isdigit() and int(number) < len(parameters)
            shape = tuple(parameters[int(number)].shape) if known else None
            if value.shape not in ((), shape):
                raise StoreError(
                    f"{where}: tensor {key!r}: expected the state of one of {len(parameters)} "
                    f"parameters, of its shape {shape}, found {value.shape}"
                )
            state.setdefault(int(number), {})[name] = torch.from_numpy(value.copy())
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


def _prefix(optimizer: torch.optim.Optimizer) -> str:
    return f"{type(optimizer).__name__.lower()}/"


def versions() -> dict[str, str]:
    """What computed this."""
    return {"python": platform.python_version(), "torch": torch.__version__}


def checkpoint_header(name: str, config: object, category: str, extra: Header) -> Header:
    """What a checkpoint says of itself.

    Args:
        name: Of the method.
        config: Its dataclass.
        category: Name of the category.
        extra: Seed, data digest, supervision and progress of the run.
    """
    if not is_dataclass(config) or isinstance(config, type):
        raise TypeError(f"config: expected a dataclass, found {type(config).__name__}")
    return {
        "format": CHECKPOINT,
        "method": name,
        "config": asdict(config),
        "category": category,
        "normalisation": {"centre": "centroid", "mean_radius": MEAN_RADIUS},
        "versions": versions(),
        **extra,
    }


def write_checkpoint(path: Path, module: nn.Module, header: Header) -> str:
    """Write weights and header atomically; returns the SHA-256."""
    return write(path, to_arrays(module), header)


def with_alignment(path: Path, alignment: Alignment) -> str:
    """Store what brings a method's answers to the object's frame; weights stay bit for bit.

    Returns:
        The file's new SHA-256.
    """
    arrays, header = read_checkpoint(path)
    return write(path, arrays, {**header, **alignment_field(alignment)})


def alignment_field(alignment: Alignment) -> Header:
    """What a header says of an alignment, as JSON has it."""
    return {"alignment": json.loads(canonical_json(asdict(alignment)))}


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckpointHeader:
    """What a checkpoint says of itself, as far as anything here reads it."""

    method: str
    category: str
    config: dict[str, Any]
    seed: int = 0
    data_digest: str = ""
    supervision: tuple[Supervision, ...] = ()
    parameters: int = 0
    steps: int = 0
    moment: tuple[int, ...] = ()
    """Stage, whether it is started, and its epoch: tells what was saved first."""
    finished: bool = False
    commit: str = ""
    machine: dict[str, str | int] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    normalisation: dict[str, str | float] = field(default_factory=dict)
    definition: dict[str, Any] | None = None
    """Of a category that the package has not (`definitions`)."""
    alignment: Alignment | None = None
    """None: answers are in the method's own frames; so are those of checkpoints of before."""


RUN_FIELDS = ("seed", "data_digest", "supervision", "steps", "finished", "versions")
"""What the checkpoint of a run says beside what builds the method."""


def weights_file(path: Path) -> Path:
    """The checkpoint of a run folder, or the file itself."""
    return path / WEIGHTS if path.is_dir() else path


def read_checkpoint(path: Path) -> tuple[Arrays, Header]:
    """Weights and header of a checkpoint or of the run folder that holds one.

    Raises:
        StoreError: None there, another format, or a header without what builds a method or with
            values of other types than those of `CheckpointHeader`.
    """
    path = weights_file(path)
    if not path.exists():
        raise StoreError(
            f"{path}: expected a file, found none; `scapo-bench train METHOD --out RUN` makes one"
        )
    arrays, header = read(path, CHECKPOINT)
    check_header(header, f"{path}: header")
    return arrays, header


def check_header(header: object, where: str) -> CheckpointHeader:
    """The header of a checkpoint or of a training state.

    Raises:
        StoreError: As `read_checkpoint`.
    """
    known = from_json(CheckpointHeader, header, where)
    parts = header_category(known, where).parts
    if known.alignment is not None and len(known.alignment.order) != len(parts):
        raise StoreError(
            f"{where}: alignment: expected that of {len(parts)} parts, found "
            f"{len(known.alignment.order)}"
        )
    return known


def header_category(known: CheckpointHeader, where: str) -> Category:
    """The category that a checkpoint is of, as the header defines it or the package.

    Raises:
        StoreError: Neither does.
    """
    found = defined({DEFINITION: known.definition}, known.category, where)
    if found is None:
        raise StoreError(
            f"{where}: category: expected one of {', '.join(CATEGORIES)} or a definition, found "
            f"{known.category!r}"
        )
    return found


def require_fields(header: Header, names: Iterable[str], where: object) -> None:
    """Refuse a header without one of the fields `names`.

    Raises:
        StoreError: Naming file and field.
    """
    missing = [name for name in names if name not in header]
    if missing:
        raise StoreError(f"{where}: header: expected field {missing[0]!r}, found none")


def config_from(kind: type[T], data: object, where: str) -> T:
    """A configuration dataclass from its JSON form, nested ones included.

    Raises:
        StoreError: A field is unknown or of another type; missing ones take their default.
    """
    return from_json(kind, data, where, others="refuse", link=".")
