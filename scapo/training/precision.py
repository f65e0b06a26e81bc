# SPDX-License-Identifier: MIT
"""Networks in reduced precision or compiled; everything else stays float32.

Only the forward passes of a method's `networks` run under autocast, and what they return is cast
back: poses, neighbours, skinning and losses never see half precision. The same holds for TF32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import torch

from scapo.geometry.numerics import at_least_float32, before_compiling, matrix_products
from scapo.method import AbstractMethod
from scapo.records import map_tensors

T = TypeVar("T")
Precision = Literal["float32", "bfloat16", "float16"]
TYPES: dict[Precision, torch.dtype] = {
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Arithmetic:
    """How networks are computed."""

    precision: Precision = "float32"
    compiled: bool = False
    """torch.compile; on CUDA with CUDA graphs (`reduce-overhead`)."""
    tf32: bool = True
    """Float32 matrix products of networks with 10-bit mantissas, on CUDA alone."""


def require_networks(method: AbstractMethod, arithmetic: Arithmetic) -> None:
    """Refuse a change of networks that the method does not name.

    Raises:
        ValueError: It names none, so that there is nothing to change.
    """
    reduced = arithmetic.precision != "float32"
    if (reduced or arithmetic.compiled) and not method.networks and method.stages():
        asked = arithmetic.precision if reduced else "compilation"
        raise ValueError(
            f"{asked}: expected a method with networks that may be changed, found {method.name}, "
            "which names none"
        )


@contextmanager
def applied(method: AbstractMethod, arithmetic: Arithmetic, device: str) -> Iterator[None]:
    """Compute the method's networks in that way within the block.

    There the method cannot be sent to another process.
    """
    networks = [method.get_submodule(name) for name in method.networks]
    for network in networks:
        network.forward = changed(network.forward, arithmetic, torch.device(device).type)
    try:
        yield
    finally:
        for network in networks:
            del network.forward  # the instance's; the class's remains


def changed(forward: Callable[..., Any], arithmetic: Arithmetic, kind: str) -> Callable[..., Any]:
    """A forward pass computed as `arithmetic` says on a device of that kind."""
    if arithmetic.compiled:
        forward = compiled(forward, kind)
    if arithmetic.precision != "float32":
        forward = _cast(forward, kind, TYPES[arithmetic.precision])
    if arithmetic.tf32 and kind == "cuda":
        forward = _with_tf32(forward)
    return forward


def compiled(forward: Callable[..., Any], kind: str) -> Callable[..., Any]:
    """By torch.compile, one graph per shape; CUDA graphs take the launches away on CUDA."""
    before_compiling()
    mode = "reduce-overhead" if kind == "cuda" else "default"
    # A method meets few shapes (whole, cropped, decoded clouds), each of them at every step.
    torch._dynamo.config.cache_size_limit = max(32, torch._dynamo.config.cache_size_limit)
    return torch.compile(forward, mode=mode, dynamic=False)


def _cast(forward: Callable[..., Any], kind: str, dtype: torch.dtype) -> Callable[..., Any]:
    def run(*inputs: Any, **named: Any) -> Any:  # noqa: ANN401
        with torch.autocast(kind, dtype):
            return full(forward(*inputs, **named))

    return run


def _with_tf32(forward: Callable[..., Any]) -> Callable[..., Any]:
    def run(*inputs: Any, **named: Any) -> Any:  # noqa: ANN401
        with matrix_products("high"):
            return forward(*inputs, **named)

    return run


def full(value: T) -> T:
    """Tensors, and records of them, in float32 where they were in half."""
    return map_tensors(value, lambda one: at_least_float32(one) if one.is_floating_point() else one)


def scaler(precision: Precision, device: str) -> torch.amp.GradScaler:
    """Of the loss, for float16, whose small gradients would vanish; else without effect."""
    return torch.amp.GradScaler(torch.device(device).type, enabled=precision == "float16")


def begin_step(arithmetic: Arithmetic, device: str) -> None:
    """Tell CUDA graphs that the results of the step before are no longer needed."""
    if arithmetic.compiled and device.startswith("cuda"):
        torch.compiler.cudagraph_mark_step_begin()
