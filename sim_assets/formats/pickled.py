# SPDX-License-Identifier: MIT
"""What a pickle may hold besides plain containers: numpy arrays, dtypes, scalars, torch tensors.

`ADMITTED` is the closed list of names that `unpickle` knows. Each stands for a maker of
our own that checks shapes, sizes and types; no function of numpy or torch that a file names is
ever called.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

MAX_ELEMENTS = 1 << 28
"""Of one array: 100 times a 640 x 480 cloud with colours."""
MAX_REPEATED = 1 << 16
"""Elements of a tensor that shows those of a smaller storage again and again."""
MAX_DEPTH = 64
"""Of containers within containers."""
MAX_CONTENTS = 20_000_000
"""Opcodes, and values when those that appear in many places are counted in each: a label for each
triangle of a large mesh takes a few."""
_DTYPE = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,6}|O8?|\?|bool)")


class UnpickleError(ValueError):
    """A pickle holds more than data, or is damaged: `file: expected, found`."""


def shown(value: object) -> str:
    """A value for a message; its `repr` may be longer than the memory, however short its pickle."""
    return reprlib.repr(value)[:80]


@dataclass(frozen=True, slots=True, kw_only=True)
class Admitted:
    """A name that a pickle may use."""

    name: str
    make: Callable[..., Any]
    """What calling it gives."""


class Buildable:
    """A value that its BUILD opcode completes."""

    def build(self, state: object) -> None:
        """Take the state."""
        raise NotImplementedError


class Dtype(Buildable):
    """`numpy.dtype(text, False, True)` and its byte order."""

    def __init__(self, text: object, *_: object) -> None:
        """Only numbers, text, bytes and objects; no structures, times or voids."""
        if not isinstance(text, str) or not _DTYPE.fullmatch(text):
            raise UnpickleError(f"expected a plain dtype, found {shown(text)}")
        self.dtype = np.dtype(text)

    def build(self, state: object) -> None:
        """(version, byte order, subarray, names, fields, ...): all but the order must be empty."""
        if not isinstance(state, tuple) or len(state) < 5 or any(state[2:5]):
            raise UnpickleError(f"expected the state of a plain dtype, found {shown(state)}")
        order = state[1]
        if order not in ("<", ">", "=", "|"):
            raise UnpickleError(f"expected a byte order, found {shown(order)}")
        if order in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(order)


class Array(Buildable):
    """`numpy.ndarray`: complete once its state has come."""

    def __init__(self) -> None:
        """Without contents yet."""
        self.shape: tuple[int, ...] = ()
        self.contents: list[Any] | None = None
        self.array: np.ndarray | None = None

    def build(self, state: object) -> None:
        """(version, shape, dtype, Fortran order, bytes or list)."""
        if not isinstance(state, tuple) or len(state) != 5:
            raise UnpickleError(f"expected the state of an array, found {shown(state)}")
        _, shape, dtype, fortran, data = state
        if not isinstance(dtype, Dtype):
            raise UnpickleError(f"expected a dtype, found {type(dtype).__name__}")
        if dtype.dtype.kind != "O":
            self.array = _filled(data, dtype, shape, "F" if fortran else "C")
            return
        self.shape = _shape(shape)
        if not isinstance(data, list) or len(data) != math.prod(self.shape):
            raise UnpickleError(f"expected {math.prod(self.shape)} objects of an array")
        self.contents = data


class Storage:
    """The bytes of a torch storage, and the dtype that its name says."""

    def __init__(self, data: bytes, name: str) -> None:
        """`data` from the archive, `name` such as `torch.FloatStorage`."""
        self.data, self.name = data, name


STORAGES: dict[str, str] = {
    "torch.DoubleStorage": "<f8",
    "torch.FloatStorage": "<f4",
    "torch.HalfStorage": "<f2",
    "torch.BFloat16Storage": "<u2",
    "torch.LongStorage": "<i8",
    "torch.IntStorage": "<i4",
    "torch.ShortStorage": "<i2",
    "torch.CharStorage": "|i1",
    "torch.ByteStorage": "|u1",
    "torch.BoolStorage": "|b1",
}
"""Plain storages and the numpy dtype of their bytes (bfloat16 is widened)."""


def _counts(values: object) -> tuple[int, ...]:
    """A tuple of numbers from 0 on; a single one stands for itself."""
    given = values if isinstance(values, tuple) else (values,)
    counts = tuple(count for count in given if isinstance(count, int) and count >= 0)
    if len(counts) != len(given) or len(counts) > 32:
        raise UnpickleError(f"expected the shape of an array, found {shown(values)}")
    return counts


def _shape(shape: object) -> tuple[int, ...]:
    sizes = _counts(shape)
    if math.prod(sizes) > MAX_ELEMENTS:
        raise UnpickleError(f"expected at most {MAX_ELEMENTS} elements, found {shown(sizes)}")
    return sizes


def _filled(data: object, dtype: Dtype, shape: object, order: Any) -> np.ndarray:  # noqa: ANN401
    """The array of these bytes, in an order "C" or "F"; Python 2 wrote them as text."""
    raw = data.encode("latin-1") if isinstance(data, str) else data
    sizes = _shape(shape)
    wanted = math.prod(sizes) * dtype.dtype.itemsize
    if not isinstance(raw, bytes | bytearray) or len(raw) != wanted:
        found = len(raw) if isinstance(raw, bytes | bytearray) else type(raw).__name__
        raise UnpickleError(f"expected {wanted} bytes of an array, found {found}")
    if wanted == 0:
        return np.zeros(sizes, dtype.dtype)
    return np.frombuffer(raw, dtype.dtype).reshape(sizes, order=order).copy()


def _reconstruct(kind: object, *_: object) -> Array:
    if not isinstance(kind, Admitted) or kind.name != "numpy.ndarray":
        raise UnpickleError(f"expected an array of class numpy.ndarray, found {shown(kind)}")
    return Array()


def _from_buffer(data: object, dtype: object, shape: object, order: object) -> np.ndarray:
    """Protocol 5 of numpy, the bytes within the pickle."""
    if not isinstance(dtype, Dtype) or dtype.dtype.kind == "O" or order not in ("C", "F"):
        raise UnpickleError(f"expected a plain dtype and order C or F, found {shown(order)}")
    return _filled(data, dtype, shape, order)


def _scalar(dtype: object, data: object = b"") -> Any:  # noqa: ANN401
    if not isinstance(dtype, Dtype) or dtype.dtype.kind == "O":
        raise UnpickleError("expected the dtype of a plain scalar")
    return _filled(data, dtype, (), "C")[()]


def _encode(text: object, encoding: object = "latin1") -> bytes:
    """How protocol 2 of Python 3 stores bytes."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise UnpickleError(f"expected bytes as latin-1 text, found {shown(encoding)}")
    return text.encode("latin-1")


def _bytes(*data: object) -> bytes:
    """How protocol 2 stores empty bytes."""
    if data not in ((), (b"",)):
        raise UnpickleError("expected no arguments of bytes")
    return b""


def _tensor(storage: object, offset: object, size: object, stride: object, *_: object) -> Any:  # noqa: ANN401
    """The tensor as an array: a view of the storage, copied."""
    if not isinstance(storage, Storage) or not isinstance(offset, int):
        raise UnpickleError("expected a tensor of a plain storage")
    sizes, steps = _shape(size), _counts(stride)
    dtype = np.dtype(STORAGES[storage.name])
    base = np.frombuffer(storage.data, dtype, len(storage.data) // dtype.itemsize)
    last = offset + sum((n - 1) * step for n, step in zip(sizes, steps, strict=True))
    if math.prod(sizes) > max(len(base), MAX_REPEATED):
        expected = f"at most the {len(base)} elements of its storage"
        raise UnpickleError(f"expected {expected} in a tensor, found shape {sizes}")
    if math.prod(sizes) == 0:
        array = np.zeros(sizes, dtype)
    elif offset < 0 or last >= len(base):
        raise UnpickleError(f"expected a storage of {last + 1} elements, found {len(base)}")
    else:
        strides = tuple(step * dtype.itemsize for step in steps)
        array = np.lib.stride_tricks.as_strided(base[offset:], sizes, strides).copy()
    if storage.name == "torch.BFloat16Storage":
        return (array.astype(np.uint32) << 16).view(np.float32)
    return array


def _never(*_: object) -> None:
    raise UnpickleError("expected a name that is only named, found a call")


def _contents(kind: type[Any]) -> Callable[..., Any]:
    def make(*values: object) -> Any:  # noqa: ANN401
        if len(values) > 1 or not all(isinstance(v, list | tuple | set) for v in values):
            raise UnpickleError(f"expected the items of a {kind.__name__}")
        items = cast("list[Any]", list(*values))
        return kind(map(_checked_pair if kind is dict else check_key, items))

    return make


def _checked_pair(item: Any) -> Any:  # noqa: ANN401
    if not isinstance(item, list | tuple) or len(item) != 2:
        raise UnpickleError(f"expected pairs of key and value, found {shown(item)}")
    return check_key(item[0]), item[1]


_MAKERS: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": _never,
    "numpy.dtype": Dtype,
    "_codecs.encode": _encode,
    "collections.OrderedDict": _contents(dict),
    "torch._utils._rebuild_tensor_v2": _tensor,
}
for _core in ("numpy.core", "numpy._core"):
    _MAKERS[f"{_core}.multiarray._reconstruct"] = _reconstruct
    _MAKERS[f"{_core}.multiarray.scalar"] = _scalar
    _MAKERS[f"{_core}.numeric._frombuffer"] = _from_buffer
for _builtins in ("builtins", "__builtin__"):
    _MAKERS[f"{_builtins}.bytes"] = _bytes
    _MAKERS[f"{_builtins}.set"] = _contents(set)
    _MAKERS[f"{_builtins}.frozenset"] = _contents(frozenset)
_MAKERS |= dict.fromkeys(STORAGES, _never)

ADMITTED: dict[str, Admitted] = {
    name: Admitted(name=name, make=make) for name, make in _MAKERS.items()
}


def resolve(value: Any) -> Any:  # noqa: ANN401
    """The value with its arrays finished; the same object stays the same wherever it appears.

    Raises:
        UnpickleError: A name or an unfinished value among the data, cycles, too deep nesting.
    """
    return _Resolver().resolve(value, 0)


class _Resolver:
    """Finishes each object once."""

    def __init__(self) -> None:
        self.done: dict[int, tuple[Any, int]] = {}
        """By identity: the finished value, and how many values it is with all that it holds."""
        self.open: set[int] = set()
        self.count = 0

    def resolve(self, value: Any, depth: int) -> Any:  # noqa: ANN401
        self.count += 1
        if self.count > MAX_CONTENTS:  # a few lists that hold one another many times
            raise UnpickleError(f"expected at most {MAX_CONTENTS} values, found more")
        if not isinstance(value, list | tuple | dict | set | frozenset | Array):
            return _plain(value)
        if id(value) in self.done:
            result, size = self.done[id(value)]
            self.count += size - 1
            return result
        if id(value) in self.open or depth > MAX_DEPTH:
            raise UnpickleError(f"expected data at most {MAX_DEPTH} levels deep, found deeper data")
        self.open.add(id(value))
        before = self.count - 1
        result = self._finished(value, depth + 1)
        self.open.discard(id(value))
        self.done[id(value)] = result, self.count - before
        return result

    def _finished(self, value: Any, depth: int) -> Any:  # noqa: ANN401
        if isinstance(value, Array):
            return self._array(value, depth)
        if isinstance(value, dict):
            return {check_key(k): self.resolve(item, depth) for k, item in value.items()}
        if isinstance(value, set | frozenset):
            return type(value)(check_key(item) for item in value)
        return type(value)(self.resolve(item, depth) for item in value)

    def _array(self, value: Array, depth: int) -> np.ndarray:
        if value.array is not None:
            return value.array
        if value.contents is None:
            raise UnpickleError("expected an array with contents, found one without")
        flat = np.full(len(value.contents), None, dtype=object)
        for i, item in enumerate(value.contents):
            flat[i] = self.resolve(item, depth)
        return flat.reshape(value.shape)


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, str | bytes | int | float | complex | np.generic | np.ndarray | None):
        return value
    named = value.name if isinstance(value, Admitted) else type(value).__name__
    raise UnpickleError(f"expected data, found {named} itself")


def check_key(value: Any) -> Any:  # noqa: ANN401
    """A key or an item of a set: numbers and text only.

    To be asked before it is hashed: tuples of tuples may take for ever.

    Raises:
        UnpickleError: It is something else.
    """
    if isinstance(value, str | bytes | int | float | np.generic | None):
        return value
    raise UnpickleError(f"expected numbers or text as keys, found {type(value).__name__}")
