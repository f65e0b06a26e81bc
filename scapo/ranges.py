# SPDX-License-Identifier: MIT
"""Which numbers may stand in a dataclass of options: one check of all of them, before any work.

Where a field's annotation has no `Range`, its default tells: what counts from 1 (an `int` whose
default is not 0) does so for everybody, and nothing goes below 0 whose default does not. Numbers
are finite and no tuple of them is empty. Of another package's options only what annotations say is
held to, and that numbers are finite: their defaults tell nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, cast, get_args, get_type_hints

OWN = ("scapo", "bench", "sim_assets")
"""Packages whose defaults tell what may stand in a field."""
MOST = 10**9
"""Of whole numbers, unless a field says otherwise: more is a slip of the keyboard."""


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers that a field may hold, as metadata of its annotation."""

    least: float = 0
    most: float = math.inf
    """Finite numbers alone, whatever this is."""
    above: bool = False
    """Whether `least` itself is too little."""
    many: tuple[int, float] = (1, math.inf)
    """How many of them there may be in a tuple, least and most."""

    def words(self, found: float) -> str:
        """What was expected in place of a number."""
        least = _plain(self.least)
        if self.most < MOST or self.most < found:
            return f"{least} to {_plain(self.most)}"
        if self.least == -math.inf:
            return "a finite number"
        if self.above:
            return f"a finite number above {least}"
        return f"{least} or more" if found < self.least else f"a finite number, {least} or more"

    def holds(self, value: float) -> bool:
        """Whether a number lies in it."""
        inside = self.least < value if self.above else self.least <= value
        return inside and value <= self.most and math.isfinite(value)


Share = Annotated[float, Range(0, 1)]
"""Of a whole, from none to all of it."""
Positive = Annotated[float, Range(0, above=True)]
"""A length, a temperature, what else something is divided by."""
CountOrNone = Annotated[int, Range(0, MOST)]
"""A count that may be 0."""
Neighbours = Annotated[int, Range(1, 1024)]
"""Points about a point: all of a usual cloud at most."""
Seed = Annotated[int, Range(0, 2**63 - 1)]
"""Of random numbers."""
Port = Annotated[int, Range(0, 65535)]
"""Of a server; 0: any that is free."""
ANY = Range(-math.inf, many=(0, math.inf))
"""Any finite number."""


def check_numbers(options: object, under: str = "") -> None:
    """Refuse numbers that cannot be, in a dataclass of options and in those that it holds.

    Fields that `LIKE` of a class names in one tuple have as many items, one for each.

    Args:
        options: A dataclass.
        under: What stands before the names of its fields in a message.

    Raises:
        ValueError: `flag: expected, found`.

    >>> from scapo.registered.config import RegisteredConfig
    >>> check_numbers(RegisteredConfig(epochs=0))
    Traceback (most recent call last):
    ValueError: epochs: expected 1 or more, found 0
    """
    own = type(options).__module__.partition(".")[0] in OWN
    for item, hint, kinds in _fields(type(options)):
        value = getattr(options, item.name)
        name = under + item.name.replace("_", "-")
        if is_dataclass(value):
            check_numbers(value, under if _nameless(hint) else f"{name}.")
        elif value is not None and (int in kinds or float in kinds):
            _check(name, value, _range(hint) or (_usual(item, kinds) if own else ANY))
    for names in getattr(options, "LIKE", ()):
        _check_alike(options, names, under)


def _check(name: str, value: object, allowed: Range) -> None:
    numbers = list(_numbers(value))
    for number in numbers:
        if not allowed.holds(number):
            words = allowed.words(number)
            raise ValueError(f"{name}: expected {words}, found {_plain(number)}")
    least, most = allowed.many
    if not least <= len(numbers) <= most:
        words = f"{least} to {most}" if most < math.inf else f"{least} or more"
        raise ValueError(f"{name}: expected {words} numbers, found {len(numbers) or 'none'}")


def _plain(number: float) -> str:
    return f"{number:.12g}" if isinstance(number, float) else f"{number}"


def _check_alike(options: object, names: tuple[str, ...], under: str) -> None:
    first, *others = names
    many = len(getattr(options, first))
    for name in others:
        if (found := len(getattr(options, name))) != many:
            flag, like = (f"{under}{word}".replace("_", "-") for word in (name, first))
            raise ValueError(f"{flag}: expected {many}, as {like} has, found {found}")


@cache
def _fields(kind: type[Any]) -> list[tuple[Field[Any], Any, list[Any]]]:
    """Fields of a dataclass with their annotations, and what these are made of in the end."""
    plain, hints = get_type_hints(kind), get_type_hints(kind, include_extras=True)
    return [(item, hints[item.name], list(_leaves(plain[item.name]))) for item in fields(kind)]


def _leaves(hint: Any) -> Iterator[Any]:  # noqa: ANN401 - an annotation
    inner = get_args(hint)
    for one in inner:
        yield from _leaves(one)
    if not inner:
        yield hint


def _metadata(hint: Any) -> Iterator[Any]:  # noqa: ANN401
    """What stands in an annotation beside types, of its outermost `Annotated` first."""
    yield from getattr(hint, "__metadata__", ())
    for inner in get_args(hint):
        yield from _metadata(inner)


def _nameless(hint: Any) -> bool:  # noqa: ANN401
    """Whether the flags of the dataclass in a field are not told apart by the field's name."""
    return any(getattr(one, "name", None) == "" for one in getattr(hint, "__metadata__", ()))


def _range(hint: Any) -> Range | None:  # noqa: ANN401
    return next((one for one in _metadata(hint) if isinstance(one, Range)), None)


def _usual(item: Field[Any], kinds: list[Any]) -> Range:
    """What the default of a field without a range tells."""
    made = item.default if item.default_factory is MISSING else item.default_factory()
    numbers = list(_numbers(made))
    if any(number < 0 for number in numbers):
        return ANY
    return Range(0 if 0 in numbers else 1, MOST) if int in kinds else Range(0)


def _numbers(value: object) -> Iterator[float]:
    """The numbers in a value, which may be tuples of tuples of them; truth values are none."""
    if isinstance(value, tuple):
        for inner in cast("tuple[object, ...]", value):
            yield from _numbers(inner)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value
