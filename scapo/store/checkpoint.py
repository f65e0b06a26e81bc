# SPDX-License-Identifier: MIT
"""Weights and training state on disk: safetensors with one header, no pickle.

`checkpoint.safetensors` holds the weights and all that is needed to build the method again;
`training.safetensors` beside it holds weights, optimiser and generators at one moment, in one
file so that a killed run can never pair the weights of one step with the state of another.
"""

from __future__ import annotations

import platform
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from scapo.geometry.points import MEAN_RADIUS
from scapo.store.files import CHECKPOINT, Arrays, Header, read, write
from scapo.store.json_records import StoreError, from_json

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
    """Fill a module's state dict.

    Raises:
        StoreError: A tensor is missing, left over or of another shape.
    """
    state = {
        name.removeprefix(prefix): torch.from_numpy(value.copy())
        for name, value in arrays.items()
        if name.startswith(prefix)
    }
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        found = " ".join(str(error).split())
        raise StoreError(f"{where}: expected the method's tensors, found {found}") from error


def adam_arrays(optimizer: torch.optim.Optimizer) -> Arrays:
    """Adam's state as `adam/<parameter number>/<name>`, numbered as its parameter groups are."""
    state: dict[int, dict[str, Tensor]] = optimizer.state_dict()["state"]
    return {
        f"adam/{number}/{name}": array(value)
        for number, values in state.items()
        for name, value in values.items()
    }


def load_adam(optimizer: torch.optim.Optimizer, arrays: Arrays) -> None:
    """The inverse of `adam_arrays`; learning rates stay as they are."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in arrays.items():
        if key.startswith("adam/"):
            _, number, name = key.split("/")
            state.setdefault(int(number), {})[name] = torch.from_numpy(value.copy())
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": state, "param_groups": groups})


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


def read_checkpoint(path: Path) -> tuple[Arrays, Header]:
    """Weights and header of a checkpoint or of the run folder that holds one.

    Raises:
        StoreError: None there, or another format.
    """
    return read(path / WEIGHTS if path.is_dir() else path, CHECKPOINT)


def config_from(kind: type[T], data: object, where: str) -> T:
    """A configuration dataclass from its JSON form, nested ones included.

    Raises:
        StoreError: A field is unknown or of another type; missing ones take their default.
    """
    return from_json(kind, data, where, others="refuse", link=".")
