# SPDX-License-Identifier: MIT
"""Full float32 where the surroundings may compute with fewer digits: rotations, neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import update_wrapper
from typing import Any, Literal, TypeVar, cast

import torch
from torch import Tensor

F = TypeVar("F", bound=Callable[..., Any])


@contextmanager
def exact(kind: str) -> Iterator[None]:
    """Neither autocast nor TF32 on a device of that kind, for the time of the block."""
    with torch.autocast(kind, enabled=False):
        if kind != "cuda":
            yield
            return
        with matrix_products("highest"):
            yield


@contextmanager
def matrix_products(precision: Literal["highest", "high"]) -> Iterator[None]:
    """Torch's setting for float32 matrix products, for the time of the block."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def at_least_float32(tensor: Tensor) -> Tensor:
    """The same numbers, in float32 where they were in half precision.

    >>> at_least_float32(torch.zeros(1, dtype=torch.bfloat16)).dtype
    torch.float32
    """
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


class _Plain:
    """A function that a compiler leaves alone."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.call = torch.compiler.disable(function) if _COMPILING else function

    def __call__(self, *inputs: Any, **named: Any) -> Any:  # noqa: ANN401 - as the function
        return self.call(*inputs, **named)


_PLAIN: list[_Plain] = []
_COMPILING: list[bool] = []
"""Not empty once something is compiled."""


def uncompiled(function: F) -> F:
    """The function as it is, also where its caller is compiled (after `before_compiling`).

    As `torch.compiler.disable`, which would load the compiler for those who never compile.
    """
    plain = _Plain(function)
    _PLAIN.append(plain)
    return cast("F", update_wrapper(plain, function))


def before_compiling() -> None:
    """Keep `uncompiled` functions from the compiler, from now on."""
    if not _COMPILING:
        _COMPILING.append(True)
        for plain in _PLAIN:
            plain.call = torch.compiler.disable(plain.call)
