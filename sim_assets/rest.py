# SPDX-License-Identifier: MIT
"""Where a model's joints are at rest, which way they open, and how far (CONTRACT 1).

Zero has no fixed meaning in the wild: one laptop is open at 0, another closed, a fridge stands half
open. So the limits are scanned for the state that `Category.rest` describes:

- "smallest-box" (closed lids, doors, drawers, blades) and "largest-box" (unfolded temples): the
  surface area of the convex hull of the whole object is smallest, or largest. The hull is the
  tightest box, and unlike a bounding box it does not change when the object is turned.
- "tallest" (upright handles): the moving part stands highest.

A limit that comes within 2 % of the best is taken before a state inside the limits, as mechanisms
stop where they close; of two such limits the one nearer to zero.
Where no limit will do, zero is taken if it comes within 10 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from scapo.types import Category
from sim_assets.articulated import joint_motion
from sim_assets.reduce import Reduction, Surfaces, moved
from sim_assets.robot import Joint, Robot

STEPS = 61
TOLERANCE = 0.02
"""Of the measure's range over the scan."""
ZERO_TOLERANCE = 0.1
"""The same for zero, where no limit will do."""
FLAT = 0.005
"""A measure that changes by less, relative to its size, says nothing."""

Profile = Callable[[float], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rest:
    """Of one joint."""

    position: float
    """q at rest, rad or asset units."""
    direction: float
    """+1 where a growing q opens, else -1."""
    upper: float
    """Travel from rest towards open, rad or asset units."""


def find_rest(
    robot: Robot,
    surfaces: Surfaces,
    reduction: Reduction,
    category: Category,
    up: Float[np.ndarray, " 3"],
) -> tuple[Rest, ...]:
    """Rest, opening direction and travel of each joint of the category.

    Args:
        robot: The model.
        surfaces: Of its links.
        reduction: Which joints and parts are the category's.
        category: Says the rule.
        up: Unit, coordinates of the root link.
    """
    scene = _Scene(robot, surfaces, reduction, up)
    at = [joint.clamp(0.0) for joint in reduction.joints]
    result: list[Rest] = []
    for _ in range(2 if len(at) > 1 else 1):
        result = []
        for j, joint in enumerate(reduction.joints):
            profile = scene.profile(category, at, j)
            low, high = limits(joint)
            at[j] = _best(profile, joint, low, high)
            result.append(_opening(profile, at[j], low, high, category.joints[j].upper, joint))
    return tuple(result)


def limits(joint: Joint) -> tuple[float, float]:
    """Of a sound joint; a full turn where it is continuous."""
    if joint.kind == "continuous" or joint.lower is None or joint.upper is None:
        return -pi, pi
    return joint.lower, joint.upper


class _Scene:
    """Hull points of each part in the frame of its head link, and how parts move."""

    def __init__(
        self, robot: Robot, surfaces: Surfaces, reduction: Reduction, up: Float[np.ndarray, " 3"]
    ) -> None:
        self.reduction = reduction
        wanted = {joint.name: joint.clamp(0.0) for joint in reduction.joints}
        poses = robot.poses(wanted)
        self.base_T_part = []
        self.points = []
        base_T_root = np.linalg.inv(poses[reduction.heads[0]])
        self.up = base_T_root[:3, :3] @ up
        for head, part in zip(reduction.heads, reduction.parts, strict=True):
            head_T_root = np.linalg.inv(poses[head])
            pieces = [
                moved(visual.mesh.vertices, head_T_root @ poses[name])
                for name in sorted(part & set(surfaces))
                for visual in surfaces[name]
            ]
            self.points.append(hull_points(np.concatenate(pieces)))
            self.base_T_part.append(base_T_root @ poses[head])
        self.zero = [wanted[joint.name] for joint in reduction.joints]

    def pose(self, j: int, q: float) -> Float[np.ndarray, "4 4"]:
        """Pose of moving part j + 1 in the base's head frame with joint j at q.

        The joint's frame is its child's: the moving part's head, or the base's if inverted.
        """
        joint = self.reduction.joints[j]
        kind = "prismatic" if joint.kind == "prismatic" else "revolute"
        step = joint_motion(np.zeros(3), joint.axis, q - self.zero[j], kind)
        if self.reduction.inverted[j]:
            return np.linalg.inv(step) @ self.base_T_part[j + 1]
        return self.base_T_part[j + 1] @ step

    def profile(self, category: Category, at: list[float], j: int) -> Profile:
        """What rest makes smallest, as a function of joint j's position; others are at `at`."""
        still = [self.points[0]]
        for k, q in enumerate(at):
            if k != j:
                still.append(moved(self.points[k + 1], self.pose(k, q)))
        others = hull_points(np.concatenate(still))
        mine = self.points[j + 1]
        if category.rest == "tallest":
            return lambda q: -float(moved(mine, self.pose(j, q)).mean(0) @ self.up)
        sign = 1.0 if category.rest == "smallest-box" else -1.0
        return lambda q: sign * hull_area(np.concatenate([others, moved(mine, self.pose(j, q))]))


def _best(profile: Profile, joint: Joint, low: float, high: float) -> float:
    grid = np.linspace(low, high, STEPS)
    values = np.array([profile(q) for q in grid])
    spread = np.ptp(values)
    zero = min(max(0.0, low), high)
    if spread < FLAT * np.abs(values).max():
        return zero if joint.kind == "continuous" else min(low, high, key=abs)
    enough = values.min() + TOLERANCE * spread
    ends = [q for q, value in ((low, values[0]), (high, values[-1])) if value <= enough]
    if ends and joint.kind != "continuous":
        return min(ends, key=abs)
    # Zero, which the model's author chose, before other states that do nearly as well: a door
    # without limits that is pushed into its body makes the hull smaller still.
    if profile(zero) <= values.min() + ZERO_TOLERANCE * spread:
        return zero
    k = int(values.argmin())
    fine = np.linspace(grid[max(k - 1, 0)], grid[min(k + 1, STEPS - 1)], 41)
    return float(fine[np.argmin([profile(q) for q in fine])])


def _opening(
    profile: Profile, rest: float, low: float, high: float, largest: float, joint: Joint
) -> Rest:
    """The side with more travel; of two like ones that which changes the measure more."""
    above, below = high - rest, rest - low
    if joint.kind == "continuous":
        above = below = largest
    up, down = min(above, largest), min(below, largest)
    if joint.kind == "prismatic":
        up, down = above, below
    if min(up, down) > 0.2 * max(up, down):
        step = min(up, down)
        rising = profile(rest + step) >= profile(rest - step) - 1e-9
        direction = 1.0 if rising else -1.0
    else:
        direction = 1.0 if up >= down else -1.0
    return Rest(position=rest, direction=direction, upper=up if direction > 0 else down)


def hull_area(points: Float[np.ndarray, "N 3"]) -> float:
    """Surface area of the convex hull; twice the area for points in a plane."""
    try:
        return float(ConvexHull(points).area)
    except QhullError:
        sides = np.ptp(points, axis=0)
        return 2 * float(sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])


def hull_points(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """The corners of the convex hull; for flat sets the extreme points in many directions."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        k = np.arange(1024) + 0.5
        z, turn = 1 - 2 * k / 1024, pi * (1 + 5**0.5) * k
        ring = np.sqrt(1 - z * z)
        directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)
        return points[np.unique((points @ directions.T).argmax(0))]
