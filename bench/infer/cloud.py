# SPDX-License-Identifier: MIT
"""The cloud of one object as it came from a file, made fit for a model, or refused with the reason.

What is left out or doubtful is said in `warnings`; what cannot be meant is an `InputError`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Num, UInt8

LEAST_POINTS = 64
"""Of an object, below which its parts cannot be told apart."""
MOST_POINTS = 50_000_000
"""That are read from a file at all."""
KEPT_POINTS = 200_000
"""That results are written for; of more, so many are drawn."""
LARGEST = 30.0
"""Metres: no object of any category extends so far, in millimetres every one does."""
FAR = 1e7
"""Coordinates beyond it, in any unit, stand for nothing seen."""
SPAN = (0.01, 0.99)
"""Quantiles of coordinates that count as the ends of a cloud."""


class InputError(ValueError):
    """What is wrong with an input, in one line that names it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Points of one object."""

    points: Float[np.ndarray, "N 3"]
    """Metres; the camera's frame, or another one in which `sensor` is known."""
    color: UInt8[np.ndarray, "N 3"] | None = None
    sensor: Float[np.ndarray, 3] | None = None
    """Centre of the camera; None: the origin."""
    up: Float[np.ndarray, 3] | None = None
    """Against gravity, any length; None: not known."""
    warnings: tuple[str, ...] = ()

    def extent(self) -> Float[np.ndarray, 3]:
        """Sides of the box, but for single points far off."""
        low, high = np.quantile(self.points, SPAN, axis=0)
        return high - low

    def warned(self, *lines: str) -> Cloud:
        """The same with more warnings."""
        return replace(self, warnings=(*self.warnings, *lines))


def check_count(where: str, count: int) -> None:
    """Refuse what would not fit into memory before it is read.

    Raises:
        InputError: Too many points.
    """
    if count > MOST_POINTS:
        raise InputError(f"{where}: expected at most {MOST_POINTS:,} points, found {count:,}")


def made_fit(
    where: str,
    points: Num[np.ndarray, "N 3"],
    color: UInt8[np.ndarray, "N 3"] | None,
    scale: float | None,
) -> Cloud:
    """The finite points, not more than are needed, in metres.

    Points at the very origin are a depth camera's way to say that it saw nothing.

    Args:
        where: Name of the input, for errors.
        points: In any unit and number format.
        color: Of the points.
        scale: Metres in the unit of the points; None for 1.

    Raises:
        InputError: Too few points are left, or they are no object's in metres.
    """
    known = (np.abs(points) < FAR).all(1) & points.any(1)  # NaN is not less than anything
    index, warnings = np.flatnonzero(known), []
    if lost := len(points) - len(index):
        warnings.append(f"{lost:,} of {len(points):,} points left out: not finite, or at 0 0 0")
    if len(index) < LEAST_POINTS:
        found = f"{len(index)}" + (f" and {lost:,} that are NaN, infinite or 0 0 0" if lost else "")
        raise InputError(f"{where}: expected at least {LEAST_POINTS} finite points, found {found}")
    if len(index) > KEPT_POINTS:
        warnings.append(f"{KEPT_POINTS:,} of {len(index):,} points drawn at random are used")
        index = np.sort(np.random.default_rng(0).choice(index, KEPT_POINTS, replace=False))
    cloud = Cloud(
        points=(points[index].astype(np.float64) * (scale or 1.0)).astype(np.float32),
        color=None if color is None else color[index],
        warnings=tuple(warnings),
    )
    _check_extent(where, cloud, scale)
    return cloud


def _check_extent(where: str, cloud: Cloud, scale: float | None) -> None:
    extent = cloud.extent()
    largest = float(extent.max())
    if not np.isfinite(largest) or largest > LARGEST:
        words = "this looks like millimetres: --scale 0.001" if scale is None else "another --scale"
        raise InputError(
            f"{where}: expected an object in metres, found one of {largest:.4g} m; {words}"
        )
    if float(np.sort(extent)[1]) < 1e-4:
        raise InputError(
            f"{where}: expected a surface, found points on a line or in one place, within "
            f"{extent[0]:.2g} x {extent[1]:.2g} x {extent[2]:.2g} m"
        )


def check_sensor(cloud: Cloud) -> Cloud:
    """The cloud, with a warning where the camera cannot be where it is said to be."""
    camera = np.zeros(3) if cloud.sensor is None else cloud.sensor
    middle = cloud.points.mean(0)
    reach = float(np.quantile(np.linalg.norm(cloud.points - middle, axis=1), SPAN[1]))
    if float(np.linalg.norm(camera - middle)) > reach:
        return cloud
    return cloud.warned(
        "the camera's centre lies within the cloud: clouds are expected in the camera's frame "
        "(x right, y down, z forward), or say where the camera was with --sensor"
    )
