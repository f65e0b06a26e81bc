# SPDX-License-Identifier: MIT
"""From a model with any joints to its category's joints, parts and rest (docs/data-format.md).

`reduce` chooses the joints: of those of the right kind with real travel, those whose link is named
as the category's moving part (`Category.words`; by the source's semantics, else by link and joint
names) go before the others, limited ones before continuous ones, those that do not mimic before
those that do; within a class the largest swept surface wins. Swept surface: the sum over the
triangles that the joint moves of area times the length of the centre's path over the travel, that
is the area times its mean displacement. All other joints stay at rest, and their links belong to
the part they hang on.

`find_rest` tells where they rest, which way they open, and how far. Zero has no fixed meaning in
the wild: one laptop is open at 0, another closed, a fridge stands half open. So the limits are
scanned for the state that `Category.rest` describes:

- "smallest-box" (closed lids, doors, drawers, blades) and "largest-box" (unfolded temples): the
  surface area of the convex hull of the whole object is smallest, or largest. The hull is the
  tightest box, and unlike a bounding box it does not change when the object is turned.
- "tallest" (upright handles): the moving part stands highest.

A limit that comes within 2 % of the best is taken before a state inside the limits, as mechanisms
stop where they close; of two such limits the one nearer to zero.
Where no limit will do, zero is taken if it comes within 10 %.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from math import pi, radians

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from scapo.categories import Category, JointSpec
from scapo.geometry.matrices import moved
from sim_assets.models.robot import Joint, Robot
from sim_assets.models.sources import Traits
from sim_assets.models.validate import AssetError, check_movable, kinds, refuse
from sim_assets.objects import Visual, joint_motion

LONGEST = {"revolute": 4 * pi, "prismatic": 3.0}
"""rad; asset diagonals."""
SHORTEST = {"revolute": radians(5.0), "prismatic": 0.01}
"""rad; asset diagonals. Knobs and buttons travel less."""
MAX_CORNERS = 2048
"""Of a part's convex hull, of which more are thinned where rest is searched."""
MAX_PRODUCTS = 1 << 25
"""Numbers that are computed at once: a quarter of a gigabyte."""
MAX_PAIRED = 16
"""Of so many best candidates pairs are formed."""

Surfaces = Mapping[str, tuple[Visual, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A joint that could be the category's."""

    joint: Joint
    rank: tuple[bool, bool, bool]
    """Named as a moving part, limited, no mimic: the larger the better."""
    swept: float
    """Asset units squared times rad, or cubed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reduction:
    """Which joints are the category's, and the links of its parts."""

    joints: tuple[Joint, ...]
    parts: tuple[frozenset[str], ...]
    """Base first, then the moving part of each joint."""
    heads: tuple[str, ...]
    """The link of each part that its others hang on."""
    inverted: tuple[bool, ...]
    """Per joint: the URDF has the moving part as parent and the base as child."""


def reduce(robot: Robot, surfaces: Surfaces, category: Category, traits: Traits) -> Reduction:
    """The category's joints in this model, in no particular order yet.

    Raises:
        AssetError: Too few joints of the right kind that move something visible.
    """
    spec = category.joints[0]
    found = candidates(robot, surfaces, spec, category.words, traits)
    count = len(category.joints)
    choices = itertools.combinations(found[:MAX_PAIRED], count)
    fitting = [
        (chosen, result)
        for chosen in choices
        if (result := _partition(robot, surfaces, tuple(c.joint for c in chosen))) is not None
    ]
    if not fitting:
        raise refuse(
            robot.path,
            f"{count} {spec.kind} joint{'s' * (count > 1)} for the category {category.name!r}",
            f"{len(found)} that could be, of {kinds(robot.joints.values())}{traits.remark}",
        )
    result = max(fitting, key=lambda choice: _order(choice[0]))[1]
    if count == 1 and _is_upside_down(robot, result.joints[0], category, traits):
        result = exchanged(result)
    return result


def exchanged(two: Reduction) -> Reduction:
    """A base and one moving part with their roles exchanged."""
    return Reduction(
        joints=two.joints,
        parts=two.parts[::-1],
        heads=two.heads[::-1],
        inverted=(not two.inverted[0],),
    )


def reordered(old: Reduction, order: Sequence[int]) -> Reduction:
    """The moving parts in another order, that of their joints."""
    rows = [0, *(k + 1 for k in order)]
    return Reduction(
        joints=tuple(old.joints[k] for k in order),
        parts=tuple(old.parts[row] for row in rows),
        heads=tuple(old.heads[row] for row in rows),
        inverted=tuple(old.inverted[k] for k in order),
    )


def _order(chosen: tuple[Candidate, ...]) -> tuple[tuple[bool, bool, bool], float]:
    return min(c.rank for c in chosen), sum(c.swept for c in chosen)


def candidates(
    robot: Robot, surfaces: Surfaces, spec: JointSpec, moving: Collection[str], traits: Traits
) -> list[Candidate]:
    """Joints of one kind with travel and something visible to move, best first.

    Args:
        robot: The model.
        surfaces: Of its links.
        spec: The kind and the largest travel.
        moving: Words that name the link of such a joint.
        traits: Names of the links.

    Raises:
        AssetError: None of them is sound; the reason is that of the first.
    """
    kind = spec.kind
    poses = robot.poses({})
    size = diagonal(surfaces, poses)
    unit = 1.0 if kind == "revolute" else size
    sizes = np.array([LONGEST[kind] * unit, SHORTEST[kind] * unit])
    result, reasons = [], []
    for joint in robot.movable():
        if (joint.kind == "prismatic") != (kind == "prismatic"):
            continue
        try:
            check_movable(robot.path, joint, sizes)
        except AssetError as error:
            reasons.append(error)
            continue
        area = swept(robot, surfaces, joint, poses, travel(joint, spec))
        named = words(traits.labels.get(joint.child, joint.child), joint.child, joint.name)
        rank = (bool(named & set(moving)), joint.kind != "continuous", joint.mimic is None)
        if area > 0:
            result.append(Candidate(joint=joint, rank=rank, swept=area))
    if not result and reasons:
        raise reasons[0]
    return sorted(result, key=lambda c: (c.rank, c.swept), reverse=True)


def travel(joint: Joint, spec: JointSpec) -> float:
    """Rad or asset units; revolute joints no further than the category's."""
    if joint.kind == "continuous" or joint.lower is None or joint.upper is None:
        return spec.upper
    span = joint.upper - joint.lower
    return span if joint.kind == "prismatic" else min(span, spec.upper)


def swept(
    robot: Robot,
    surfaces: Surfaces,
    joint: Joint,
    poses: Mapping[str, Float[np.ndarray, "4 4"]],
    distance: float,
) -> float:
    """Area times mean displacement of what a joint moves over a travel of `distance`."""
    total = 0.0
    child_T_root = np.linalg.inv(poses[joint.child])
    for name in robot.subtree(joint) & set(surfaces):
        child_T_link = child_T_root @ poses[name]
        for visual in surfaces[name]:
            centres = moved(visual.mesh.triangles_center, child_T_link)
            path = np.full(len(centres), distance)
            if joint.kind != "prismatic":
                path = path * np.linalg.norm(np.cross(centres, joint.axis), axis=1)
            total += float(visual.mesh.area_faces @ path)
    return total


def words(*names: str) -> set[str]:
    """Lower-case words of names in snake_case or camelCase, without digits and plural s.

    >>> sorted(words("topDoor_2", "left_legs"))
    ['door', 'left', 'leg', 'top']
    """
    found = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", " ".join(names))
    lower = {word.lower() for word in found}
    return {word[:-1] if len(word) > 3 and word.endswith("s") else word for word in lower} - {""}


def diagonal(surfaces: Surfaces, poses: Mapping[str, Float[np.ndarray, "4 4"]]) -> float:
    """Of the bounding box of all surfaces, asset units."""
    corners = np.concatenate(
        [
            moved(trimesh.bounds.corners(visual.mesh.bounds), poses[name])
            for name, visuals in surfaces.items()
            for visual in visuals
        ]
    )
    return float(np.linalg.norm(corners.max(0) - corners.min(0)))


def _partition(robot: Robot, surfaces: Surfaces, joints: tuple[Joint, ...]) -> Reduction | None:
    """Links of the base and of each moving part, or None where one has nothing to see.

    The base is the piece that every joint hangs on: of a single joint its parent's side.
    """
    cut = {joint.child for joint in joints}
    piece = {robot.root: robot.root}
    for joint in robot.joints.values():
        piece[joint.child] = joint.child if joint.child in cut else piece[joint.parent]
    ends = [(piece[joint.parent], joint.child) for joint in joints]
    shared = set(ends[0]).intersection(*ends[1:])
    if not shared:
        return None
    base = ends[0][0] if ends[0][0] in shared else ends[0][1]
    inverted = tuple(end[0] != base for end in ends)
    heads = (base, *(end[0] if flip else end[1] for end, flip in zip(ends, inverted, strict=True)))
    parts = tuple(frozenset(n for n, top in piece.items() if top == head) for head in heads)
    if not all(part & set(surfaces) for part in parts):
        return None
    return Reduction(joints=joints, parts=parts, heads=heads, inverted=inverted)


def _is_upside_down(robot: Robot, joint: Joint, category: Category, traits: Traits) -> bool:
    """Whether the names say that the root is the moving part and its child the base."""
    moving = set(category.words)
    child = words(traits.labels.get(joint.child, joint.child), joint.child)
    parent = words(traits.labels.get(joint.parent, joint.parent), joint.parent)
    at_root = not any(
        other.child == joint.parent and other.kind != "fixed" for other in robot.joints.values()
    )
    return at_root and bool(parent & moving) and not child & moving


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
    largest = max(spec.upper for spec in category.joints)  # which is whose, their order tells
    at = [joint.clamp(0.0) for joint in reduction.joints]
    result: list[Rest] = []
    for _ in range(2 if len(at) > 1 else 1):
        result = []
        for j, joint in enumerate(reduction.joints):
            profile = scene.profile(category, at, j)
            low, high = limits(joint)
            at[j] = _best(profile, joint, low, high)
            result.append(_opening(profile, at[j], low, high, largest, joint))
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
            corners = hull_points(np.concatenate(pieces))
            if len(corners) > MAX_CORNERS:  # a sphere, whose hull takes long at each position
                corners = outermost(corners)
            self.points.append(corners)
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
        return outermost(points)


def outermost(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """Those that lie farthest along some of 1024 directions, spread evenly over the sphere."""
    k = np.arange(1024) + 0.5
    z, turn = 1 - 2 * k / 1024, pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)
    return points[farthest(points, directions.T)]


def farthest(
    points: Float[np.ndarray, "N 3"], directions: Float[np.ndarray, "3 D"]
) -> Int[np.ndarray, " U"]:
    """The points that lie farthest along some direction; some directions at a time where many."""
    blocks = math.ceil(points.shape[0] * directions.shape[1] / MAX_PRODUCTS)
    found = [(points @ some).argmax(0) for some in np.array_split(directions, blocks, axis=1)]
    return np.unique(np.concatenate(found))
