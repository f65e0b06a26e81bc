# SPDX-License-Identifier: MIT
"""A twin as files that other programs load: URDF with OBJ meshes, GLB, and where it was seen.

A URDF has no default state: simulators load it with all joints at 0. The observed state stands in
`twin.json` beside it, by joint, with the root link's pose in the camera's frame (`camera_T_root`);
the GLB shows the object in that state. Each part collides as its convex hull, which simulators do
not test between a link and the one that it hangs on.
"""

from __future__ import annotations

from pathlib import Path

from bench.twin.articulated import articulated, link_name
from bench.twin.record import Twin
from scapo.export.glb import write_glb
from scapo.export.urdf import write_files
from scapo.store import canonical_json, write_bytes

FORMAT = "scapo-twin/1"
GLB = "twin.glb"
STATE = "twin.json"


def write_twin(twin: Twin, folder: Path) -> list[Path]:
    """Write `mobility.urdf`, `meshes/*.obj`, `twin.glb` and `twin.json` into a folder.

    Equal twins give equal bytes.

    Args:
        twin: What was observed and predicted.
        folder: Made if need be; without a folder `meshes`.

    Returns:
        The files, the URDF first.

    Raises:
        ValueError: Parts whose names are alike, numbers that are not finite.
        OSError: It cannot be written.
    """
    made = articulated(twin)
    folder.mkdir(parents=True, exist_ok=True)
    files = write_files(folder, made.links, made.joints, link_name(twin.category.name))
    write_glb(folder / GLB, made.links, made.joints, made.state)
    text = canonical_json(
        {
            "format": FORMAT,
            "name": twin.name,
            "category": twin.category.name,
            "camera_T_root": made.camera_T_root.tolist(),
            "state": made.state,
            "without_surface": [link.name for link in made.links if not link.surfaces],
        }
    )
    write_bytes(folder / STATE, (text + "\n").encode())
    return [*files, folder / GLB, folder / STATE]
