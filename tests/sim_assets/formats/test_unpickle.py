# SPDX-License-Identifier: MIT
"""Pickles of plain data are read exactly; whatever would run code is refused by name, unrun."""

from __future__ import annotations

import builtins
import collections
import os
import pickle  # noqa: TID251 - writes what the reader under test has to face
import pickletools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_assets.formats.pickled import MAX_CONTENTS, MAX_DEPTH
from sim_assets.formats.unpickle import UnpickleError, unpickle
from tests.helpers.foreign import Calls

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)

DATA: dict[str, Any] = {
    "labels": {k: k % 3 for k in range(300)},
    "nested": [{"a": (1, 2.5, None), "b": [True, False, "text \u94f0", b"\x00\xff", -1, 2**70]}],
    "empty": [[], (), {}, "", b"", set()],
    "sets": {1, 2, "three"},
    "frozen": frozenset({4, 5}),
    "ordered": collections.OrderedDict(x=1, y=2),
}
ARRAYS = {
    "floats": np.arange(12, dtype=np.float64).reshape(3, 4),
    "fortran": np.asfortranarray(np.arange(12, dtype=np.float32).reshape(3, 4)),
    "big endian": np.arange(5, dtype=">i4"),
    "bools": np.array([True, False, True]),
    "bytes": np.arange(7, dtype=np.uint8),
    "half": np.array([0.5, -2], np.float16),
    "complex": np.array([1 + 2j]),
    "text": np.array(["one", "three"]),
    "raw": np.array([b"ab", b"c"]),
    "none": np.zeros((0, 3)),
    "point": np.array(3.25),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", DATA)
def test_plain_containers(name: str, protocol: int):
    found = unpickle(pickle.dumps(DATA[name], protocol), name)
    assert found == DATA[name]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", ARRAYS)
def test_arrays(name: str, protocol: int):
    array = ARRAYS[name]
    found = unpickle(pickle.dumps([array, array], protocol), name)
    np.testing.assert_array_equal(found[0], array)
    assert found[0].dtype == array.dtype
    assert found[0].shape == array.shape
    assert found[0] is found[1]
    assert found[0].flags.writeable


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_scalars_and_arrays_of_objects(protocol: int):
    scalars = [np.float32(1.5), np.int64(-3), np.bool_(True), np.str_("x")]
    found = unpickle(pickle.dumps(scalars, protocol), "scalars")
    assert found == scalars
    assert [type(value) for value in found] == [type(value) for value in scalars]
    objects = np.full((2, 2), None, dtype=object)
    objects[:] = [[{"a": 1}, np.arange(3)], ["text", None]]
    found = unpickle(pickle.dumps(objects, protocol), "objects")
    assert found.shape == (2, 2)
    assert found.dtype == object
    assert found[0, 0] == {"a": 1}
    assert found[0, 1].tolist() == [0, 1, 2]
    assert found[1].tolist() == ["text", None]


def test_both_names_of_numpys_core():
    data = pickle.dumps(np.arange(3), 2)
    new, old = b"numpy._core.multiarray", b"numpy.core.multiarray"
    for wanted in (new, old):
        other = data.replace(new, b"@").replace(old, b"@").replace(b"@", wanted)
        assert unpickle(other, "a").tolist() == [0, 1, 2]


def test_python_2_arrays():
    """Python 2 wrote the bytes of an array as a string."""
    raw = np.array([1, -2, 3], "<i4").tobytes()
    data = (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\nq\x00cnumpy\nndarray\nq\x01K\x00\x85q\x02"
        b"U\x01bq\x03\x87q\x04Rq\x05(K\x01K\x03\x85q\x06cnumpy\ndtype\nq\x07U\x02i4q\x08K\x00K\x01"
        b"\x87q\tRq\n(K\x03U\x01<q\x0bNNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tq\x0cb\x89U\x0c"
        + raw
        + b"q\rtq\x0eb."
    )
    assert unpickle(data, "old").tolist() == [1, -2, 3]


class Later:
    """Pickles as a harmless call whose state then does the harm."""

    def __init__(self, state: object) -> None:
        self.state = state

    def __reduce__(self) -> Any:
        return (collections.OrderedDict, (), self.state)


def harmful(marker: Path) -> dict[str, tuple[object, str]]:
    """Values whose unpickling would write the file `marker`, and the name to be refused."""
    shell = f"touch '{marker}'"
    code = f"open({str(marker)!r}, 'w')"
    return {
        "system": (Calls(os.system, shell), "posix.system"),
        "eval": (Calls(builtins.eval, code), "builtins.eval"),
        "exec": (Calls(builtins.exec, code), "builtins.exec"),
        "open": (Calls(builtins.open, str(marker), "w"), "io.open"),
        "popen": (Calls(subprocess.Popen, ["touch", str(marker)]), "subprocess.Popen"),
        "getattr": (Calls(builtins.getattr, "text", "upper"), "builtins.getattr"),
        "load": (Calls(np.load, str(marker), None, True), "numpy.load"),
        "nested in a dict": ({"pc": [1, (2, Calls(os.system, shell))]}, "posix.system"),
        "as a key": ({Calls(os.system, shell): 1}, "posix.system"),
        "in an array": (np.array([Calls(os.system, shell)], dtype=object), "posix.system"),
        "in a state": (Later({"x": Calls(os.system, shell)}), "posix.system"),
    }


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", harmful(Path("x")))
def test_calls_are_refused_by_name_and_not_made(name: str, protocol: int, tmp_path: Path):
    marker = tmp_path / "marker"
    value, culprit = harmful(marker)[name]
    # Protocols below 3 use Python 2's names.
    old = {"subprocess.Popen": "commands.Popen", "io.open": "_io.open"}
    culprits = {culprit, culprit.replace("builtins", "__builtin__"), old.get(culprit)}
    with pytest.raises(UnpickleError) as caught:
        unpickle(pickle.dumps(value, protocol), "evil.npz")
    message = str(caught.value)
    assert message.startswith("evil.npz: expected arrays and plain containers only, found ")
    assert message.rpartition(" ")[2] in culprits
    assert not marker.exists()


def test_the_harm_is_real(tmp_path: Path):
    """The same values do act when Python's own unpickler reads them."""
    marker = tmp_path / "marker"
    value, _ = harmful(marker)["in an array"]
    pickle.loads(pickle.dumps(value))
    assert marker.exists()


@pytest.mark.parametrize(
    "name", ["os system", "posix system", "torch.serialization load", "numpy.core.numeric add"]
)
def test_names_are_not_even_imported(name: str):
    data = f"c{name.replace(' ', chr(10))}\n.".encode()
    with pytest.raises(UnpickleError, match=name.replace(" ", ".")):
        unpickle(data, "x")
    module = "antigravity"
    with pytest.raises(UnpickleError, match=r"antigravity\.fly"):
        unpickle(f"c{module}\nfly\n.".encode(), "x")
    assert module not in sys.modules


def opcode(name: str) -> bytes:
    return next(o.code.encode("latin-1") for o in pickletools.opcodes if o.name == name)


BROKEN = {
    "empty": (b"", "whole pickle"),
    "no pickle": (b"hello", "whole pickle"),
    "only a stop": (b".", "one value at its end, found 0"),
    "two values": (b"K\x01K\x02.", "one value at its end"),
    "no such memo": (b"h\x05.", "whole pickle"),
    "mark without end": (b"(K\x01.", "one value at its end"),
    "tuple without mark": (b"K\x01t.", "expected a mark"),
    "append to a number": (b"K\x01K\x02a.", "expected list, found int"),
    "odd dict": (b"(K\x01d.", "pairs"),
    "list as key": (b"}]K\x01s.", "text as keys, found list"),
    "call of data": (b"K\x01)R.", "expected Admitted, found int"),
    "state of data": (b"K\x01}b.", "expected Buildable, found int"),
    "instance": (b"(ios\nsystem\n.", "opcode INST"),
    "object": (b"(K\x01o.", "opcode OBJ"),
    "extension": (b"\x82\x01.", "opcode EXT1"),
    "buffers": (opcode("NEXT_BUFFER") + b".", "opcode NEXT_BUFFER"),
    "persistent": (b"K\x01Q.", "no persistent id"),
    "persistent text": (b"Pabc\n.", "opcode PERSID"),
    "name itself": (b"cnumpy\nndarray\n.", "found numpy.ndarray itself"),
    "call of a class": (b"cnumpy\nndarray\n(K\x01tR.", "only named"),
    "huge text": (b"X\xff\xff\xff\x7fabc.", "whole pickle"),
    "cycle": (b"]q\x00h\x00a.", "deeper"),
    "number too long": (b"L" + b"9" * 6000 + b"L\n.", "whole pickle"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_pickles(name: str):
    data, message = BROKEN[name]
    with pytest.raises(UnpickleError, match=message) as caught:
        unpickle(data, "file.npy")
    assert str(caught.value).startswith("file.npy: ")
    assert "\n" not in str(caught.value)


def test_deep_and_shared_data():
    deep: list[Any] = []
    for _ in range(MAX_DEPTH + 2):
        deep = [deep]
    with pytest.raises(UnpickleError, match=f"{MAX_DEPTH} levels"):
        unpickle(pickle.dumps(deep), "x")
    laughs: list[Any] = [1]
    for _ in range(10):
        laughs = [laughs, laughs]
    found = unpickle(pickle.dumps(laughs), "x")
    assert found[0] is found[1]


class Array:
    def __init__(self, shape: object, dtype: object, data: object) -> None:
        self.state = (1, shape, dtype, False, data)

    def __reduce__(self) -> Any:
        function, arguments = np.arange(3).__reduce__()[:2]
        return function, arguments, self.state


FORGED = {
    "too few bytes": (((4,), np.dtype("f8"), bytes(24)), "expected 32 bytes of an array, found 24"),
    "too many bytes": (((1,), np.dtype("u1"), bytes(2)), "expected 1 bytes"),
    "negative": (((-1,), np.dtype("u1"), b"a"), "shape of an array"),
    "huge": (((2**20, 2**20), np.dtype("u1"), b"a"), "elements"),
    "bytes for objects": (((1,), np.dtype("O"), bytes(8)), "objects of an array"),
    "wrong count of objects": (((3,), np.dtype("O"), [1]), "3 objects"),
    "no dtype": (((1,), "f8", bytes(8)), "expected a dtype, found str"),
    "structure": (((1,), np.dtype([("a", "O")]), bytes(8)), "plain dtype"),
    "void": (((1,), np.dtype("V8"), bytes(8)), "plain dtype"),
    "time": (((1,), np.dtype("M8[s]"), bytes(8)), "plain dtype"),
}


@pytest.mark.parametrize("name", FORGED)
def test_forged_arrays(name: str):
    """States with which numpy itself would read past a buffer, or take bytes for pointers."""
    state, message = FORGED[name]
    with pytest.raises(UnpickleError, match=message):
        unpickle(pickle.dumps(Array(*state), 2), "x")


def test_forged_dtype_flags():
    """An innocent dtype whose state names a field of objects over the raw bytes."""
    fields = {"a": (np.dtype("O"), 0)}
    state = (3, "|", None, ("a",), fields, 8, 1, 0)
    with pytest.raises(UnpickleError, match="state of a plain dtype"):
        unpickle(pickle.dumps(Forged(("u8", False, True), state), 2), "x")


class Forged:
    def __init__(self, arguments: tuple[object, ...], state: object) -> None:
        self.arguments, self.state = arguments, state

    def __reduce__(self) -> Any:
        return np.dtype, self.arguments, self.state


def refusal(data: bytes) -> str:
    try:
        unpickle(data, "x")
    except UnpickleError as error:
        return str(error)
    return "x: read"


@given(st.binary(max_size=60))
def test_any_bytes_are_read_or_refused(data: bytes):
    assert refusal(data).startswith("x: ")


SEEDS = [pickle.dumps([DATA["nested"], ARRAYS["floats"], np.float32(1)], p) for p in PROTOCOLS]


@given(st.sampled_from(SEEDS), st.data())
def test_damaged_pickles_are_read_or_refused(seed: bytes, data: st.DataObject):
    damaged = bytearray(seed)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(damaged)))
    for broken in (bytes(damaged), seed[:end]):
        assert refusal(broken).startswith("x: ")


def folded(kind: type[Any]) -> bytes:
    """A value that holds itself twice, and so on: 2^60 leaves in a few hundred bytes; no STOP."""
    value: Any = 1
    for _ in range(60):
        value = kind([value, value])
    return pickle.dumps(value, 2)[2:-1]


def called(name: bytes) -> bytes:
    return b"c" + name + folded(tuple) + b"\x85R."


FOLDED = {
    "as a key": b"}" + folded(tuple) + b"Ns.",
    "in a set": b"\x8f(" + folded(tuple) + b"\x90.",
    "in a frozen set": b"(" + folded(tuple) + b"\x91.",
    "in an ordered dict": b"ccollections\nOrderedDict\n](" + folded(tuple) + b"N\x86e\x85R.",
    "as a persistent id": folded(tuple) + b"Q.",
    "as a dtype": called(b"numpy\ndtype\n"),
    "as a class": called(b"numpy._core.multiarray\n_reconstruct\n"),
    "as text": called(b"_codecs\nencode\n"),
    "tuples": folded(tuple) + b".",
    "lists": folded(list) + b".",
}


@pytest.mark.parametrize("name", FOLDED)
@pytest.mark.timeout(30)
def test_values_that_hold_one_another_are_counted_unfolded(name: str):
    """Their hash, their text, or the array made of them would take for ever."""
    assert len(FOLDED[name]) < 1000
    with pytest.raises(UnpickleError, match="expected") as caught:
        unpickle(FOLDED[name], "folded")
    assert len(str(caught.value)) < 400


def test_a_value_in_many_places_may_be_large_once():
    rows = [list(range(1000))] * 1000
    assert len(unpickle(pickle.dumps(rows), "rows")) == 1000
    with pytest.raises(UnpickleError, match=f"at most {MAX_CONTENTS} values"):
        unpickle(pickle.dumps([rows] * 30), "rows")
