# SPDX-License-Identifier: MIT
"""Frozen records from JSON, each field checked against its annotation."""

from __future__ import annotations

import json
import math
import types
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from scapo.store.regular import read_regular

T = TypeVar("T")
MAX_JSON = 1 << 26
"""Bytes of a JSON file; what it unfolds to takes up to twenty times as much."""


class StoreError(ValueError):
    """A file is not what it should be: `path: what was expected, what was found`."""


def read_json(path: Path, error: type[StoreError] = StoreError) -> Any:  # noqa: ANN401
    """What a JSON file holds.

    Raises:
        StoreError: It cannot be read, or is not JSON.
    """
    try:
        return parse_json(read_regular(path, MAX_JSON))
    except (OSError, ValueError, RecursionError) as problem:
        raise error(f"{path}: expected JSON, found {problem}") from problem


def readable_json(value: object) -> str:
    """Sorted JSON with a line for each value."""
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n"


def parse_json(text: str | bytes) -> Any:  # noqa: ANN401
    """The value of a text, whose numbers are those that JSON has.

    Raises:
        ValueError: It is not JSON, or not UTF-8.
        RecursionError: It is nested too deeply.
    """
    if isinstance(text, bytes):
        text = text.decode()
    return json.loads(text, parse_constant=_no_number, parse_float=_finite, object_pairs_hook=_once)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        raise ValueError(f"the key {counts.most_common(1)[0][0][:100]!r} twice")
    return found


def _no_number(text: str) -> None:
    raise ValueError(f"{text}, which JSON lacks")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text:.20}, a number too large")
    return value


def from_json(
    kind: type[T],
    data: object,
    where: str,
    *,
    error: type[StoreError] = StoreError,
    others: Literal["refuse", "leave"] = "leave",
    link: str = ": ",
) -> T:
    """A dataclass from its JSON form; fields that are missing take their default.

    Args:
        kind: A dataclass, of dataclasses, tuples, mappings and plain values perhaps.
        data: As `json.loads` gives it.
        where: File, and the place in it, for the message.
        error: What is raised.
        others: Whether fields that the dataclass lacks are refused; those that it once had, which
            its `RETIRED` names, are not.
        link: Between the names of a record and of its field, in messages.

    Raises:
        StoreError: Naming file and field, what was expected and what was found.
    """
    return cast("T", _Reader(error, others, link).record(kind, data, where))


@cache
def _fields(kind: type[Any]) -> dict[str, tuple[Field[Any], Any]]:
    """Fields of a dataclass with their types."""
    hints = get_type_hints(kind)
    return {item.name: (item, hints[item.name]) for item in fields(kind) if item.init}


class _Reader:
    """How one file is read."""

    def __init__(self, error: type[StoreError], others: str, link: str) -> None:
        self.error, self.others, self.link = error, others, link

    def record(self, kind: type[Any], data: object, where: str) -> Any:  # noqa: ANN401
        if not isinstance(data, dict):
            raise self.error(f"{where}: expected an object, found {type(data).__name__}")
        found, known = cast("dict[str, object]", data), _fields(kind)
        unknown = sorted(set(found) - set(known) - set(getattr(kind, "RETIRED", ())))
        if unknown and self.others == "refuse":
            raise self.error(f"{where}: expected fields of {kind.__name__}, found {unknown[0]!r}")
        for name, (item, _) in known.items():
            if name not in found and item.default is item.default_factory is MISSING:
                raise self.error(f"{where}: expected field {name!r}, found none")
        values = {
            name: self.value(hint, found[name], f"{where}{self.link}{name}")
            for name, (_, hint) in known.items()
            if name in found
        }
        try:
            return kind(**values)
        except (ArithmeticError, LookupError, TypeError, ValueError) as problem:
            raise self.error(f"{where}: expected fields that fit, found {problem}") from problem

    def value(self, hint: Any, value: object, where: str) -> Any:  # noqa: ANN401
        """A JSON value as the annotation has it; lists become tuples."""
        kind = get_origin(hint)
        if is_dataclass(hint):
            return self.record(cast("type[Any]", hint), value, where)
        if kind in (Union, types.UnionType):
            return self._either(get_args(hint), value, where)
        if kind in (tuple, frozenset):
            return kind(self._items(hint, value, where))
        if kind in (dict, Mapping):
            if not isinstance(value, dict):
                raise self._wrong(where, "an object", value)
            pairs, inner = cast("dict[str, object]", value).items(), get_args(hint)[1]
            return {key: self.value(inner, item, f"{where}[{key!r}]") for key, item in pairs}
        if kind is Literal:
            known = get_args(hint)
            if not any(value == one and type(value) is type(one) for one in known):
                raise self._wrong(where, f"one of {', '.join(map(str, known))}", value)
            return value
        return self._scalar(hint, value, where)

    def _items(self, hint: Any, value: object, where: str) -> list[Any]:  # noqa: ANN401
        inner = get_args(hint)
        if not isinstance(value, list):
            raise self._wrong(where, "a list", value)
        items = cast("list[object]", value)
        if get_origin(hint) is frozenset or inner[-1] is Ellipsis:
            inner = (inner[0],) * len(items)
        if len(inner) != len(items):
            raise self._wrong(where, f"a list of {len(inner)}", value)
        pairs = enumerate(zip(inner, items, strict=True))
        return [self.value(one, item, f"{where}[{i}]") for i, (one, item) in pairs]

    def _either(self, hints: tuple[Any, ...], value: object, where: str) -> Any:  # noqa: ANN401
        """As the first of several types that fits; what the first one misses where none does."""
        for hint in hints:
            with suppress(StoreError):
                return self.value(hint, value, where)
        return self.value(hints[0], value, where)

    def _scalar(self, hint: Any, value: object, where: str) -> Any:  # noqa: ANN401
        names = {str: "text", int: "an integer", float: "a number", bool: "true or false"}
        whole = isinstance(value, int) and not isinstance(value, bool)
        if hint is float and whole:
            try:
                value = float(cast("int", value))
            except OverflowError:
                raise self._wrong(where, "a number", "one of too many digits") from None
        if hint is float and isinstance(value, float) and not math.isfinite(value):
            raise self._wrong(where, "a finite number", value)
        if hint in names and type(value) is not hint:
            raise self._wrong(where, names[hint], value)
        if hint is type(None) and value is not None:
            raise self._wrong(where, "null", value)
        return value

    def _wrong(self, where: str, expected: str, found: object) -> StoreError:
        text = repr(found)
        shown = text if len(text) <= 200 else f"{text[:200]}..."
        return self.error(f"{where}: expected {expected}, found {shown}")
