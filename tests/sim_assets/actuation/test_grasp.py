# SPDX-License-Identifier: MIT
"""Where a part is held, on boxes; paths against the joint's own motion."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sim_assets.actuation.grasp import grasp_point, path_of
from sim_assets.objects import joint_motion


def test_a_door_is_held_in_the_middle_of_its_free_side():
    door = trimesh.creation.box((0.02, 0.6, 0.8))
    door.apply_translation((-0.3, 0.0, 0.1))  # the hinge is upright, at y = 0.3
    point = grasp_point(door, "revolute", np.array([-0.29, 0.3, 5.0]), np.array([0.0, 0.0, 1.0]))
    assert np.abs(point - [-0.3, -0.3, 0.1]).max() < 0.06


def test_a_drawer_is_held_in_the_middle_of_its_front():
    drawer = trimesh.creation.box((0.5, 0.4, 0.2))
    point = grasp_point(drawer, "prismatic", np.zeros(3), np.array([-1.0, 0.0, 0.0]))
    assert np.abs(point - [-0.25, 0.0, 0.0]).max() < 0.05
    again = grasp_point(drawer, "prismatic", np.ones(3), np.array([-1.0, 0.0, 0.0]))
    assert np.array_equal(point, again)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_path_is_where_the_joint_carries_the_point(kind):
    rng = np.random.default_rng(3)
    pivot, axis, start = rng.normal(size=(3, 3))
    unit = axis / np.linalg.norm(axis)
    path = path_of(kind, pivot, axis, start)
    for state in (-0.7, 0.0, 0.4, 2.0):
        motion = joint_motion(pivot, unit, state, kind)
        assert np.allclose(path.at(state), motion[:3, :3] @ start + motion[:3, 3])
        ahead = (path.at(state + 1e-6) - path.at(state - 1e-6)) / 2e-6
        assert np.allclose(path.tangent(state), ahead, atol=1e-6)
    assert np.isclose(path.lever(), np.linalg.norm(path.tangent(0.0)))


def test_of_the_two_ways_along_a_path_the_wanted_one_is_taken():
    path = path_of("revolute", np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    back = path.towards(np.array([0.0, -1.0, 0.0]))
    assert np.allclose(back.at(0.5), path.at(-0.5))
    assert path.towards(np.array([0.0, 1.0, 0.0])) is path
