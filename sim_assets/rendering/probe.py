# SPDX-License-Identifier: MIT
"""Does a renderer draw here? A cube, whose depth and part in the picture's centre are known.

`python -m sim_assets.rendering.probe BACKEND` prints the device as JSON, or fails with the reason
as the last line; `doctor` runs it so, because SAPIEN can end the process with a broken driver.
"""

from __future__ import annotations

import json
import sys
from importlib import metadata
from typing import get_args

import numpy as np
import trimesh

from scapo.categories import Category, Window
from scapo.geometry.camera import Intrinsics
from sim_assets.objects import ArticulatedObject, Origin, Visual
from sim_assets.rendering.backends import make_renderer
from sim_assets.rendering.base import Backend

SIDE, DISTANCE = 1.0, 2.0
"""Of the cube, m: its near face is at 1.5 m."""
TOLERANCE = 1e-3
"""Of the depth, m."""


def draw_cube(backend: Backend) -> str:
    """Draw the cube, check depth and part at the centre, and return the device's name.

    Raises:
        RenderError: The renderer does not work here.
        ValueError: The picture is wrong.
    """
    camera = Intrinsics.from_fov(1.0, 16, 16)
    camera_T_object = np.eye(4)
    camera_T_object[2, 3] = DISTANCE
    with make_renderer(backend) as renderer:
        renderer.open(cube())
        frame = renderer.render(np.zeros(0), camera_T_object, camera)
    expected = DISTANCE - SIDE / 2
    depth, part = float(frame.depth[8, 8]), int(frame.part[8, 8])
    if abs(depth - expected) > TOLERANCE or part != 0:
        message = f"expected depth {expected} m of part 0, found {depth:.4f} m of part {part}"
        raise ValueError(f"{backend}: {message}")
    return _device(backend)


def cube() -> ArticulatedObject:
    """One part, no joint."""
    category = Category(
        name="cube",
        parts=("cube",),
        joints=(),
        benchmark=(),
        symmetry=None,
        window=Window(azimuth=(0.0, 0.0), elevation=(0.0, 0.0)),
        diagonal=1.0,
        rest="tallest",
        words=(),
    )
    return ArticulatedObject(
        category=category,
        instance="cube",
        visuals=((Visual(mesh=trimesh.creation.box((SIDE, SIDE, SIDE))),),),
        pivot=np.zeros((0, 3)),
        axis=np.zeros((0, 3)),
        upper=np.zeros(0),
        origin=Origin(
            source="", sha256="", object_T_asset=np.eye(4), rest={}, joint_names=(), sign=()
        ),
    )


def _device(backend: Backend) -> str:
    if backend == "raycast":
        return f"CPU, embreex {metadata.version('embreex')}"
    from sim_assets.rendering.sapien import versions

    found = versions()
    device = f"{found['device']}, SAPIEN {found['sapien']}"
    if backend == "sapien":
        return device
    return f"{device}, ManiSkill {metadata.version('mani-skill')}"


def main(backend: str) -> None:
    """Write the device's name as JSON.

    Raises:
        ValueError: There is no such renderer.
    """
    known: tuple[Backend, ...] = get_args(Backend)
    for name in known:
        if name == backend:
            sys.stdout.write(json.dumps(draw_cube(name)) + "\n")
            return
    raise ValueError(f"renderer: expected one of {', '.join(known)}, found {backend!r}")


if __name__ == "__main__":
    main(sys.argv[1])
