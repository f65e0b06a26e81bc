# SPDX-License-Identifier: MIT
"""An articulated object as the renderers need it: parts at rest, joints, where it came from.

Whatever the source (procedural, PartNet-Mobility, any URDF), an object is first brought to this
form: the category's parts only, metres, object frame (z up, front towards -x, origin at the centre
of the bounding box at rest), joints whose positive state opens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float

from scapo.categories import Category


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Visual:
    """One closed or double-sided surface with its colour."""

    mesh: trimesh.Trimesh
    """Vertices in the object frame at rest, metres."""
    color: tuple[float, float, float, float] = (0.7, 0.7, 0.7, 1.0)
    """RGBA in [0, 1]; a mesh with its own texture keeps it in `mesh.visual`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Account:
    """What a reader decided about a model, for its user to see."""

    joints: tuple[str, ...]
    """Per joint of the category: the model's joint, and what it moves, in the model's words."""
    size: str
    """Sides of the box at rest, and how its scale was chosen."""
    names: tuple[str, ...]
    """What the model's links are called, by its semantics where it has them."""
    speaks: bool
    """Whether one of its names speaks of the category."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Origin:
    """Where an object came from (the manifest's instance record, docs/data-format.md)."""

    source: str
    """Path relative to the source folder, or the generator and its seed."""
    sha256: str
    """Of its files, or of the generated parameters."""
    object_T_asset: Float[np.ndarray, "4 4"]
    """Similarity from the URDF root link at rest to the object frame."""
    rest: dict[str, float]
    """URDF joint name -> position at rest."""
    joint_names: tuple[str, ...]
    """The URDF joint of each category joint."""
    sign: tuple[float, ...]
    """state = sign * (q - rest)."""
    repairs: tuple[str, ...] = ()
    """What the reader put right, one sentence each."""
    account: Account | None = None
    """Of a model that was read."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArticulatedObject:
    """Parts, joints and origin of one instance; everything in the object frame at rest."""

    category: Category
    instance: str
    visuals: tuple[tuple[Visual, ...], ...]
    """Per part, at least one each."""
    pivot: Float[np.ndarray, "J 3"]
    """A point on each axis, m. Prismatic: the centre of the moving part's box."""
    axis: Float[np.ndarray, "J 3"]
    """Unit; revolute by the right-hand rule, so that a state > 0 opens."""
    upper: Float[np.ndarray, " J"]
    """Travel: the state runs from 0 to here, rad or m."""
    origin: Origin
    trait: str = ""
    """What sets it apart from the training shapes (`test-ood`); empty where nothing does."""

    def pose(self, state: Float[np.ndarray, " J"]) -> Float[np.ndarray, "P 4 4"]:
        """object_T_part of every part: its parent's pose followed by the joint's motion."""
        poses = np.tile(np.eye(4), (len(self.visuals), 1, 1))
        for j, joint in enumerate(self.category.joints):
            motion = joint_motion(self.pivot[j], self.axis[j], float(state[j]), joint.kind)
            poses[joint.child] = poses[joint.parent] @ motion
        return poses

    def part_mesh(self, part: int) -> trimesh.Trimesh:
        """All surfaces of a part as one mesh (geometry only), object frame at rest."""
        pieces = [visual.mesh for visual in self.visuals[part]]
        vertices = np.concatenate([piece.vertices for piece in pieces])
        offsets = np.cumsum([0] + [len(piece.vertices) for piece in pieces[:-1]])
        faces = np.concatenate(
            [piece.faces + offset for piece, offset in zip(pieces, offsets, strict=True)]
        )
        return trimesh.Trimesh(vertices, faces, process=False)

    def extents(self) -> Float[np.ndarray, " 3"]:
        """Sides of the bounding box at rest, m."""
        points = np.concatenate([v.mesh.bounds for part in self.visuals for v in part])
        return points.max(0) - points.min(0)


def joint_motion(
    pivot: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"], state: float, kind: str
) -> Float[np.ndarray, "4 4"]:
    """`scapo.geometry.rigid.joint_motion` for one joint in float64 numpy."""
    motion = np.eye(4)
    if kind == "prismatic":
        motion[:3, 3] = axis * state
        return motion
    # Rodrigues' formula on plain floats, many times faster here than on arrays of three.
    x, y, z = axis.tolist()
    c, s = math.cos(state), math.sin(state)
    k = 1 - c
    motion[:3, :3] = (
        (c + k * x * x, k * x * y - s * z, k * x * z + s * y),
        (k * x * y + s * z, c + k * y * y, k * y * z - s * x),
        (k * x * z - s * y, k * y * z + s * x, c + k * z * z),
    )
    motion[:3, 3] = pivot - motion[:3, :3] @ pivot
    return motion
