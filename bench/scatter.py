# SPDX-License-Identifier: MIT
"""How far several answers for the same cloud scatter, without any truth.

Two statistics of the deviations, which are angles or distances: `std`, their root mean square
about the mean (with R - 1), and `mad`, their median about the geometric median. Both are those of
a vector, not of one coordinate: for a normal distribution with deviation s in each of two
directions, std is 1.41 s and mad 1.18 s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from bench.changes import axis_places, centroid_and_unit
from bench.matching import project_rotations, rotation_degrees
from bench.metrics import line_degrees, unit
from bench.scores import Rows

Scatter = dict[tuple[str, str, str], np.ndarray]
"""(quantity, unit, `std` or `mad`) -> (B, K); NaN where an answer is missing."""

Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]


def scatter(answers: Sequence[Rows], points: Float[np.ndarray, "B N 3"]) -> Scatter:
    """Spread of R answers for the same clouds.

    Args:
        answers: `camera_T_part`, `joint_pivot` and `joint_axis` where a method has them, all in
            one frame.
        points: The clouds, for the unit `r4` and the place of the axes.

    Returns:
        `base_rotation`, `axis` (of lines) and `pivot` (place of the axis).
    """
    centre, length = centroid_and_unit(points)
    out: Scatter = {}
    if all("camera_T_part" in rows for rows in answers):
        turns = np.stack([rows["camera_T_part"][:, :1, :3, :3] for rows in answers])
        out |= _named("base_rotation", "deg", _spread(turns, project_rotations, rotation_degrees))
    if all("joint_axis" in rows and "joint_pivot" in rows for rows in answers):
        axes = same_signs(np.stack([rows["joint_axis"] for rows in answers]))
        out |= _named("axis", "deg", _spread(axes, unit, line_degrees))
        places = np.stack([axis_places(rows, centre) for rows in answers])
        found = _spread(places, np.asarray, _distance)
        out |= _named("pivot", "m", found)
        out |= _named("pivot", "r4", {key: item / length[:, None] for key, item in found.items()})
    return out


def same_signs(axes: Float[np.ndarray, "R *B 3"]) -> Float[np.ndarray, "R *B 3"]:
    """Unit axes, each turned to the side of their common principal direction."""
    axes = unit(axes.astype(np.float64))
    moment = np.nan_to_num(np.einsum("r...i,r...j->...ij", axes, axes))
    principal = np.linalg.eigh(moment)[1][..., -1]
    return axes * np.where((axes * principal).sum(-1, keepdims=True) < 0, -1.0, 1.0)


def geometric_median(values: Float[np.ndarray, "R *B D"]) -> Float[np.ndarray, "*B D"]:
    """The point with the smallest sum of distances to R points (Weiszfeld's iteration)."""
    centre = np.median(values, 0)
    for _ in range(100):
        distance = np.linalg.norm(values - centre, axis=-1, keepdims=True)
        weight = 1 / np.maximum(distance, 1e-12)
        centre = (weight * values).sum(0) / weight.sum(0)
    return centre


def _spread(
    values: np.ndarray, project: Callable[[np.ndarray], np.ndarray], distance: Distance
) -> dict[str, np.ndarray]:
    """Both statistics of R values (R, B, K, ...); `project` brings a centre back to its space."""
    values = values.astype(np.float64)
    count, shape = len(values), values.shape[1:]
    flat = values.reshape(count, *shape[:2], -1)
    median = project(geometric_median(flat).reshape(shape))
    about_mean = distance(values, np.broadcast_to(project(values.mean(0)), values.shape))
    about_median = distance(values, np.broadcast_to(median, values.shape))
    return {
        "std": np.sqrt(np.square(about_mean).sum(0) / max(1, count - 1)),
        "mad": np.median(about_median, 0),
    }


def _named(name: str, label: str, found: dict[str, np.ndarray]) -> Scatter:
    return {(name, label, statistic): value for statistic, value in found.items()}


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)
