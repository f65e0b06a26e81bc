# SPDX-License-Identifier: MIT
"""Numbers of options: what may stand in a field, by its annotation or by its default."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import pytest

from scapo import ranges
from scapo.ranges import ANY, CountOrNone, Range, Share, check_numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    LIKE: ClassVar = (("widths", "radii"),)
    widths: tuple[int, ...] = (4, 8)
    radii: tuple[float, ...] = (0.1, 0.2)
    layers: tuple[tuple[int, ...], ...] = ((1, 2), (3,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    epochs: int = 3
    extra_seeds: int = 0
    some: CountOrNone = 5
    limit: int | None = None
    rate: float = 0.1
    shift: float = -1.0
    share: Share | None = None
    rungs: Annotated[tuple[float, ...], Range(0, 1, many=(0, 2))] = (0.5,)
    up: Annotated[tuple[float, float] | None, ANY] = None
    flag: bool = False
    words: tuple[str, ...] = ("a",)
    inner: Inner = field(default_factory=Inner)
    flat: Annotated[Inner, Range(), type("Arg", (), {"name": ""})()] = field(default_factory=Inner)


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranges, "OWN", (__name__.partition(".")[0],))


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    "kept",
    [{}, {"extra_seeds": 0, "some": 0, "limit": 1, "rate": 0.0, "shift": -9.0, "share": 1.0},
     {"rungs": (), "up": (-1.0, 0.0), "flag": False, "words": ()}],
)  # fmt: skip
def test_numbers_that_can_be_meant_are_taken(kept: dict[str, object]) -> None:
    check_numbers(Options(**kept))  # type: ignore[arg-type]


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"epochs": 0}, "--epochs: expected 1 or more, found 0"),
        ({"epochs": 10**30}, f"--epochs: expected 1 to 1000000000, found {10**30}"),
        ({"extra_seeds": -1}, "--extra-seeds: expected 0 or more, found -1"),
        ({"some": -1}, "--some: expected 0 or more, found -1"),
        ({"limit": 0}, "--limit: expected 1 or more, found 0"),
        ({"rate": -0.5}, "--rate: expected 0 or more, found -0.5"),
        ({"rate": math.nan}, "--rate: expected a finite number, 0 or more, found nan"),
        ({"rate": math.inf}, "--rate: expected a finite number, 0 or more, found inf"),
        ({"shift": math.inf}, "--shift: expected a finite number, found inf"),
        ({"share": 1.5}, "--share: expected 0 to 1, found 1.5"),
        ({"share": math.nan}, "--share: expected 0 to 1, found nan"),
        ({"rungs": (0.1, 0.2, 0.3)}, "--rungs: expected 0 to 2 numbers, found 3"),
        ({"rungs": (0.1, 2.0)}, "--rungs: expected 0 to 1, found 2"),
        ({"up": (0.0, math.nan)}, "--up: expected a finite number, found nan"),
        ({"inner": Inner(widths=(), radii=())}, "--inner.widths: expected 1 or more numbers, "
                                                "found none"),
        ({"inner": Inner(layers=((1, 2), (0,)))}, "--inner.layers: expected 1 or more, found 0"),
        ({"inner": Inner(widths=(1,))}, "--inner.radii: expected 1, as --inner.widths has, "
                                        "found 2"),
        ({"flat": Inner(widths=(-1, 1))}, "--widths: expected 1 or more, found -1"),
    ],
)  # fmt: skip
def test_others_are_refused_by_the_name_of_their_flag(change: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - compared whole below
        check_numbers(Options(**change), "--")  # type: ignore[arg-type]
    assert str(refused.value) == said


def test_defaults_of_other_packages_tell_nothing() -> None:
    check_numbers(Options(epochs=-1, rate=-2.0, inner=Inner(widths=(), radii=())))
    with pytest.raises(ValueError, match="rate: expected a finite number, found nan"):
        check_numbers(Options(rate=math.nan))
    with pytest.raises(ValueError, match="share: expected 0 to 1, found 2"):
        check_numbers(Options(share=2.0))
