# SPDX-License-Identifier: MIT
"""Every node of a JSON value left out or replaced by one of another type."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

OTHERS: tuple[Any, ...] = (None, True, -1.5, 10**400, "x", "\x1b[31m[/x]\n", [], [[]], {}, {"x": 1})


def altered(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[str, Any]]:
    """(what was done, the whole value after it), one node at a time."""
    yield from _altered(value, value, path)


def _altered(whole: Any, node: Any, path: tuple[Any, ...]) -> Iterator[tuple[str, Any]]:
    keys = list(node) if isinstance(node, dict) else range(min(len(node), 2))
    for key in keys:
        here = (*path, key)
        name = "/".join(map(str, here))
        if isinstance(node, dict):
            yield f"{name} left out", _with(whole, here, None, drop=True)
        for other in OTHERS:
            if type(other) is not type(node[key]):
                yield f"{name} = {str(other)[:20]!r}", _with(whole, here, other)
        if isinstance(node[key], (dict, list)):
            yield from _altered(whole, node[key], here)


def _with(whole: Any, path: tuple[Any, ...], value: Any, *, drop: bool = False) -> Any:
    out = copy.deepcopy(whole)
    node = out
    for key in path[:-1]:
        node = node[key]
    if drop:
        del node[path[-1]]
    else:
        node[path[-1]] = copy.deepcopy(value)
    return out
