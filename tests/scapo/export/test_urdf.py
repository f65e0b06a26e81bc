# SPDX-License-Identifier: MIT
"""URDF folders: what is written is read back alike by other programs; bad input leaves nothing."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
import yourdfpy

from scapo.export.urdf import Joint, Link, Surface, urdf_text, write_urdf


def cube(centre: tuple[float, float, float], size: float = 0.2) -> Surface:
    mesh = trimesh.creation.box((size, size, size))
    return Surface(
        vertices=mesh.vertices + np.array(centre), faces=mesh.faces, color=(1.0, 0.5, 0.25, 1.0)
    )


def chain() -> tuple[list[Link], list[Joint]]:
    """A base, an arm that turns about a slanted axis, a slider on the arm."""
    links = [
        Link(name="base", surfaces=(cube((0, 0, 0)), cube((0, 0, 0.2)))),
        Link(name="arm", surfaces=(cube((0.5, 0, 0)),)),
        Link(name="slider", surfaces=(cube((0.8, 0.1, 0), 0.1),)),
    ]
    joints = [
        Joint(
            name="hinge",
            kind="revolute",
            parent="base",
            child="arm",
            pivot=np.array([0.3, 0.1, 0.0]),
            axis=np.array([0.0, 0.6, 0.8]),
            upper=1.5,
        ),
        Joint(
            name="slide",
            kind="prismatic",
            parent="arm",
            child="slider",
            pivot=np.array([0.8, 0.1, 0.0]),
            axis=np.array([1.0, 0.0, 0.0]),
            upper=0.3,
        ),
    ]
    return links, joints


def turn(axis: np.ndarray, angle: float, pivot: np.ndarray) -> np.ndarray:
    return np.asarray(trimesh.transformations.rotation_matrix(angle, axis, pivot))


def test_yourdfpy_poses_every_link_as_meant(tmp_path: Path):
    links, joints = chain()
    robot = yourdfpy.URDF.load(str(write_urdf(tmp_path / "robot", links, joints)))
    robot.update_cfg({"hinge": 0.7, "slide": 0.2})
    hinge = turn(joints[0].axis, 0.7, joints[0].pivot)
    expected = {"base": np.eye(4), "arm": hinge, "slider": hinge @ _shift(0.2 * joints[1].axis)}
    pivots = {"base": np.zeros(3), "arm": joints[0].pivot, "slider": joints[1].pivot}
    for name, base_T_rest in expected.items():
        found = robot.get_transform(name, "base") @ _shift(-pivots[name])
        np.testing.assert_allclose(found, base_T_rest, atol=1e-8)


def _shift(offset: np.ndarray) -> np.ndarray:
    return np.asarray(trimesh.transformations.translation_matrix(offset))


def test_meshes_come_back_exactly(tmp_path: Path):
    links, joints = chain()
    urdf = write_urdf(tmp_path / "robot", links, joints)
    arm = trimesh.load_mesh(urdf.parent / "meshes/arm-0.obj", process=False)
    surface = links[1].surfaces[0]
    np.testing.assert_allclose(arm.vertices + joints[0].pivot, surface.vertices, atol=1e-9)
    np.testing.assert_array_equal(arm.faces, surface.faces)


def test_every_link_has_what_physics_needs(tmp_path: Path):
    links, joints = chain()
    tree = ElementTree.parse(write_urdf(tmp_path / "robot", links, joints))
    for link in tree.iter("link"):
        mass = link.find("inertial/mass")
        inertia = link.find("inertial/inertia")
        assert mass is not None
        assert inertia is not None
        assert float(mass.attrib["value"]) > 0
        ixx, iyy, izz = (float(inertia.attrib[k]) for k in ("ixx", "iyy", "izz"))
        assert min(ixx, iyy, izz) > 0
        assert 2 * max(ixx, iyy, izz) <= (ixx + iyy + izz) * (1 + 1e-6)  # as real bodies have
        assert len(link.findall("visual")) == len(link.findall("collision")) > 0
        names = [visual.attrib["name"] for visual in link.findall("visual")]
        assert len(set(names)) == len(names)
    for joint in tree.iter("joint"):
        limit = joint.find("limit")
        assert limit is not None
        assert float(limit.attrib["lower"]) == 0
        assert min(float(limit.attrib[k]) for k in ("upper", "effort", "velocity")) > 0
    for mesh in tree.iter("mesh"):
        assert (tmp_path / "robot" / mesh.attrib["filename"]).is_file()


def test_equal_input_gives_equal_bytes_and_replaces_the_folder(tmp_path: Path):
    links, joints = chain()
    write_urdf(tmp_path / "a", links, joints)
    write_urdf(tmp_path / "b", [dataclasses.replace(links[0], name="root")], [])
    write_urdf(tmp_path / "b", links, joints)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*"))
    assert files == sorted(p.relative_to(tmp_path / "b") for p in (tmp_path / "b").rglob("*"))
    for name in files:
        if (tmp_path / "a" / name).is_file():
            assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"a", "b"}  # nothing temporary is left


def test_no_negative_zeros():
    links, joints = chain()
    flipped = dataclasses.replace(joints[0], axis=np.array([-0.0, -0.6, 0.8]))
    assert 'xyz="0 -0.6 0.8"' in urdf_text(links, [flipped, joints[1]])


def broken() -> list[tuple[str, list[Link], list[Joint]]]:
    links, (hinge, slide) = chain()
    nan = dataclasses.replace(cube((0, 0, 0)), vertices=np.full((8, 3), np.nan))
    change = dataclasses.replace
    return [
        ("distinct names", [*links, links[0]], [hinge, slide]),
        ("distinct names", [Link(name="../up", surfaces=())], []),
        ("distinct names", [], []),
        ("finite, non-empty meshes", [Link(name="base", surfaces=(nan,))], []),
        ("one tree over the links", links, [hinge]),
        ("a parent nearer to the root", links, [slide, hinge]),
        ("a parent nearer to the root", links, [hinge, change(slide, child="base")]),
        ("unit axis", links, [change(hinge, axis=np.array([0.0, 2.0, 0.0])), slide]),
        ("travel > 0", links, [change(hinge, upper=0.0), slide]),
        ("finite pivot", links, [change(hinge, pivot=np.array([np.nan, 0, 0])), slide]),
    ]


@pytest.mark.parametrize("case", range(len(broken())))
def test_bad_input_is_refused_and_leaves_nothing(case: int, tmp_path: Path):
    message, links, joints = broken()[case]
    with pytest.raises(ValueError, match=message):
        write_urdf(tmp_path / "robot", links, joints)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    links, joints = chain()
    write_urdf(tmp_path / "robot", links, joints)

    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("scapo.export.urdf.urdf_text", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*/robot'"):
        write_urdf(tmp_path / "robot", links, joints)
    assert [p.name for p in tmp_path.iterdir()] == ["robot"]
    assert (tmp_path / "robot/mobility.urdf").is_file()
