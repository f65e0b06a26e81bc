# SPDX-License-Identifier: MIT
"""How deep the parts of an object reach into one another, in any state.

A point is inside a part if one of the part's closed surfaces winds about it, which holds for
surfaces made of several overlapping shells too; its depth is its distance from that surface.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.triangles import closest_point

from sim_assets.objects import ArticulatedObject

_CHUNK = 2_000_000
"""Point-triangle pairs handled at once."""
_GENERIC = trimesh.transformations.euler_matrix(0.7371, 0.4219, 1.2377)[:3, :3]
"""A rotation whose third row is parallel to nothing that is built."""


def winding_number(
    points: Float[np.ndarray, "N 3"], mesh: trimesh.Trimesh
) -> Float[np.ndarray, " N"]:
    """Turns of the closed surface about each point: 1 inside, 0 outside.

    Counted as the surface's signed crossings with a ray from the point, in one direction that no
    edge of a built shape is parallel to.
    """
    corners = np.asarray(mesh.triangles) @ _GENERIC.T  # (F, 3, 3), the ray along its z
    points = points @ _GENERIC.T
    a, b, c = (corners[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros(len(points))
    step = max(1, _CHUNK // len(corners))
    for start in range(0, len(points), step):
        p = points[start : start + step, None]
        sides = [
            (v[:, 0] - u[:, 0]) * (p[..., 1] - u[:, 1])
            - (v[:, 1] - u[:, 1]) * (p[..., 0] - u[:, 0])
            for u, v in ((a, b), (b, c), (c, a))
        ]
        facing = np.sign(normal[:, 2])
        covered = np.logical_and.reduce([side * facing > 0 for side in sides])
        which, face = np.nonzero(covered)
        above = ((a[face] - p[which, 0]) * normal[face]).sum(-1) * facing[face] > 0
        np.add.at(total, start + which[above], facing[face[above]])
    return total


def depth_inside(points: Float[np.ndarray, "N 3"], mesh: trimesh.Trimesh, ignore: float) -> float:
    """Greatest distance of an inner point from the surface; 0 if none is deeper than `ignore`."""
    low, high = mesh.bounds + np.array([[ignore], [-ignore]])
    points = points[((points > low) & (points < high)).all(1)]
    points = points[winding_number(points, mesh) > 0.5]
    corners = np.asarray(mesh.triangles)
    deepest = 0.0
    for point in points:
        nearest = closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
        deepest = max(deepest, float(np.linalg.norm(nearest - point, axis=1).min()))
    return deepest if deepest > ignore else 0.0


def probes(mesh: trimesh.Trimesh, count: int) -> Float[np.ndarray, "N 3"]:
    """Points to test: vertices, middles of edges, and `count` points spread over the area."""
    corners = np.asarray(mesh.triangles)
    middles = np.asarray(mesh.vertices)[mesh.edges_unique].mean(1)
    rng = np.random.Generator(np.random.PCG64(0))
    areas = np.maximum(mesh.area_faces, 1e-15)
    chosen = rng.choice(len(corners), count, p=areas / areas.sum())
    weights = rng.dirichlet(np.ones(3), count)
    spread = np.einsum("nk,nkd->nd", weights, corners[chosen])
    return np.concatenate([np.asarray(mesh.vertices), middles, spread])


def penetration(
    obj: ArticulatedObject,
    states: Iterable[Float[np.ndarray, " J"]],
    *,
    ignore: float = 1e-3,
    count: int = 2000,
) -> float:
    """Greatest depth in metres to which one part reaches into another in any of the states.

    Args:
        obj: The object.
        states: Joint states to try.
        ignore: Contacts no deeper than this count as none.
        count: Surface points per part beside its vertices and edge middles.
    """
    points = [probes(obj.part_mesh(part), count) for part in range(len(obj.visuals))]
    deepest = 0.0
    for state in states:
        poses = obj.pose(np.asarray(state, float))
        for a, b in permutations(range(len(obj.visuals)), 2):
            b_T_a = np.linalg.inv(poses[b]) @ poses[a]
            moved = points[a] @ b_T_a[:3, :3].T + b_T_a[:3, 3]
            depths = (depth_inside(moved, visual.mesh, ignore) for visual in obj.visuals[b])
            deepest = max(deepest, *depths)
    return deepest


def spread_states(obj: ArticulatedObject, count: int) -> Float[np.ndarray, "K J"]:
    """States over the whole travel of every joint: a grid with `count` steps per joint."""
    axes = [np.linspace(0.0, upper, count) for upper in obj.upper]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))
