# SPDX-License-Identifier: MIT
"""Level sets of sampled functions by marching tetrahedra (A. Doi, A. Koide, 1991).

Cells are cut into the six tetrahedra of H. Freudenthal, whose faces agree with those of the next
cell; a level set in tetrahedra that fill space is closed and no edge has more than two faces,
whatever the values. `manifold3d` has a level set too, but the one of 3.5.4 ends the process where
its first table is too small for the surface, as for a large thin plate.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from jaxtyping import Float, Int


def level_set(
    values: Float[np.ndarray, "X Y Z"],
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices in cells and faces about what is above 0, counter-clockwise from outside.

    Args:
        values: At the nodes; at those of the rim 0 or less, or the surface is open there.
    """
    flat = values.ravel()
    corners = _tetrahedra(values)
    inside = flat[corners] > 0
    case = inside @ (1 << np.arange(4))
    edges = [corners[case == k][:, triangles] for k, triangles in enumerate(CASES) if triangles]
    ends = np.sort(np.concatenate([e.reshape(-1, 2) for e in edges] or [np.zeros((0, 2), int)]))
    ends, faces = np.unique(ends, axis=0, return_inverse=True)
    a, b = flat[ends].T
    places = np.stack(np.unravel_index(ends, values.shape), -1).astype(float)
    share = (a / (a - b))[:, None]
    return places[:, 0] + share * (places[:, 1] - places[:, 0]), faces.reshape(-1, 3)


def _tetrahedra(values: Float[np.ndarray, "X Y Z"]) -> Int[np.ndarray, "T 4"]:
    """Nodes of the tetrahedra that lie in cells with both signs, right-handed."""
    steps = np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
    nodes = np.arange(values.size).reshape(values.shape)
    cells = nodes[:-1, :-1, :-1].ravel()
    above = (values > 0).ravel()
    count = sum(above[cells + np.dot(bits, steps)].astype(int) for bits in np.ndindex(2, 2, 2))
    cells = cells[(count > 0) & (count < 8)]
    found = []
    for order in permutations(range(3)):
        path = np.cumsum([0, *steps[list(order)]])
        path = path if _even(order) else path[[0, 1, 3, 2]]
        found.append(cells[:, None] + path)
    return np.concatenate(found)


def _even(order: tuple[int, ...]) -> bool:
    return bool(np.linalg.det(np.eye(len(order))[list(order)]) > 0)


def _triangles(case: int) -> list[list[tuple[int, int]]]:
    """Corners as edges, each by its two ends, of a right-handed tetrahedron's triangles.

    Args:
        case: A bit for each end that is inside.
    """
    inside = [k for k in range(4) if case >> k & 1]
    outside = [k for k in range(4) if not case >> k & 1]
    if not inside or not outside:
        return []
    if len(inside) == 3:  # as its opposite, turned
        return [triangle[::-1] for triangle in _triangles(15 - case)]
    if not _even((*inside, *outside)):
        outside[:2] = outside[1::-1]
    i, j, k, m = *inside, *outside
    if len(inside) == 1:
        return [[(i, j), (i, k), (i, m)]]
    return [[(i, k), (i, m), (j, m)], [(i, k), (j, m), (j, k)]]


CASES = tuple(_triangles(case) for case in range(16))
