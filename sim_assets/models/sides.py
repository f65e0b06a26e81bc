# SPDX-License-Identifier: MIT
"""Surfaces that look the same from both sides, for renderers that draw front faces only.

SAPIEN culls back faces: a panel seen from behind gives no depth, a mirrored mesh shows its inside.
Closed shells with one winding stay (turned outward where needed); every other face gets its
reverse beside it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def two_sided(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "G 3"]:
    """Faces over the same vertices of which each point of the surface has one towards any viewer.

    Faces without area are left out. Vertices at the same place count as one.

    Args:
        vertices: Any unit.
        faces: Vertex indices.

    Returns:
        The faces kept, outward ones of closed shells first turned, then the reverses added.
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces = faces[np.abs(cross).max(1) > 0]
    welded = _weld(vertices)[faces]
    distinct = (welded != np.roll(welded, 1, axis=1)).all(1)
    faces, welded = faces[distinct], welded[distinct]
    shell, closed = _shells(welded)
    volumes = np.einsum("ij,ij->i", vertices[faces[:, 0]], np.cross(*_sides(vertices, faces)))
    volume = np.bincount(shell, volumes)
    least = -np.bincount(shell, np.abs(volumes)) * 1e-9  # a panel's two faces enclose nothing
    inward = (closed & (volume < least))[shell]
    faces = np.where(inward[:, None], faces[:, ::-1], faces)
    reverse = _without_reverse(welded) & ~closed[shell]
    return np.concatenate([faces, faces[reverse][:, ::-1]])


def _sides(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "F 3"], Float[np.ndarray, "F 3"]]:
    return vertices[faces[:, 1]], vertices[faces[:, 2]]


def _weld(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """One number per place: vertices that agree to a millionth of the size are one."""
    size = float(np.ptp(vertices, axis=0).max()) or 1.0
    places = np.round(vertices / (size * 1e-6)).astype(np.int64)
    return number_rows(places)


def used_vertices(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " U"]:
    """The indices that faces name, in order: `np.unique` in a fraction of its time."""
    used = np.zeros(int(faces.max()) + 1 if len(faces) else 0, bool)
    used[faces] = True
    return np.flatnonzero(used)


def number_rows(rows: Int[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """The place of each row among the different ones, in order.

    As `np.unique(rows, axis=0, return_inverse=True)[1]`, in a tenth of the time.

    >>> number_rows(np.array([[2, 0, 1], [-1, 5, 5], [2, 0, 1]])).tolist()
    [1, 0, 1]
    """
    if not len(rows):
        return np.zeros(0, np.int64)
    x, y, z = (column - column.min() for column in rows.T)
    if max(x.max(), y.max(), z.max()) < 1 << 21:  # one number of 63 bits, in the same order
        return np.unique((x << 42) | (y << 21) | z, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((z, y, x))
    ordered = rows[order]
    starts = np.concatenate([[False], (ordered[1:] != ordered[:-1]).any(1)])
    result = np.zeros(len(rows), np.int64)
    result[order] = np.cumsum(starts)
    return result


def _shells(
    faces: Int[np.ndarray, "F 3"],
) -> tuple[Int[np.ndarray, " F"], Bool[np.ndarray, " S"]]:
    """The shell of each face, and whether each shell is closed.

    Faces are joined over edges that two of them share: shells that only touch along an edge stay
    apart. Closed: the shell runs through each of its edges as often one way as the other.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    many = int(faces.max()) + 1 if len(faces) else 1
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, edge, uses = np.unique(low * many + high, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    joins = uses[edge] == 2
    links = coo_array(
        (np.ones(joins.sum()), (owner[joins], len(faces) + edge[joins])),
        shape=(len(faces) + len(uses),) * 2,
    )
    label = connected_components(links, directed=False)[1][: len(faces)]
    names, shell = np.unique(label, return_inverse=True)
    shell = shell.reshape(-1)
    place = np.unique(shell[owner] * len(uses) + edge, return_inverse=True)
    balance = np.bincount(place[1].reshape(-1), np.where(start < end, 1.0, -1.0))
    broken = np.bincount(place[0] // max(len(uses), 1), balance != 0, minlength=len(names))
    return shell, broken == 0


def fronts_and_backs(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    second: Bool[np.ndarray, " F"],
) -> tuple[Int[np.ndarray, " F"], Int[np.ndarray, " F"]]:
    """The face that a viewer in front of each face sees there, and that one behind it sees.

    Models have panels with one material in front and another at the back, and the same triangle in
    two files; which of several at one place is meant to be seen is then a matter of the side, of
    those that were in a file before those that only are the reverse of one, and of their order.

    Args:
        vertices: Any unit.
        faces: Vertex indices.
        second: Faces that give way to others.

    Returns:
        Two faces each; the second is -1 where none looks that way.
    """
    forward, backward = _wound(_weld(vertices)[faces])
    front, back = number_rows(np.concatenate([forward, backward])).reshape(2, -1)
    worst_first = np.lexsort((np.arange(len(faces)), second))[::-1]
    best = np.full(2 * len(faces), -1)
    best[front[worst_first]] = worst_first
    return best[front], best[back]


def are_added_reverses(faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    """Faces of one mesh whose reverse, over the same vertices, comes before them."""
    forward, backward = _wound(faces)
    front, back = number_rows(np.concatenate([forward, backward])).reshape(2, -1)
    first = np.full(2 * len(faces), len(faces))
    np.minimum.at(first, front, np.arange(len(faces)))
    return first[back] < np.arange(len(faces))


def _without_reverse(faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    """Faces whose mirror twin (the same corners run the other way) is not in the mesh."""
    if len(faces) == 0:
        return np.zeros(0, bool)
    group = number_rows(np.concatenate(_wound(faces)))
    return ~np.isin(group[len(faces) :], group[: len(faces)])


def _wound(
    faces: Int[np.ndarray, "F 3"],
) -> tuple[Int[np.ndarray, "F 3"], Int[np.ndarray, "F 3"]]:
    """Each face and its reverse, both from the lowest corner on."""
    turn = faces.argmin(1)
    first = np.take_along_axis(faces, turn[:, None], 1)
    second = np.take_along_axis(faces, (turn[:, None] + 1) % 3, 1)
    third = np.take_along_axis(faces, (turn[:, None] + 2) % 3, 1)
    return (
        np.concatenate([first, second, third], 1),
        np.concatenate([first, third, second], 1),
    )
