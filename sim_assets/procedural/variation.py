# SPDX-License-Identifier: MIT
"""How much the objects of a category differ: proportions, their coefficients of variation, tilts.

Everything is measured on the surfaces and joints of objects at rest, procedural or read, never on
the parameters that made them. The coefficient of variation is the standard deviation over the mean.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sim_assets.objects import ArticulatedObject


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """One proportion over the objects of a category."""

    name: str
    main: bool
    """Whether its coefficient is held to at least 0.15 (docs/variation.md)."""
    count: int
    mean: float
    variation: float
    """The coefficient; of tilts the standard deviation in degrees."""
    low: float
    high: float


def box(obj: ArticulatedObject, part: int) -> Float[np.ndarray, "2 3"]:
    """Corners of a part's bounding box at rest, m."""
    corners = np.concatenate([visual.mesh.bounds for visual in obj.visuals[part]])
    return np.stack([corners.min(0), corners.max(0)])


def axis_foot(obj: ArticulatedObject, joint: int) -> Float[np.ndarray, " 3"]:
    """From the box's centre to the nearest point of a hinge's axis, over the box's diagonal.

    The pivot itself where the joint slides: the middle of what slides.
    """
    foot = obj.pivot[joint] / np.linalg.norm(obj.extents())
    if obj.category.joints[joint].kind == "revolute":
        foot = foot - (foot @ obj.axis[joint]) * obj.axis[joint]
    return foot


def tilt(obj: ArticulatedObject, joint: int) -> float:
    """Angle between a joint's axis and the nearest direction of the bounding box, degrees."""
    size = np.sort(np.abs(obj.axis[joint]))
    return round(float(np.degrees(np.arctan2(np.hypot(size[0], size[1]), size[2]))), 6)


def proportions(obj: ArticulatedObject) -> dict[str, float]:
    """Of one object: its box's, and its parts' boxes over it, by side and by volume."""
    sides = obj.extents()
    found = {"depth/width": sides[0] / sides[1], "height/width": sides[2] / sides[1]}
    for joint in obj.category.joints:
        part = obj.category.parts[joint.child]
        share = np.ptp(box(obj, joint.child), axis=0) / sides
        found[f"{part}/body"] = share.prod()
        for name, value in zip(("depth", "width", "height"), share, strict=True):
            found[f"{part}/body {name}"] = value
    return {name: float(value) for name, value in found.items()}


def statistics(objects: Iterable[ArticulatedObject]) -> list[Statistic]:
    """Every proportion, pivot and tilt over objects of one category, at least one."""
    rows, feet, tilts = [], [], []
    category = None
    for obj in objects:
        category = obj.category
        rows.append(proportions(obj))
        feet.append([axis_foot(obj, j) for j in range(len(obj.axis))])
        tilts.append([tilt(obj, j) for j in range(len(obj.axis))])
    if category is None:
        raise ValueError("objects: expected at least one, found none")
    result = [_statistic(name, [row[name] for row in rows]) for name in rows[0]]
    for j, joint in enumerate(category.joints):
        part = category.parts[joint.child]
        points, angles = np.array(feet)[:, j], np.array(tilts)[:, j]
        distance = np.linalg.norm(points, axis=1)
        spread = np.sqrt(points.var(0).sum()) / distance.mean()
        result.append(_row(f"{part} pivot/body", distance, spread, main=True))
        result.append(_row(f"{part} tilt (deg)", angles, angles.std(), main=False))
    return result


def _statistic(name: str, values: list[float]) -> Statistic:
    """Sides of a part over the body's are told beside its volume's share, which is a main one."""
    array = np.array(values)
    return _row(name, array, array.std() / array.mean(), main=" " not in name.split("/")[1])


def _row(name: str, values: np.ndarray, variation: float, *, main: bool) -> Statistic:
    return Statistic(
        name=name,
        main=main,
        count=len(values),
        mean=float(values.mean()),
        variation=float(variation),
        low=float(values.min()),
        high=float(values.max()),
    )
