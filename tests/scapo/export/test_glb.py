# SPDX-License-Identifier: MIT
"""GLB files as trimesh reads them."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from scapo.export.glb import write_glb
from scapo.export.urdf import Joint, Link, Surface

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def cube(centre: tuple[float, float, float]) -> Surface:
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    return Surface(vertices=mesh.vertices + np.array(centre), faces=mesh.faces)


def door() -> tuple[list[Link], list[Joint]]:
    links = [
        Link(name="body", surfaces=(cube((0, 0, 0)),)),
        Link(name="door", surfaces=(cube((-0.2, 0, 0)), cube((-0.2, 0, 0.2)))),
    ]
    joint = Joint(
        name="hinge",
        kind="revolute",
        parent="body",
        child="door",
        pivot=np.array([-0.1, 0.1, 0.0]),
        axis=np.array([0, 0, -1.0]),
        upper=1.2,
    )
    return links, [joint]


def read(path: Path) -> np.ndarray:
    """All vertices in the scene's world, without repeats."""
    scene = trimesh.load_scene(path)
    return np.unique(np.round(scene.to_mesh().vertices, 5) + 0.0, axis=0)


def described(path: Path) -> dict[str, Any]:
    """The JSON chunk."""
    data = path.read_bytes()
    (size,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + size])


def expected(points: np.ndarray) -> np.ndarray:
    return np.unique(np.round(points @ Y_UP.T, 5) + 0.0, axis=0)


@pytest.mark.parametrize("state", [0.0, 0.9])
def test_trimesh_reads_the_posed_object(state: float, tmp_path: Path):
    links, joints = door()
    write_glb(tmp_path / "door.glb", links, joints, {"hinge": state})
    motion = trimesh.transformations.rotation_matrix(state, joints[0].axis, joints[0].pivot)
    moved = [trimesh.transform_points(s.vertices, motion) for s in links[1].surfaces]
    points = np.concatenate([links[0].surfaces[0].vertices, *moved])
    np.testing.assert_allclose(read(tmp_path / "door.glb"), expected(points), atol=2e-5)


def test_a_slider_is_shifted(tmp_path: Path):
    links, _ = door()
    slide = Joint(
        name="slide",
        kind="prismatic",
        parent="body",
        child="door",
        pivot=np.array([-0.2, 0.0, 0.1]),
        axis=np.array([-1.0, 0, 0]),
        upper=0.3,
    )
    write_glb(tmp_path / "drawer.glb", links, [slide], {"slide": 0.25})
    moved = [s.vertices + np.array([-0.25, 0, 0]) for s in links[1].surfaces]
    points = np.concatenate([links[0].surfaces[0].vertices, *moved])
    np.testing.assert_allclose(read(tmp_path / "drawer.glb"), expected(points), atol=2e-5)


def test_colours_are_linear_as_gltf_asks(tmp_path: Path):
    """sRGB's middle grey of 188 is half the light of white."""
    grey = replace(cube((0, 0, 0)), color=(0.0, 188 / 255, 1.0, 0.5))
    write_glb(tmp_path / "a.glb", [Link(name="body", surfaces=(grey,))], [])
    (material,) = described(tmp_path / "a.glb")["materials"]
    factor = material["pbrMetallicRoughness"]["baseColorFactor"]
    assert factor == pytest.approx([0.0, 0.5, 1.0, 0.5], abs=0.004)


def test_container_and_joint_data(tmp_path: Path):
    links, joints = door()
    write_glb(tmp_path / "a.glb", links, joints)
    write_glb(tmp_path / "b.glb", links, joints)
    data = (tmp_path / "a.glb").read_bytes()
    assert data == (tmp_path / "b.glb").read_bytes()
    magic, version, total = struct.unpack("<III", data[:12])
    assert (magic, version, total) == (0x46546C67, 2, len(data))
    tree = described(tmp_path / "a.glb")
    node = next(node for node in tree["nodes"] if node["name"] == "door")
    assert node["extras"] == {
        "joint": "hinge",
        "kind": "revolute",
        "axis": [0, 0, -1],
        "lower": 0.0,
        "upper": 1.2,
        "state": 0.0,
    }
    assert len(tree["meshes"][1]["primitives"]) == 2
