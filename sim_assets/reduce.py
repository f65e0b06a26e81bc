# SPDX-License-Identifier: MIT
"""From a model with any joints to its category's joints and parts (CONTRACT 1).

The rule: of the joints of the right kind with real travel, those whose link is named as the
category's moving part (`Category.words`; by the source's semantics, else by link and joint names)
go before the others, limited ones before continuous ones, those that do not mimic before those
that do; within a class the largest swept surface wins. Swept surface: the sum over the triangles
that the joint moves of area times the length of the centre's path over the travel, that is the
area times its mean displacement. All other joints stay at rest, and their links belong to the
part they hang on.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from math import pi, radians

import numpy as np
import trimesh
from jaxtyping import Float

from scapo.types import Category, JointSpec
from sim_assets.articulated import Visual
from sim_assets.robot import Joint, Robot
from sim_assets.sources import Traits
from sim_assets.validate import AssetError, check_movable, kinds, refuse

LONGEST = {"revolute": 4 * pi, "prismatic": 3.0}
"""rad; asset diagonals."""
SHORTEST = {"revolute": radians(5.0), "prismatic": 0.01}
"""rad; asset diagonals. Knobs and buttons travel less."""
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


def reordered(three: Reduction) -> Reduction:
    """A base and two moving parts with the latter exchanged."""
    base = three.parts[:1], three.heads[:1]
    return Reduction(
        joints=three.joints[::-1],
        parts=base[0] + three.parts[:0:-1],
        heads=base[1] + three.heads[:0:-1],
        inverted=three.inverted[::-1],
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


def moved(
    points: Float[np.ndarray, "N 3"], a_T_b: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "N 3"]:
    """Coordinates in a of points in b."""
    return points @ a_T_b[:3, :3].T + a_T_b[:3, 3]


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
