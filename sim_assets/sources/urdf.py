# SPDX-License-Identifier: MIT
"""Any URDF: metres and z up by REP 103; the front is told from the joint."""

from __future__ import annotations

from sim_assets.robot import Robot
from sim_assets.sources import Traits


def traits(robot: Robot) -> Traits:
    """Links are known by their own names alone."""
    return Traits(set_name="urdf", labels={name: name for name in robot.links})
