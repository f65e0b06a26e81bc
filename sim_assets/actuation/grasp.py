# SPDX-License-Identifier: MIT
"""Where a moving part is taken hold of, and the path that a joint implies for that point."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Float

from scapo.categories import JointKind

EDGE = 0.95
"""Share of the greatest reach from which on a point belongs to the free edge."""
SAMPLES = 2000
"""Points drawn on the part's surface to find the edge."""

Point = Float[np.ndarray, " 3"]


def grasp_point(mesh: trimesh.Trimesh, kind: JointKind, pivot: Point, axis: Point) -> Point:
    """The middle of a part's free edge, where its handle would be: a point of its surface.

    Reach is the distance to the axis, of a drawer the distance along the way it opens. Of the
    surface points that have at least `EDGE` of the greatest reach the one nearest to their mean is
    taken: the middle of a lid's front edge, the side of a door away from its hinge, the middle of a
    drawer's front, the tip of a temple, the top of a basket's handle.

    Args:
        mesh: The moving part at rest.
        kind: Of the joint.
        pivot: A point on the axis.
        axis: Unit; a positive state opens.
    """
    rng = np.random.default_rng(0)
    drawn = trimesh.sample.sample_surface(mesh, SAMPLES, seed=rng)[0]
    points = np.asarray(drawn, np.float64)
    along = (points - pivot) @ axis
    if kind == "prismatic":
        low = along.min()
        reach = along - low
    else:
        reach = np.linalg.norm(points - pivot - along[:, None] * axis, axis=1)
    edge = points[reach >= EDGE * reach.max()]
    return edge[np.linalg.norm(edge - edge.mean(0), axis=1).argmin()]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """Where a joint carries a point: a circle about its axis, or a line along it."""

    start: Point
    centre: Point
    """Of the circle; of a line its start."""
    outward: Point
    """From the centre to the start; zero of a line."""
    forward: Point
    """Speed at the start, per rad: as long as the radius; of a line, per metre, the unit axis."""
    turning: bool

    def at(self, state: float) -> Point:
        """The point after a turn of so many radians, or so many metres further."""
        if not self.turning:
            return self.start + state * self.forward
        return self.centre + math.cos(state) * self.outward + math.sin(state) * self.forward

    def tangent(self, state: float) -> Point:
        """Speed of the point there, per rad or per metre."""
        if not self.turning:
            return self.forward
        return math.cos(state) * self.forward - math.sin(state) * self.outward

    def towards(self, direction: Point) -> Path:
        """The same path, walked so that it begins rather along `direction` than against it.

        An axis is a line: which way its joint opens is not asked of a prediction.
        """
        return self if self.forward @ direction >= 0 else replace(self, forward=-self.forward)

    def lever(self) -> float:
        """Radius of the circle; 1 of a line."""
        return float(np.linalg.norm(self.forward))


def path_of(kind: JointKind, pivot: Point, axis: Point, start: Point) -> Path:
    """The path of a point that a joint moves by the right-hand rule, or along its axis.

    Args:
        kind: Of the joint.
        pivot: A point on the axis; of a slide it says nothing.
        axis: Of any length but zero.
        start: Of the point.
    """
    axis = axis / np.linalg.norm(axis)
    if kind == "prismatic":
        return Path(start=start, centre=start, outward=np.zeros(3), forward=axis, turning=False)
    centre = pivot + (start - pivot) @ axis * axis
    outward = start - centre
    return Path(
        start=start, centre=centre, outward=outward, forward=np.cross(axis, outward), turning=True
    )
