# SPDX-License-Identifier: MIT
"""Records come back from JSON; a value of another type is refused, naming file and field."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from scapo.store.json_records import MAX_JSON, StoreError, from_json, read_json


@dataclass(frozen=True)
class Inner:
    word: Literal["a", "b"] = "a"
    flag: bool = False


@dataclass(frozen=True)
class Other:
    number: int


@dataclass(frozen=True)
class Outer:
    count: int
    rate: float = 0.5
    pair: tuple[float, float] = (1.0, 2.0)
    sizes: tuple[int, ...] = ()
    names: frozenset[str] = frozenset()
    inner: Inner = field(default_factory=Inner)
    either: Inner | Other = field(default_factory=Inner)
    limit: int | None = None
    free: dict[str, Any] = field(default_factory=dict)
    notes: Mapping[str, float] = field(default_factory=dict)


FULL = Outer(
    count=3,
    rate=2.0,
    pair=(0.0, 1.5),
    sizes=(4, 5),
    names=frozenset({"x"}),
    inner=Inner(word="b", flag=True),
    either=Other(number=7),
    limit=9,
    free={"a": [1, None]},
    notes={"t": 1.0},
)


def test_what_was_written_comes_back() -> None:
    data = json.loads(json.dumps({**asdict(FULL), "names": ["x"]}))
    assert from_json(Outer, data, "f", others="refuse") == FULL
    assert from_json(Outer, {"count": 1, "unknown": 2}, "f") == Outer(count=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": True}, "f: count: expected an integer, found True"),
        ({"count": 3.0}, "f: count: expected an integer, found 3.0"),
        ({"rate": "2"}, "f: rate: expected a number, found '2'"),
        ({"rate": 10**400}, "f: rate: expected a number, found 'one of too many digits'"),
        ({"rate": float("inf")}, "f: rate: expected a finite number, found inf"),
        ({"pair": [1]}, r"f: pair: expected a list of 2, found \[1\]"),
        ({"pair": [1, "2"]}, r"f: pair\[1\]: expected a number, found '2'"),
        ({"sizes": 4}, "f: sizes: expected a list, found 4"),
        ({"names": [1]}, r"f: names\[0\]: expected text, found 1"),
        ({"inner": []}, "f: inner: expected an object, found list"),
        ({"inner": {"word": "c"}}, "f: inner: word: expected one of a, b, found 'c'"),
        ({"inner": {"word": ["a"]}}, r"f: inner: word: expected one of a, b, found \['a'\]"),
        ({"inner": {"flag": 1}}, "f: inner: flag: expected true or false, found 1"),
        ({"limit": "x"}, "f: limit: expected an integer, found 'x'"),
        ({"notes": {"t": None}}, r"f: notes\['t'\]: expected a number, found None"),
        ({"notes": 3}, "f: notes: expected an object, found 3"),
        ({"count": "x" * 10_000}, r"found '[x]{199}\.\.\.$"),
        ({"none": 1}, "f: expected fields of Outer, found 'none'"),
    ],
)
def test_another_type_is_refused_by_name(change: dict[str, Any], message: str) -> None:
    with pytest.raises(StoreError, match=message):
        from_json(Outer, {"count": 1, **change}, "f", others="refuse")


@dataclass(frozen=True)
class Divided:
    whole: int
    by: int = 1

    def __post_init__(self) -> None:
        if self.whole % self.by:
            raise ValueError(f"{self.by} does not divide {self.whole}")


@pytest.mark.parametrize(("by", "found"), [(0, "integer .*by zero"), (2, "2 does not divide 3")])
def test_what_a_record_says_of_itself_is_told_with_its_place(by: int, found: str) -> None:
    with pytest.raises(StoreError, match=f"f: expected fields that fit, found {found}"):
        from_json(Divided, {"whole": 3, "by": by}, "f")


def test_a_field_without_default_must_be_there() -> None:
    with pytest.raises(StoreError, match="f: expected field 'count', found none"):
        from_json(Outer, {}, "f")


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[" * 100_000, b'{"a": Infinity}'])
def test_what_is_no_json_is_one_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(data)
    with pytest.raises(StoreError, match=r"a.json: expected JSON, found"):
        read_json(path)


def test_a_key_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    """Readers differ in which of the two counts."""
    (tmp_path / "a").write_text('{"x": [{"count": 3, "b": 1, "count": 4}]}')
    with pytest.raises(StoreError, match="a: expected JSON, found the key 'count' twice"):
        read_json(tmp_path / "a")


def test_a_file_of_many_megabytes_is_refused_unread(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    os.truncate(tmp_path / "a", MAX_JSON + 1)
    with pytest.raises(StoreError, match="67108865 bytes, more than 67108864"):
        read_json(tmp_path / "a")
