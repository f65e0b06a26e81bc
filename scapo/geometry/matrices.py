# SPDX-License-Identifier: MIT
"""Rigid motions by numpy alone: of points, and whether matrices from outside are any."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

MIRRORED = 2.0
"""What `rotation_error` says of a mirror, as far from any rotation as an orthogonal matrix is."""


def moved(
    points: Float[np.ndarray, "*N 3"], a_T_b: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "*N 3"]:
    """Coordinates in a of points in b."""
    return points @ a_T_b[:3, :3].T + a_T_b[:3, 3]


def rotation_error(matrix: Float[np.ndarray, "*B 3 3"]) -> Float[np.ndarray, "*B"]:
    """The largest entry of |R R^T - I|; MIRRORED where det R is not positive.

    Infinite where an entry is not finite.
    """
    finite = np.asarray(np.isfinite(matrix).all((-1, -2)))
    matrix = np.where(finite[..., None, None], matrix, np.eye(3)).astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        gap = np.abs(matrix @ matrix.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
        proper = np.linalg.det(matrix) > 0
    return np.where(finite, np.where(proper, gap, MIRRORED), np.inf)


def is_rigid(a_T_b: Float[np.ndarray, "*B 4 4"], tolerance: float = 1e-3) -> Bool[np.ndarray, "*B"]:
    """Whether the last row is 0 0 0 1 and the rest a rotation and a finite translation.

    >>> bool(is_rigid(np.eye(4))), bool(is_rigid(2 * np.eye(4)))
    (True, False)
    """
    last = (abs(a_T_b[..., 3, :] - np.array([0, 0, 0, 1])) < tolerance).all(-1)
    finite = np.isfinite(a_T_b[..., :3, 3]).all(-1)
    return np.asarray(last & finite & (rotation_error(a_T_b[..., :3, :3]) < tolerance))
