# SPDX-License-Identifier: MIT
"""Tensors of a frozen record changed, picked or joined all at once, whatever the record is.

Records within records, tuples and mappings are followed; None and what is no tensor stay.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, ParamSpec, TypeVar, cast

import torch
from torch import Tensor, nn

T = TypeVar("T")
P = ParamSpec("P")


def map_tensors(record: T, change: Callable[[Tensor], Tensor]) -> T:
    """The record with `change` applied to each of its tensors.

    >>> from scapo.types import Observation
    >>> map_tensors(Observation(points=torch.zeros(2, 3)), lambda tensor: tensor + 1).points.sum()
    tensor(6.)
    """
    return cast("T", _combined([record], lambda tensors: change(tensors[0])))


def without_autograd(answer: Callable[P, T]) -> Callable[P, T]:
    """A function in torch's inference mode, which takes an eighth off one small cloud's many steps.

    The record that it returns has plain tensors, with which autograd can go on.
    """

    @functools.wraps(answer)
    def answered(*inputs: P.args, **named: P.kwargs) -> T:
        with torch.inference_mode():
            record = answer(*inputs, **named)
        return map_tensors(record, Tensor.clone)

    return answered


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


def either(mask: Tensor, one: T, other: T) -> T:
    """A record with each row that of `one` where the mask (B) holds, else that of `other`.

    >>> from scapo.types import Observation
    >>> both = [Observation(points=torch.full((2, 1, 3), value)) for value in (1.0, 2.0)]
    >>> either(torch.tensor([True, False]), *both).points[:, 0, 0]
    tensor([1., 2.])
    """
    rows = torch.arange(len(mask), device=mask.device)
    return take(cat([one, other]), torch.where(mask, rows, rows + len(mask)))


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


def pack(record: object, makers: Container[str]) -> tuple[Any, dict[str, Tensor]]:
    """A record as JSON and flat tensors, for storage; `unpack` is the inverse.

    Lists, modules and numbers may be in it too. Tensors keep their strides, by which sums and
    products of equal numbers can differ in the last bit.

    Args:
        record: Whatever is to be stored.
        makers: Names of the records and modules that `unpack` can make.

    Raises:
        TypeError: There is something else in it.
    """
    tensors: dict[str, Tensor] = {}
    return _packed(record, makers, tensors), tensors


def _packed(value: Any, makers: Container[str], tensors: dict[str, Tensor]) -> Any:  # noqa: ANN401 - whatever a record holds
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return {"float": value.hex()}
    if isinstance(value, Tensor):
        name = f"tensor/{len(tensors)}"
        size, stride = list(value.shape), list(value.stride())
        tensors[name] = value.detach().as_strided((_extent(size, stride),), (1,)).clone()
        return {"tensor": name, "size": size, "stride": stride}
    if isinstance(value, list | tuple):
        kind = "list" if isinstance(value, list) else "tuple"
        items = cast("Sequence[Any]", value)
        return {kind: [_packed(item, makers, tensors) for item in items]}
    kind = type(value).__name__
    if kind not in makers:
        raise TypeError(f"records: expected one that can be made again, found {kind}")
    if isinstance(value, nn.Module):
        held: dict[str, Any] = value.state_dict()
    else:
        held = {item.name: getattr(value, item.name) for item in fields(value) if item.init}
    return {"record": kind, "fields": {n: _packed(x, makers, tensors) for n, x in held.items()}}


def unpack(
    tree: Any,  # noqa: ANN401 - JSON
    tensors: Mapping[str, Tensor],
    makers: Mapping[str, Callable[..., Any]],
) -> Any:  # noqa: ANN401 - whatever was packed
    """What `pack` was given.

    Args:
        tree: As `pack` returned it.
        tensors: Likewise.
        makers: For each kind of record and module that may be in it what makes one, called with
            its fields, or the tensors of its state; nothing else is called.

    Raises:
        LookupError: A tensor or a maker that is not there.
        ValueError: No such tree, or a tensor of another size.

    >>> from scapo.types import Observation
    >>> makers = {"Observation": Observation}
    >>> tree, tensors = pack([Observation(points=torch.eye(3)), 0.1], makers)
    >>> unpack(tree, tensors, makers)[0].points.trace(), tree["list"][1]
    (tensor(3.), {'float': '0x1.999999999999ap-4'})
    """
    if not isinstance(tree, dict):
        return tree
    node = cast("dict[str, Any]", tree)
    if "tensor" in node:
        flat, size, stride = tensors[node["tensor"]], node["size"], node["stride"]
        if len(size) != len(stride) or flat.shape != (_extent(size, stride),):
            raise ValueError(f"expected a tensor of size {size}, found {tuple(flat.shape)}")
        return flat.as_strided(size, stride)
    if "record" in node:
        held = {name: unpack(item, tensors, makers) for name, item in node["fields"].items()}
        return makers[node["record"]](**held)
    if "float" in node:
        return float.fromhex(node["float"])
    items = [unpack(item, tensors, makers) for item in node["list" if "list" in node else "tuple"]]
    return items if "list" in node else tuple(items)


def _extent(size: Sequence[int], stride: Sequence[int]) -> int:
    """Numbers of storage that a tensor reaches over."""
    if 0 in size:
        return 0
    return 1 + sum((many - 1) * step for many, step in zip(size, stride, strict=True))
