# SPDX-License-Identifier: MIT
"""A twin as files that other programs load: URDF with OBJ meshes, GLB, and where it was seen.

A URDF has no default state: simulators load it with all joints at 0. The observed state stands in
`twin.json` beside it, by joint, with the root link's pose in the camera's frame (`camera_T_root`);
the GLB shows the object in that state. Each part collides as its convex hull, and with the rest of
the world only: `mobility.srdf`, which SAPIEN reads by itself, says so, since hulls overlap where
parts meet or fold over each other.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from bench.twin.articulated import articulated, link_name
from bench.twin.record import Twin
from scapo.export.glb import write_glb
from scapo.export.urdf import write_files
from scapo.store import canonical_json, write_bytes

FORMAT = "scapo-twin/1"
SRDF, GLB, STATE = "mobility.srdf", "twin.glb", "twin.json"


def write_twin(twin: Twin, folder: Path) -> list[Path]:
    """Write `mobility.urdf`, its meshes and SRDF, `twin.glb` and `twin.json` into a folder.

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
    name = link_name(twin.category.name)
    files = write_files(folder, made.links, made.joints, name)
    write_bytes(folder / SRDF, _srdf(name, [link.name for link in made.links]).encode())
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
    return [*files, folder / SRDF, folder / GLB, folder / STATE]


def _srdf(name: str, links: list[str]) -> str:
    """That no two links collide with each other: SAPIEN heeds the reason `Default` only."""
    robot = Element("robot", name=name)
    for first, second in combinations(links, 2):
        SubElement(robot, "disable_collisions", link1=first, link2=second, reason="Default")
    indent(robot)
    return '<?xml version="1.0"?>\n' + tostring(robot, encoding="unicode") + "\n"
