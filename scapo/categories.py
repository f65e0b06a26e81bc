# SPDX-License-Identifier: MIT
"""What a category is, and the nine as data: parts, joints, travel, viewing window, symmetry, size.

A category is one entry here. Imports nothing heavy: help texts list the names.

Object frame: z up, the front (door, drawer, user side) faces -x, origin = centre of the bounding
box at rest. Travel is what real objects of the category do: laptops open to 120 to 150 degrees,
oven doors to 90, glasses fold to about 80, drawers pull out most of their depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import radians
from typing import Literal

from scapo.text import did_you_mean, is_word

JointKind = Literal["revolute", "prismatic"]
RestRule = Literal["smallest-box", "largest-box", "tallest"]
HingeRule = Literal["any", "upright"]


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
    window: Window
    diagonal: float
    """Nominal diagonal of the box at rest in metres, for models without metric size."""
    benchmark: tuple[Literal["clean", "sensor"], ...] = ()
    symmetry: Matrix3 | None = None
    """Rotation A of the object frame that exchanges the parts (docs/data-format.md), or None."""
    rest: RestRule = "smallest-box"
    """Which joint limit is rest, for models that do not say: the one with this bounding box."""
    hinge: HingeRule = "any"
    """Whether all hinges stand: tells what is up in models that have it by convention alone."""
    words: tuple[str, ...] = ()
    """Link or semantic names that tell the moving parts of this category."""

    @property
    def turns_over(self) -> bool:
        """Whether `symmetry` turns an object of one or two hinges over, and people stand before it.

        Its two readings then differ by shape, and a camera at the left of one is at the right of
        the other, as of laptops. Those of a basket are alike; people stand all around scissors.
        """
        low, high = self.window.azimuth
        over = self.symmetry is not None and self.symmetry[2][2] < 0
        hinges = [joint.kind for joint in self.joints] in (["revolute"], ["revolute"] * 2)
        return over and hinges and high - low < 360


def check_category(kind: Category) -> None:
    """Refuse what cannot be: categories that others define come with mistakes.

    Raises:
        ValueError: `field: expected, found`.
    """
    if not is_word(kind.name):
        raise ValueError(f"name: expected a folder's name, found {kind.name!r}")
    if len(kind.parts) != len(kind.joints) + 1 or not kind.joints:
        raise ValueError(
            f"parts: expected two or more, one more than joints, found {len(kind.parts)} parts "
            f"and {len(kind.joints)} joints"
        )
    if len(set(kind.parts)) < len(kind.parts) or not all(map(is_word, kind.parts)):
        raise ValueError(f"parts: expected different names, found {', '.join(kind.parts)}")
    for j, joint in enumerate(kind.joints):
        _check_joint(joint, j)
    if not 0 < kind.diagonal < math.inf:
        raise ValueError(f"diagonal: expected metres above 0, found {kind.diagonal}")
    _check_window(kind.window)
    if kind.symmetry is not None and not _is_rotation(kind.symmetry):
        raise ValueError(f"symmetry: expected a rotation, found {kind.symmetry}")


def _check_joint(joint: JointSpec, j: int) -> None:
    if (joint.parent, joint.child) != (0, j + 1):
        raise ValueError(
            f"joints[{j}]: expected parent 0 and child {j + 1}, found {joint.parent} and "
            f"{joint.child}"
        )
    if not 0 <= joint.lower < joint.upper < math.inf:
        raise ValueError(
            f"joints[{j}]: expected 0 <= lower < upper, found {joint.lower} and {joint.upper}"
        )


def _check_window(window: Window) -> None:
    for name, ends, most in (
        ("azimuth", window.azimuth, 180.0),
        ("elevation", window.elevation, 90.0),
    ):
        if not -most <= ends[0] < ends[1] <= most:
            raise ValueError(
                f"window.{name}: expected rising degrees from -{most:g} to {most:g}, found "
                f"{ends[0]:g} and {ends[1]:g}"
            )


def _is_rotation(rows: Matrix3) -> bool:
    """Whether the rows are orthonormal and right-handed, to a millionth."""
    a, b, c = rows
    products = [sum(x * y for x, y in zip(u, v, strict=True)) for u in rows for v in rows]
    cross = (b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0])
    turned = sum(x * y for x, y in zip(a, cross, strict=True))
    unit = (1, 0, 0, 0, 1, 0, 0, 0, 1)
    return abs(turned - 1) < 1e-6 and all(
        abs(x - y) < 1e-6 for x, y in zip(products, unit, strict=True)
    )


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
        hinge="upright",
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
        raise ValueError(
            f"category {name!r}: expected one of {', '.join(CATEGORIES)}"
            f"{did_you_mean(name, CATEGORIES)}"
        )
    return CATEGORIES[name]
