# SPDX-License-Identifier: MIT
"""Small articulated objects of boxes, whose pictures and poses can be computed by hand."""

from __future__ import annotations

import numpy as np
import trimesh

from scapo.categories import category
from sim_assets.objects import ArticulatedObject, Origin, Visual


def box(extents: tuple[float, float, float], centre: tuple[float, float, float]) -> Visual:
    return Visual(mesh=trimesh.creation.box(extents).apply_translation(centre))


def origin(name: str) -> Origin:
    return Origin(
        source=name,
        sha256="0" * 64,
        object_T_asset=np.eye(4),
        rest={"hinge": 0.0},
        joint_names=("hinge",),
        sign=(1.0,),
    )


def laptop(
    name: str = "two boxes", width: float = 0.36, depth: float = 0.25, thickness: float = 0.02
) -> ArticulatedObject:
    """A base and a screen on it, hinged at the back (+x); opening lifts the front edge (-x)."""
    base = box((depth, width, thickness), (0, 0, -thickness / 2))
    screen = box((depth, width, thickness), (0, 0, thickness / 2))
    return ArticulatedObject(
        category=category("laptop"),
        instance=name,
        visuals=((base,), (screen,)),
        pivot=np.array([[depth / 2, 0.0, 0.0]]),
        axis=np.array([[0.0, 1.0, 0.0]]),
        upper=np.array([np.radians(130)]),
        origin=origin(name),
    )


def above(distance: float) -> np.ndarray:
    """camera_T_object above the origin: x to the object's -y, y to -x, z down."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    pose[2, 3] = distance
    return pose
