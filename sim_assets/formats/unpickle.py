# SPDX-License-Identifier: MIT
"""Pickles of other people's data sets, read without ever running what they say.

A pickle is a small program whose REDUCE and GLOBAL opcodes import and call any function. The one
that runs here is no Python unpickler but an interpreter of its own over `pickletools.genops`. It
knows the opcodes that build plain containers and a closed list of names (`ADMITTED`): those by
which numpy arrays, dtypes and scalars, and torch tensors of plain storages, are stored. Every other
name and opcode is refused by name before anything is called. Arrays are rebuilt here from their
bytes and never by numpy's own `__setstate__`, which trusts the flags that a file gives it.
"""

from __future__ import annotations

import pickletools
import struct
from collections.abc import Callable
from typing import Any

from scapo.text import one_line
from sim_assets.formats.pickled import (
    ADMITTED,
    MAX_CONTENTS,
    Admitted,
    Buildable,
    UnpickleError,
    check_key,
    resolve,
    shown,
)

__all__ = ["UnpickleError", "unpickle"]

Persistent = Callable[[tuple[Any, ...]], Any]

_NUMBERS = ("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT")
_TEXTS = ("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE")
_LONG = ("BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8")
_VALUES = frozenset((*_NUMBERS, *_TEXTS, *_LONG))
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, Callable[[], Any]] = {
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "EMPTY_TUPLE": tuple,
    "EMPTY_SET": set,
}
_GET = frozenset(("GET", "BINGET", "LONG_BINGET"))
_PUT = frozenset(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"))
_SILENT = frozenset(("PROTO", "FRAME"))


def unpickle(data: bytes, where: object, persistent: Persistent | None = None) -> Any:  # noqa: ANN401
    """The value that a pickle describes: plain containers, text, numbers, numpy arrays.

    Args:
        data: Of the pickle; what follows its end is left alone.
        where: The file, for messages.
        persistent: Turns the persistent ids of a torch file into storages; None refuses them.

    Raises:
        UnpickleError: Anything but plain data, or a damaged pickle; it names file and culprit.
    """
    machine = _Machine(persistent)
    try:
        return resolve(machine.run(data))
    except UnpickleError as error:
        raise UnpickleError(f"{where}: {one_line(error, 400)}") from error
    except (ValueError, TypeError, LookupError, struct.error, OverflowError) as error:
        raise UnpickleError(
            f"{where}: expected a whole pickle, found {one_line(error, 400)}"
        ) from error
    except (MemoryError, RecursionError) as error:
        raise UnpickleError(f"{where}: expected a pickle of sane size, found {error!r}") from error


class _Machine:
    """The stack, the marks and the memo of a pickle."""

    def __init__(self, persistent: Persistent | None) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.persistent = persistent

    def run(self, data: bytes) -> Any:  # noqa: ANN401
        """Every opcode up to STOP."""
        for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            if count > MAX_CONTENTS:
                raise UnpickleError(f"expected at most {MAX_CONTENTS} opcodes, found more")
            if opcode.name == "STOP":
                break
            self._step(opcode.name, argument)
        if len(self.stack) != 1 or self.marks:
            raise UnpickleError(f"expected one value at its end, found {len(self.stack)}")
        return self._pop()

    def _step(self, name: str, argument: Any) -> None:  # noqa: ANN401
        if name in _VALUES:
            value = bytes(argument) if isinstance(argument, bytearray) else argument
            self.stack.append(value)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            self.stack.append(_EMPTY[name]())
        elif name in _GET:
            self.stack.append(self.memo[int(argument)])
        elif name in _PUT:
            place = len(self.memo) if name == "MEMOIZE" else int(argument)
            self.memo[place] = self._top()
        elif name in _ACTIONS:
            _ACTIONS[name](self, argument)
        elif name not in _SILENT:
            raise UnpickleError(f"expected plain data, found the opcode {name}")

    def _top(self) -> Any:  # noqa: ANN401
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise UnpickleError("expected a value, found an empty stack")
        return self.stack[-1]

    def _pop(self) -> Any:  # noqa: ANN401
        self._top()
        return self.stack.pop()

    def _since_mark(self) -> list[Any]:
        if not self.marks:
            raise UnpickleError("expected a mark, found none")
        start = self.marks.pop()
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def _last(self, count: int) -> list[Any]:
        return [self._pop() for _ in range(count)][::-1]

    def mark(self, _: object) -> None:
        self.marks.append(len(self.stack))

    def pop(self, _: object) -> None:
        if self.marks and self.marks[-1] == len(self.stack):
            self.marks.pop()
        else:
            self._pop()

    def pop_mark(self, _: object) -> None:
        self._since_mark()

    def duplicate(self, _: object) -> None:
        self.stack.append(self._top())

    def new_list(self, _: object) -> None:
        self.stack.append(self._since_mark())

    def new_tuple(self, _: object) -> None:
        self.stack.append(tuple(self._since_mark()))

    def new_dict(self, _: object) -> None:
        self.stack.append(_pairs(self._since_mark()))

    def new_frozenset(self, _: object) -> None:
        self.stack.append(frozenset(map(check_key, self._since_mark())))

    def append(self, _: object) -> None:
        (value,) = self._last(1)
        _expect(self._top(), list).append(value)

    def appends(self, _: object) -> None:
        values = self._since_mark()
        _expect(self._top(), list).extend(values)

    def set_item(self, _: object) -> None:
        values = self._last(2)
        _expect(self._top(), dict).update(_pairs(values))

    def set_items(self, _: object) -> None:
        values = self._since_mark()
        _expect(self._top(), dict).update(_pairs(values))

    def add_items(self, _: object) -> None:
        values = self._since_mark()
        _expect(self._top(), set).update(map(check_key, values))

    def name(self, argument: Any) -> None:  # noqa: ANN401
        self._admit(*str(argument).split(" ", 1))

    def stacked_name(self, _: object) -> None:
        module, name = self._last(2)
        self._admit(_expect(module, str), _expect(name, str))

    def _admit(self, module: str, name: str) -> None:
        """Push a name of the closed list. Nothing is imported: the name stands for itself."""
        full = f"{module}.{name}"
        if full not in ADMITTED:
            raise UnpickleError(f"expected arrays and plain containers only, found {full}")
        self.stack.append(ADMITTED[full])

    def call(self, _: object) -> None:
        made, arguments = self._last(2)
        self.stack.append(_expect(made, Admitted).make(*_expect(arguments, tuple)))

    def build(self, _: object) -> None:
        (state,) = self._last(1)
        _expect(self._top(), Buildable).build(state)

    def persistent_id(self, _: object) -> None:
        (key,) = self._last(1)
        if self.persistent is None:
            raise UnpickleError(f"expected no persistent id, found {shown(key)}")
        self.stack.append(self.persistent(_expect(key, tuple)))


_ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine.mark,
    "POP": _Machine.pop,
    "POP_MARK": _Machine.pop_mark,
    "DUP": _Machine.duplicate,
    "LIST": _Machine.new_list,
    "TUPLE": _Machine.new_tuple,
    "DICT": _Machine.new_dict,
    "FROZENSET": _Machine.new_frozenset,
    "APPEND": _Machine.append,
    "APPENDS": _Machine.appends,
    "SETITEM": _Machine.set_item,
    "SETITEMS": _Machine.set_items,
    "ADDITEMS": _Machine.add_items,
    "TUPLE1": lambda machine, _: machine.stack.append(tuple(machine._last(1))),
    "TUPLE2": lambda machine, _: machine.stack.append(tuple(machine._last(2))),
    "TUPLE3": lambda machine, _: machine.stack.append(tuple(machine._last(3))),
    "GLOBAL": _Machine.name,
    "STACK_GLOBAL": _Machine.stacked_name,
    "REDUCE": _Machine.call,
    "NEWOBJ": _Machine.call,
    "BUILD": _Machine.build,
    "BINPERSID": _Machine.persistent_id,
}


def _expect(value: Any, kind: type[Any]) -> Any:  # noqa: ANN401
    if not isinstance(value, kind):
        raise UnpickleError(f"expected {kind.__name__}, found {type(value).__name__}")
    return value


def _pairs(values: list[Any]) -> dict[Any, Any]:
    if len(values) % 2:
        raise UnpickleError("expected pairs of key and value, found an odd number")
    return dict(zip(map(check_key, values[::2]), values[1::2], strict=True))
