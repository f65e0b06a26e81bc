# SPDX-License-Identifier: MIT
"""Rotations pass, what is none is refused, by how far it is from one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from scapo.geometry.matrices import is_rigid, rotation_error

TURNS = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()


def test_the_error_is_that_of_the_product() -> None:
    assert (rotation_error(TURNS) < 1e-12).all()
    np.testing.assert_allclose(rotation_error(1.01 * TURNS), 1.01**2 - 1, rtol=1e-9)
    assert rotation_error(-TURNS).tolist() == [2.0] * 5
    assert rotation_error(np.full((3, 3), np.nan)) == np.inf
    assert rotation_error(np.zeros((0, 3, 3))).shape == (0,)
    assert rotation_error(np.full((3, 3), 1e38, np.float32)) > 1


@pytest.mark.parametrize(
    ("row", "column", "value"), [(3, 0, 0.01), (3, 3, 2.0), (0, 3, np.inf), (0, 0, np.nan)]
)
def test_a_rigid_motion_needs_every_entry(row: int, column: int, value: float) -> None:
    good = RigidTransform.from_components([1.0, 2.0, 3.0], Rotation.from_rotvec([0.1, 2, 0.3]))
    matrix = good.as_matrix()
    assert is_rigid(matrix)
    matrix[row, column] = value
    assert not is_rigid(matrix)
