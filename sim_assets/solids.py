# SPDX-License-Identifier: MIT
"""URDF primitives as fine closed meshes: SAPIEN's own are off by millimetres (RENDERING 2)."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from sim_assets.robot import ShapeKind

SAGITTA = 5e-5
"""Largest distance of the mesh from the true surface, relative to the radius."""


def solid(kind: ShapeKind, size: tuple[float, ...]) -> trimesh.Trimesh:
    """A box, cylinder, sphere or capsule about the origin, axis z, as URDF defines them.

    Args:
        kind: Not "mesh".
        size: As in `Shape.size`.
    """
    if kind == "box":
        return trimesh.creation.box(extents=size)
    if kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=5, radius=size[0])
    sections = math.ceil(math.pi / math.acos(1 - SAGITTA) / 4) * 4
    radius, length = size
    if kind == "cylinder":
        return trimesh.creation.cylinder(radius=radius, height=length, sections=sections)
    # trimesh sets a capsule's lower centre on the origin in some versions: built by revolution.
    turn = np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 2)
    outline = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    half = len(outline) // 2
    outline[:half, 1] -= length / 2
    outline[half:, 1] += length / 2
    outline[[0, -1], 0] = 0.0
    return trimesh.creation.revolve(outline, sections=sections)
