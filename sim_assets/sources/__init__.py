# SPDX-License-Identifier: MIT
"""What is known of a model by the set it comes from: frame, size, names. One file per set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sim_assets.robot import Robot


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """What a set says of its models beyond the URDF. Directions are of the URDF root link."""

    set_name: str
    up: str = "z"
    front: str | None = None
    """None: to be told from the joint."""
    metric: bool = True
    """Whether lengths are metres; else the category's nominal diagonal gives the scale."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Link name -> what it is, in words."""
    remark: str = ""
    """Added to the reason when no joint fits."""
    files: tuple[Path, ...] = ()
    """Files beside the URDF that were read."""


def traits(robot: Robot) -> Traits:
    """By the first set that knows the model as its own; any URDF is generic."""
    from sim_assets.sources import hoi4d, partnet_mobility, shape2motion, urdf

    imported = shape2motion.traits(robot) or hoi4d.traits(robot)
    return imported or partnet_mobility.traits(robot) or urdf.traits(robot)
