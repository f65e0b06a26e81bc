# SPDX-License-Identifier: MIT
"""A network for other runtimes: a graph of torch's own (`torch.export`), or an ONNX file.

The batch may have any size. Extra `onnx` for files.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from scapo.store.files import write_bytes

if TYPE_CHECKING:
    from torch.export import ExportedProgram

OPSET = 18


def export_network(network: nn.Module, example: Tensor) -> ExportedProgram:
    """The network as a graph without Python, in eval mode.

    Args:
        network: Of one tensor, in operations that can be traced.
        example: Of the input's shape; its first dimension, at least 2 here, may then be any.
    """
    with _quiet():
        return torch.export.export(
            network.eval(), (example,), dynamic_shapes=({0: torch.export.Dim("batch", min=1)},)
        )


def write_onnx(network: nn.Module, example: Tensor, outputs: Sequence[str], path: Path) -> None:
    """Write the network as one ONNX file, atomically.

    Args:
        network: As of `export_network`.
        example: As of `export_network`.
        outputs: Names of what the network returns, in that order; the input is called `cloud`.
        path: The file, usually `*.onnx`.

    Raises:
        ImportError: The extra `onnx` is not installed.
    """
    with _quiet():
        made = torch.onnx.export(
            export_network(network, example),
            input_names=["cloud"],
            output_names=list(outputs),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    if made is None:
        raise RuntimeError(f"{path}: expected an ONNX program, found none")
    write_bytes(path, made.model_proto.SerializeToString())


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's remarks on itself."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
