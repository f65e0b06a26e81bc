# SPDX-License-Identifier: MIT
"""A small cabinet with a door as a URDF folder, to be spoilt in many ways."""

from __future__ import annotations

from pathlib import Path

import trimesh

BODY = (0.5, 0.4, 0.6)
DOOR = (0.02, 0.4, 0.6)
TEXT = """<?xml version="1.0"?>
<robot name="cabinet">
  <link name="body">
    <visual>
      <origin xyz="0 0 0" rpy="0 0 0"/>
      <geometry><mesh filename="meshes/body.obj" scale="1 1 1"/></geometry>
      <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
    </visual>
  </link>
  <link name="door">
    <visual>
      <origin xyz="0 -0.2 0" rpy="0 0 0"/>
      <geometry><mesh filename="meshes/door.obj"/></geometry>
    </visual>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="body"/>
    <child link="door"/>
    <origin xyz="-0.26 0.2 0" rpy="0 0 0"/>
    <axis xyz="0 0 -1"/>
    <limit lower="0" upper="1.5"/>
  </joint>
</robot>
"""


def cabinet(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the cabinet: a box with a door at -x hinged at y = +0.2.

    Args:
        folder: Made if needed.
        changes: Pieces of `TEXT` and what stands in their place.
    """
    text = TEXT
    for old, new in changes:
        assert old in text, f"{old!r} is not in the text"
        text = text.replace(old, new)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(BODY).export(folder / "meshes/body.obj")
    trimesh.creation.box(DOOR).export(folder / "meshes/door.obj")
    path = folder / "cabinet.urdf"
    path.write_text(text)
    return path


MESH = '<geometry><mesh filename="meshes/{0}.stl"/></geometry>'
LINK = f'<link name="{{0}}"><visual>{MESH}</visual></link>'


def write(folder: Path, links: dict[str, trimesh.Trimesh], joints: str) -> Path:
    (folder / "meshes").mkdir(parents=True)
    for name, mesh in links.items():
        mesh.export(folder / f"meshes/{name}.stl")
    path = folder / "model.urdf"
    path.write_text(f'<robot name="r">{"".join(map(LINK.format, links))}{joints}</robot>')
    return path


def joint(name: str, ends: tuple[str, str], origin: str, axis: str, limit: str) -> str:
    kind = "prismatic" if "slide" in name else "revolute"
    lower, upper = limit.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{ends[0]}"/><child link="{ends[1]}"/>'
        f'<origin {origin}/><axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}"/></joint>'
    )


def box(size: tuple[float, ...], centre: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(centre)
