# SPDX-License-Identifier: MIT
"""One pull against what statics says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_assets.actuation.grasp import path_of

pytest.importorskip("sapien")
from sim_assets.actuation.pull import FRICTION, GRIP, STIFFNESS, Body, Pulled, body_of, pull
from tests.helpers.boxes import laptop

Z = np.array([0.0, 0.0, 1.0])
DOOR = Body(
    kind="revolute",
    pivot=np.zeros(3),
    axis=Z,
    upper=1.5,
    size=2.0,
    grasp=np.array([0.5, 0.0, 0.0]),
    mass=3.0,
    centre=np.array([0.25, 0.0, 0.0]),
    moments=np.array([0.02, 0.06, 0.07]),
)
DRAWER = replace(DOOR, kind="prismatic", axis=np.array([-1.0, 0.0, 0.0]), upper=0.3)


def pulled(body: Body, pivot: np.ndarray, axis: np.ndarray, state: float = 0.3) -> Pulled:
    own = body.path()
    wanted = path_of(body.kind, pivot, axis, own.at(state)).towards(own.tangent(state))
    return pull(body, state, wanted, body.upper - state, opening=True)


@pytest.mark.parametrize("body", [DOOR, DRAWER])
def test_along_the_true_path_a_joint_follows_up_to_what_friction_holds_back(body):
    state = 0.2 * body.upper
    found = pulled(body, body.pivot, body.axis, state)
    lag = FRICTION / STIFFNESS / body.path().lever()
    assert 0.8 * body.upper - 1.5 * lag <= found.moved <= 0.8 * body.upper
    assert found.peak < 0.02 * GRIP
    assert not found.slipped


def test_it_can_be_closed_as_well():
    own = DOOR.path()
    wanted = path_of("revolute", DOOR.pivot, Z, own.at(1.2)).towards(-own.tangent(1.2))
    found = pull(DOOR, 1.2, wanted, 1.2, opening=False)
    assert 1.17 < found.moved <= 1.2 + 1e-6


def test_force_across_the_path_is_the_distance_of_the_two_paths_times_the_stiffness():
    shift = 0.02
    found = pulled(DOOR, np.array([0.0, -shift, 0.0]), Z, state=0.0)
    wanted = path_of("revolute", np.array([0.0, -shift, 0.0]), Z, DOOR.grasp)
    apart = [abs(np.linalg.norm(wanted.at(x)) - 0.5) for x in np.linspace(0, DOOR.upper, 100)]
    assert found.peak == pytest.approx(STIFFNESS * max(apart), rel=0.05)
    assert found.moved > 1.4


def test_across_the_true_path_nothing_moves_and_the_hand_slips_off():
    for body in (DOOR, DRAWER):
        found = pulled(body, body.pivot, np.array([0.0, 1.0, 0.0]), 0.0)
        assert found.moved < 0.02
        assert found.slipped == (body is DOOR) or found.peak < GRIP * 1.1


def test_an_axis_through_the_grasp_moves_nothing():
    found = pulled(DOOR, DOOR.path().at(0.3), Z)
    assert found.moved < 1e-3
    assert not found.slipped


def test_the_same_pull_gives_the_same_numbers():
    assert pulled(DOOR, np.array([0.01, 0.02, 0.0]), Z) == pulled(
        DOOR, np.array([0.01, 0.02, 0.0]), Z
    )


def test_an_object_is_scaled_to_a_diagonal_of_one():
    thing = laptop("a")
    body = body_of(thing, 0)
    assert body.size == pytest.approx(np.linalg.norm(thing.extents()))
    assert np.allclose(body.pivot * body.size, thing.pivot[0])
    assert body.upper == thing.upper[0]
    assert body.path().lever() < 1
