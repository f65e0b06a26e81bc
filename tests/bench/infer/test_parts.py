# SPDX-License-Identifier: MIT
"""Children are the base moved by their joints."""

from __future__ import annotations

import numpy as np

from bench.infer.parts import Parts
from scapo.categories import CATEGORIES


def test_a_door_swings_about_its_hinge_and_a_drawer_slides_along_its_axis():
    base = np.eye(4)
    base[:3, 3] = [0.1, 0.2, 0.3]
    given = {"camera_T_base": base, "pivot": np.array([[1.0, 0, 0]]),
             "axis": np.array([[0.0, 0, 1]]), "limits": None}  # fmt: skip
    door = Parts.of(CATEGORIES["oven"], state=np.array([np.pi / 2]), **given)
    np.testing.assert_allclose(door.camera_T_part[0], base)
    # About the vertical through (1, 0): (0.1, 0.2) is (-0.9, 0.2) from it, turned (-0.2, -0.9).
    np.testing.assert_allclose(door.camera_T_part[1, :3, 3], [0.8, -0.9, 0.3], atol=1e-12)
    np.testing.assert_allclose(door.camera_T_part[1, :2, 0], [0, 1], atol=1e-12)
    drawer = Parts.of(CATEGORIES["drawer"], state=np.array([0.25]), **given)
    np.testing.assert_allclose(drawer.camera_T_part[1, :3, 3], [0.1, 0.2, 0.55])
