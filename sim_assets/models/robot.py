# SPDX-License-Identifier: MIT
"""A URDF as plain records, and its forward kinematics: links, joints, visual shapes.

Only what a picture needs: inertias, collisions, transmissions and simulator blocks are left out.
`root_T_link` is a link's pose in the coordinates of the root link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from sim_assets.objects import joint_motion

Kind = Literal["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]
ShapeKind = Literal["mesh", "box", "cylinder", "sphere", "capsule"]
Color = tuple[float, float, float, float]
MOVABLE: tuple[Kind, ...] = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """One `<visual>`."""

    link_T_shape: Float[np.ndarray, "4 4"]
    kind: ShapeKind
    size: tuple[float, ...]
    """Mesh: scale along x, y, z. Box: sides. Cylinder, capsule: radius, length. Sphere: radius."""
    filename: str = ""
    """Of a mesh, as written."""
    color: Color | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Link:
    """A rigid body."""

    name: str
    shapes: tuple[Shape, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mimic:
    """q = multiplier * q_joint + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """How a child link hangs on its parent. Floating and planar ones are held at their origin."""

    name: str
    kind: Kind
    parent: str
    child: str
    parent_T_joint: Float[np.ndarray, "4 4"]
    """Pose of the child at position 0."""
    axis: Float[np.ndarray, " 3"]
    """Unit, in the child's frame."""
    lower: float | None = None
    """rad or asset units; None where the file gives no `<limit>`, or none that is a number."""
    upper: float | None = None
    unlimited: str = "none"
    """What the file gives in place of limits, where they are None."""
    mimic: Mimic | None = None

    def clamp(self, position: float) -> float:
        """The position within the limits, where there are any."""
        if self.kind == "continuous" or self.lower is None or self.upper is None:
            return position
        return min(max(position, self.lower), self.upper)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Robot:
    """A tree of links."""

    path: Path
    name: str
    links: dict[str, Link]
    joints: dict[str, Joint]
    """In tree order: a joint comes after the one its parent link hangs on."""
    root: str

    def movable(self) -> tuple[Joint, ...]:
        """Joints with a degree of freedom, mimics included, in tree order."""
        return tuple(joint for joint in self.joints.values() if joint.kind in MOVABLE)

    def positions(self, wanted: Mapping[str, float]) -> dict[str, float]:
        """Positions of all movable joints: those wanted, mimics by their rule, others at zero.

        A joint that is not wanted is clamped into its limits, mimics too. A wanted joint keeps
        the position given, be it a mimic.
        """
        result: dict[str, float] = {}
        for joint in self.movable():
            self._settle(joint, wanted, result)
        return result

    def _settle(self, joint: Joint, wanted: Mapping[str, float], result: dict[str, float]) -> float:
        if joint.name not in result:
            if joint.name in wanted:
                result[joint.name] = wanted[joint.name]
            elif joint.mimic is None:
                result[joint.name] = joint.clamp(0.0)
            else:
                master = self._settle(self.joints[joint.mimic.joint], wanted, result)
                mimicked = joint.mimic.multiplier * master + joint.mimic.offset
                result[joint.name] = joint.clamp(mimicked)
        return result[joint.name]

    def poses(self, wanted: Mapping[str, float]) -> dict[str, Float[np.ndarray, "4 4"]]:
        """root_T_link of every link with the joints at `positions(wanted)`."""
        at = self.positions(wanted)
        poses = {self.root: np.eye(4)}
        for joint in self.joints.values():
            pose = poses[joint.parent] @ joint.parent_T_joint
            if joint.kind in MOVABLE:
                kind = "prismatic" if joint.kind == "prismatic" else "revolute"
                pose = pose @ joint_motion(np.zeros(3), joint.axis, at[joint.name], kind)
            poses[joint.child] = pose
        return poses

    def subtree(self, joint: Joint) -> set[str]:
        """The child link of a joint and all that hangs on it."""
        names = {joint.child}
        for other in self.joints.values():
            if other.parent in names:
                names.add(other.child)
        return names


def transform(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    """A URDF origin: rotation Rz(yaw) Ry(pitch) Rx(roll), then the translation."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = xyz
    return pose
