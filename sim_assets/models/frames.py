# SPDX-License-Identifier: MIT
"""The object frame of a model: z up, front towards -x, metres, centre of the box at rest.

Where the caller does not say where the front is, it is told from the joint. The source's own front
goes before, unless a door or drawer plainly (within 26 degrees) opens another way:

- a door or drawer: where it moves to when it begins to open; of several doors, on the mean;
- a lid, also a washer's that opens upwards: from its hinge towards its middle, as a laptop's user
  sits opposite to the hinge;
- eyeglasses: from the temples' middles to their hinges;
- basket: along the handles' hinges, so that these run along x (of the two ends the one nearer to
  the root link's -x or -y), whatever the source says;
- scissors: z is the axis (on the side that is up), the closed blades run along x with the tips at
  +x, the rings towards the user; the first blade is the one from which the other opens by a turn
  about -z, so that when they open the first tip is at +y.

What is up is the caller's, else the source's. A URDF of no known set has z up by REP 103, but
where a category's hinges stand (safes, `Category.hinge`) and a model's runs along y, y is up, as
in glTF.

Doors, lids, temples: snapped to the nearest of the root link's axes that is not vertical.
Left of eyeglasses is the wearer's, who looks out of the front: -y. Left of a basket is that of
somebody who looks at its front: +y. So are moving parts numbered, and those of a category of one's
own from the top down where they lie rather one on another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from scapo.categories import Category
from sim_assets.models.validate import Repairs, refuse

AXES = ("x", "y", "z")
SURE = 0.9
"""Cosine of the angle to an axis of the root link up to which a door's motion tells the front."""
ABSURD = 4.0
"""A metric model larger or smaller than its category's nominal diagonal by this is rescaled."""

Vector = Float[np.ndarray, " 3"]


def direction(name: str, path: Path) -> Vector:
    """The unit vector of "x", "+x", "-x", "y", ...

    Raises:
        AssetError: Another word.
    """
    if not _is_direction(name):
        raise refuse(path, "a direction out of x, -x, y, -y, z, -z", repr(name))
    sign = -1.0 if name.strip().startswith("-") else 1.0
    return sign * np.eye(3)[AXES.index(_letter(name))]


def check_wanted(up: str | None, front: str | None, scale: float | None) -> None:
    """Refuse what no model can be read by, before any is.

    Raises:
        ValueError: `up`, `front` or `scale`: expected, found.
    """
    for name, word in (("up", up), ("front", front)):
        if word is not None and not _is_direction(word):
            raise ValueError(f"{name}: expected x, -x, y, -y, z or -z, found {word!r}")
    if up is not None and front is not None and _letter(up) == _letter(front):
        raise ValueError(f"front: expected an axis at right angles to up, {up}, found {front}")
    if scale is not None and not 0 < scale < np.inf:
        raise ValueError(f"scale: expected a finite number above 0, found {scale}")


def _is_direction(word: str) -> bool:
    clean = word.strip().lower()
    return clean.lstrip("+-") in AXES and len(clean) <= 2


def _letter(word: str) -> str:
    return word.strip().lower()[-1]


def name_of(vector: Vector) -> str:
    """The nearest of x, -x, y, ..."""
    k = int(np.abs(vector).argmax())
    return ("-" if vector[k] < 0 else "") + AXES[k]


def basis(up: Vector, front: Vector, path: Path) -> Float[np.ndarray, "3 3"]:
    """The rotation object_R_asset that turns `up` to z and `front` to -x.

    Raises:
        AssetError: They are not at right angles.
    """
    if abs(up @ front) > 1e-6:
        raise refuse(path, "a front at right angles to up", f"{name_of(front)} and {name_of(up)}")
    return np.stack([-front, np.cross(up, -front), up])


def told_up(category: Category, up: Vector, axis: Float[np.ndarray, "J 3"]) -> Vector:
    """What is up in a model whose source has it by convention alone, by the rule above.

    Args:
        category: Those whose hinges stand tell it.
        up: By the convention; unit, root link.
        axis: Unit, root link.
    """
    other = np.eye(3)[1]
    return other if category.hinge == "upright" and abs(axis[0] @ other) > SURE else up


def snapped(vector: Vector, up: Vector) -> Vector:
    """The root link's axis nearest to a direction, of those at right angles to up."""
    level = np.where(np.abs(up) > 0.5, 0.0, vector)
    k = int(np.abs(level).argmax())
    return np.sign(level[k] or 1.0) * np.eye(3)[k]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ToldFront:
    """A front that was told from the joint."""

    front: Vector
    """One of the root link's axes."""
    sure: bool
    """Whether it holds against what is usual in the model's set."""


def told_front(
    category: Category,
    up: Vector,
    pivot: Float[np.ndarray, "J 3"],
    axis: Float[np.ndarray, "J 3"],
    middle: Float[np.ndarray, "J 3"],
) -> ToldFront:
    """Where a model's front is, by the rules above.

    Args:
        category: Says which rule.
        up: Unit, root link.
        pivot: On the axes at rest, root link.
        axis: Unit; positive motion opens.
        middle: Centre of each moving part at rest.
    """
    if category.rest == "tallest":
        along = snapped(axis[0], up)
        return ToldFront(front=-along if along.sum() > 0 else along, sure=True)
    if category.joints[0].kind == "prismatic":
        front = snapped(axis[0], up)
        return ToldFront(front=front, sure=bool(axis[0] @ front > SURE))
    arms = middle - pivot
    motion = np.cross(axis, arms).mean(0)  # of two doors, which open to the same side
    level = motion - up * (motion @ up)
    door = "door" in category.words
    if door and np.linalg.norm(level) > 0.5 * np.linalg.norm(motion):
        front = snapped(level, up)
        return ToldFront(front=front, sure=bool(motion @ front > SURE * np.linalg.norm(motion)))
    if len(category.joints) > 1:
        return ToldFront(front=snapped(-arms.mean(0), up), sure=False)
    arm = arms[0]
    return ToldFront(front=snapped(arm - axis[0] * (axis[0] @ arm), up), sure=False)


def order(category: Category, middle: Float[np.ndarray, "J 3"]) -> list[int]:
    """Moving parts from left to right, or from the top down where they lie rather one on another.

    Parts that a symmetry exchanges lie side by side.

    Args:
        category: Of the object.
        middle: Of each moving part at rest, object frame.
    """
    _, beside, above = np.ptp(middle, axis=0)
    stacked = category.symmetry is None and above > beside
    along = np.array([0.0, 0.0, 1.0]) if stacked else left(category)
    return np.argsort(-(middle @ along), kind="stable").tolist()


def left(category: Category) -> Vector:
    """Where the left one of two moving parts is, in the object frame."""
    return np.array([0.0, 1.0 if category.rest == "tallest" else -1.0, 0.0])


def blades(parts: Sequence[Float[np.ndarray, "_ 3"]], normal: Vector) -> Vector:
    """The direction of closed scissors' tips: halfway between those of the two blades.

    The tips' end of the long side of the smallest rectangle about the pair is the narrower one:
    rings stand further apart than blades. Each blade points from the pivot to the middle of its
    far end there.

    Args:
        parts: Vertices of the two parts, the origin on the axis.
        normal: Unit, along the axis.
    """
    first = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(normal, first)], 1)
    flat = [part @ plane for part in parts]
    points = np.concatenate(flat)
    along, across = _rectangle(points)
    widths = [np.abs(points[side] @ across).max() for side in _ends(points @ along)]
    if widths[1] > widths[0]:
        along = -along
    tips = [_far_end(part, along) for part in flat]
    middle = sum(tip / np.linalg.norm(tip) for tip in tips)
    return plane @ (middle / np.linalg.norm(middle))


def _far_end(
    points: Float[np.ndarray, "N 2"], along: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " 2"]:
    """Middle of the box about the points at the end."""
    reach = points @ along
    end = points[reach > 0.97 * reach.max()]
    return (end.min(0) + end.max(0)) / 2


def _ends(along: Float[np.ndarray, " N"]) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """The outer halves behind and before the origin."""
    return along <= along.min() / 2, along >= along.max() / 2


def _rectangle(
    points: Float[np.ndarray, "N 2"],
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Directions of the long and the short side of the smallest rectangle about points."""
    turns = np.linspace(0, np.pi / 2, 361)[:-1]
    frames = [np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for t in turns]
    areas = [np.prod(np.ptp(points @ frame.T, axis=0)) for frame in frames]
    best = frames[int(np.argmin(areas))]
    sides = np.ptp(points @ best.T, axis=0)
    return (best[0], best[1]) if sides[0] > sides[1] else (best[1], best[0])


def metres_per_unit(
    category: Category, size: float, metric: bool, wanted: float | None, repairs: Repairs
) -> float:
    """The scale: the caller's, 1 for metric models of sane size, else to the nominal diagonal.

    Args:
        category: Has the nominal diagonal.
        size: Diagonal of the box at rest in asset units.
        metric: Whether the source says that its unit is the metre.
        wanted: The caller's scale.
        repairs: Told when a metric model is rescaled.
    """
    if wanted is not None:
        return wanted
    ratio = size / category.diagonal
    if metric and 1 / ABSURD <= ratio <= ABSURD:
        return 1.0
    if metric:
        repairs.add(
            f"A diagonal of {size:.3g} is no size in metres for the category "
            f"{category.name!r}: scaled to {category.diagonal:g} m"
        )
    return category.diagonal / size
