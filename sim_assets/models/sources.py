# SPDX-License-Identifier: MIT
"""What is known of a model by the set it comes from: frame, size, names."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import pi
from pathlib import Path

import numpy as np

from scapo.store.regular import read_regular
from sim_assets.models.robot import Robot, transform

MAX_BYTES = 4 << 20
IMPORTED = ("hoi4d", "shape2motion")
"""Sets whose models `scapo-data import` writes as URDFs, whose robots it names after the set."""

GENERIC = "urdf"
"""Any other model."""


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
    """By the first set that knows the model as its own; any URDF is generic.

    Imported models are not in metres. PartNet-Mobility (`mobility.urdf`, `semantics.txt`,
    `mobility_v2.json` in a numbered folder): after the fixed joint on its empty `base` link z is
    up and the front faces -x; lengths are normalised. Any other URDF: metres and z up by REP 103.
    """
    own_names = {name: name for name in robot.links}
    for name in IMPORTED:
        if robot.name.startswith(f"{name}_"):
            return Traits(set_name=name, metric=False, labels=own_names)
    return _partnet(robot) or Traits(set_name=GENERIC, labels=own_names)


def _partnet(robot: Robot) -> Traits | None:
    """Of a PartNet-Mobility model, else None."""
    folder = robot.path.parent
    semantics = folder / "semantics.txt"
    if not _is_ours(robot):
        return None
    labels, files = _semantics(semantics)
    return Traits(
        set_name="partnet-mobility",
        front="-x",
        metric=False,
        labels={name: labels.get(name, name) for name in robot.links},
        remark=_remark(folder / "mobility_v2.json"),
        files=files,
    )


def _is_ours(robot: Robot) -> bool:
    """By the robot's name, or an empty root `base` with the set's files or its fixed joint."""
    if robot.name.startswith("partnet_"):
        return True
    if robot.root != "base" or robot.links["base"].shapes:
        return False
    if any((robot.path.parent / name).is_file() for name in ("semantics.txt", "mobility_v2.json")):
        return True
    first = [joint for joint in robot.joints.values() if joint.parent == "base"]
    turn = transform((0.0, 0.0, 0.0), (pi / 2, 0.0, -pi / 2))
    return len(first) == 1 and np.allclose(first[0].parent_T_joint, turn, atol=1e-6)


def _semantics(path: Path) -> tuple[dict[str, str], tuple[Path, ...]]:
    """Lines of link, joint kind and meaning, such as `link_0 hinge door`."""
    text = _text(path)
    if text is None:
        return {}, ()
    rows = [line.split(maxsplit=2) for line in text.splitlines()]
    return {row[0]: row[2] for row in rows if len(row) == 3}, (path,)


def _remark(path: Path) -> str:
    """How many joints `mobility_v2.json` lists, for models whose URDF has fixed them."""
    try:
        entries = json.loads(_text(path) or "[]")
        kinds = [entry["joint"] for entry in entries if entry["joint"] in ("hinge", "slider")]
    except (ValueError, TypeError, KeyError, RecursionError):
        return ""
    return f"; mobility_v2.json lists {', '.join(kinds)}" if kinds else ""


def _text(path: Path) -> str | None:
    try:
        return read_regular(path, MAX_BYTES).decode(errors="replace")
    except OSError:
        return None
