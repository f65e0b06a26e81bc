# SPDX-License-Identifier: MIT
"""Tensors of a frozen record changed, picked or joined all at once, whatever the record is.

Records within records, tuples and mappings are followed; None and what is no tensor stay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

T = TypeVar("T")


def map_tensors(record: T, change: Callable[[Tensor], Tensor]) -> T:
    """The record with `change` applied to each of its tensors.

    >>> from scapo.types import Observation
    >>> map_tensors(Observation(points=torch.zeros(2, 3)), lambda tensor: tensor + 1).points.sum()
    tensor(6.)
    """
    return cast("T", _combined([record], lambda tensors: change(tensors[0])))


def take(record: T, index: Tensor) -> T:
    """Rows of all tensors: `index` counts along their first dimension, or masks it."""
    return map_tensors(record, lambda tensor: tensor[index])


def cat(records: Sequence[T]) -> T:
    """One record from several of one kind, tensors joined along their first dimension.

    Raises:
        ValueError: No record, or a tensor that some have and others lack.
    """
    if not records:
        raise ValueError("records: expected one or more to join, found none")
    return cast("T", _combined(records, lambda tensors: torch.cat(list(tensors))))


def _combined(values: Sequence[Any], join: Callable[[Sequence[Tensor]], Tensor]) -> Any:  # noqa: ANN401
    """What stands at one place of several records, as one; other than tensors as in the first."""
    first = values[0]
    if any(type(value) is not type(first) for value in values):
        kinds = sorted({type(value).__name__ for value in values})
        raise ValueError(f"records: expected the same fields in all, found {' and '.join(kinds)}")
    if isinstance(first, Tensor):
        return join(values)
    if isinstance(first, tuple):
        items = [_combined(list(item), join) for item in zip(*values, strict=True)]
        return type(first)(*items) if hasattr(first, "_fields") else tuple(items)
    if isinstance(first, Mapping):
        known = cast("Mapping[Any, Any]", first)
        return {name: _combined([value[name] for value in values], join) for name in known}
    if is_dataclass(first) and not isinstance(first, type):
        names = [item.name for item in fields(first) if item.init]
        changed = {n: _combined([getattr(value, n) for value in values], join) for n in names}
        return replace(cast("Any", first), **changed)
    return first
