# SPDX-License-Identifier: MIT
"""PartNet-Mobility: `mobility.urdf`, `semantics.txt`, `mobility_v2.json` in a numbered folder.

After the fixed joint on its empty `base` link z is up and the front faces -x; lengths are
normalised, not metres (RENDERING 8).
"""

from __future__ import annotations

import json
from math import pi
from pathlib import Path

import numpy as np

from sim_assets.robot import Robot, transform
from sim_assets.sources import Traits

MAX_BYTES = 4 << 20


def traits(robot: Robot) -> Traits | None:
    """Of a model of this set, else None."""
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
        if path.stat().st_size > MAX_BYTES:
            return None
        return path.read_text(errors="replace")
    except OSError:
        return None
