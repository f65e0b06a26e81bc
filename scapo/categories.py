# SPDX-License-Identifier: MIT
"""What a category is, and the nine as data: parts, joints, travel, viewing window, symmetry, size.

A category is one entry here. Imports nothing heavy: help texts list the names.

Object frame: z up, the front (door, drawer, user side) faces -x, origin = centre of the bounding
box at rest. Travel is what real objects of the category do: laptops open to 120 to 150 degrees,
oven doors to 90, glasses fold to about 80, drawers pull out most of their depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import Literal

JointKind = Literal["revolute", "prismatic"]
RestRule = Literal["smallest-box", "largest-box", "tallest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class JointSpec:
    """One joint of a category: its kind, the parts it links and its travel from rest."""

    kind: JointKind
    parent: int
    """Part index of the parent, 0 for all benchmark categories."""
    child: int
    lower: float
    """Smallest state, rad or m; 0 is rest."""
    upper: float
    """Largest state of the category, rad or m. An instance may stop earlier."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """Where a person would look from: camera angles about the object, degrees.

    `azimuth` turns about the object's z axis, 0 looks at the front (camera on the -x side),
    positive counter-clockwise seen from above; `elevation` is above the horizon.
    """

    azimuth: tuple[float, float]
    elevation: tuple[float, float]


Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Category:
    """What is fixed for every instance of a category. `CATEGORIES` lists them."""

    name: str
    parts: tuple[str, ...]
    joints: tuple[JointSpec, ...]
    benchmark: tuple[Literal["clean", "sensor"], ...]
    symmetry: Matrix3 | None
    """Rotation A of the object frame that exchanges the parts (docs/data-format.md), or None."""
    window: Window
    diagonal: float
    """Nominal diagonal of the box at rest in metres, for models without metric size."""
    rest: RestRule
    """Which joint limit is rest, for models that do not say: the one with this bounding box."""
    words: tuple[str, ...]
    """Link or semantic names that tell the moving parts of this category."""


TURN_X: Matrix3 = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
"""Half a turn about x: exchanges the halves of laptops, suitcases, scissors, the two temples."""
TURN_Z: Matrix3 = ((-1, 0, 0), (0, -1, 0), (0, 0, 1))
"""Half a turn about z: exchanges the two handles of a basket."""


def _hinge(child: int, degrees: float) -> JointSpec:
    return JointSpec(kind="revolute", parent=0, child=child, lower=0.0, upper=radians(degrees))


def _slide(child: int, metres: float) -> JointSpec:
    return JointSpec(kind="prismatic", parent=0, child=child, lower=0.0, upper=metres)


_TABLE_TOP = Window(azimuth=(-75.0, 75.0), elevation=(15.0, 70.0))
_CABINET = Window(azimuth=(-60.0, 60.0), elevation=(0.0, 55.0))

_ALL = (
    Category(
        name="laptop",
        parts=("base", "screen"),
        joints=(_hinge(1, 135.0),),
        benchmark=("clean", "sensor"),
        symmetry=TURN_X,
        window=_TABLE_TOP,
        diagonal=0.42,
        rest="smallest-box",
        words=("screen", "lid", "display"),
    ),
    Category(
        name="safe",
        parts=("body", "door"),
        joints=(_hinge(1, 110.0),),
        benchmark=("clean",),
        symmetry=None,
        window=_CABINET,
        diagonal=0.65,
        rest="smallest-box",
        words=("door",),
    ),
    Category(
        name="oven",
        parts=("body", "door"),
        joints=(_hinge(1, 90.0),),
        benchmark=("clean",),
        symmetry=None,
        window=_CABINET,
        diagonal=1.05,
        rest="smallest-box",
        words=("door",),
    ),
    Category(
        name="washer",
        parts=("body", "door"),
        joints=(_hinge(1, 135.0),),
        benchmark=("clean",),
        symmetry=None,
        window=_CABINET,
        diagonal=1.2,
        rest="smallest-box",
        words=("door", "lid"),
    ),
    Category(
        name="eyeglasses",
        parts=("frame", "left temple", "right temple"),
        joints=(_hinge(1, 80.0), _hinge(2, 80.0)),
        benchmark=("clean",),
        symmetry=TURN_X,
        window=Window(azimuth=(-90.0, 90.0), elevation=(10.0, 70.0)),
        diagonal=0.21,
        rest="largest-box",
        words=("leg", "temple", "arm"),
    ),
    Category(
        name="basket",
        parts=("body", "left handle", "right handle"),
        joints=(_hinge(1, 85.0), _hinge(2, 85.0)),
        benchmark=("sensor",),
        symmetry=TURN_Z,
        window=Window(azimuth=(-180.0, 180.0), elevation=(15.0, 70.0)),
        diagonal=0.5,
        rest="tallest",
        words=("handle",),
    ),
    Category(
        name="drawer",
        parts=("body", "drawer"),
        joints=(_slide(1, 0.45),),
        benchmark=("sensor",),
        symmetry=None,
        window=_CABINET,
        diagonal=0.8,
        rest="smallest-box",
        words=("drawer",),
    ),
    Category(
        name="suitcase",
        parts=("body", "lid"),
        joints=(_hinge(1, 110.0),),
        benchmark=("sensor",),
        symmetry=TURN_X,
        window=_TABLE_TOP,
        diagonal=0.75,
        rest="smallest-box",
        words=("lid", "cover", "shell"),
    ),
    Category(
        name="scissors",
        parts=("first blade", "second blade"),
        joints=(_hinge(1, 60.0),),
        benchmark=("sensor",),
        symmetry=TURN_X,
        window=Window(azimuth=(-180.0, 180.0), elevation=(30.0, 85.0)),
        diagonal=0.2,
        rest="smallest-box",
        words=("blade", "leg", "half"),
    ),
)

CATEGORIES: dict[str, Category] = {category.name: category for category in _ALL}


def category(name: str) -> Category:
    """The category of this name.

    Raises:
        ValueError: The name is not listed; the message lists those that are.
    """
    if name not in CATEGORIES:
        raise ValueError(f"category {name!r}: expected one of {', '.join(CATEGORIES)}")
    return CATEGORIES[name]
