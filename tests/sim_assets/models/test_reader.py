# SPDX-License-Identifier: MIT
"""Models in many shapes read as the object they are, with each repair said."""

from __future__ import annotations

from math import pi
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sim_assets.models import reader
from sim_assets.objects import ArticulatedObject
from tests.helpers.urdfs import TEXT, cabinet

Change = tuple[str, str]
SCALE = 'scale="1 1 1"'
LIMIT = '<limit lower="0" upper="1.5"/>'
AXIS = '<axis xyz="0 0 -1"/>'


def assert_is_cabinet(thing: ArticulatedObject) -> None:
    """Body and door where `cabinet` puts them, in the object frame."""
    np.testing.assert_allclose(thing.extents(), (0.52, 0.4, 0.6), atol=1e-6)
    np.testing.assert_allclose(thing.axis, [[0, 0, -1]], atol=1e-9)
    np.testing.assert_allclose(thing.pivot[:, :2], [[-0.25, 0.2]], atol=1e-6)
    np.testing.assert_allclose(thing.upper, [1.5])
    door = thing.part_mesh(1).bounds
    np.testing.assert_allclose(door, [[-0.26, -0.2, -0.3], [-0.24, 0.2, 0.3]], atol=1e-6)
    for part in (0, 1):
        mesh = thing.part_mesh(part)
        mesh.merge_vertices()
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(np.prod(mesh.extents), rel=1e-5)


def test_a_sound_model(tmp_path: Path):
    thing = reader.read(cabinet(tmp_path / "one"), "oven", root=tmp_path)
    assert_is_cabinet(thing)
    assert thing.instance == "one"
    assert thing.origin.source == "one/cabinet.urdf"
    assert thing.origin.repairs == ()
    assert thing.origin.rest == {"hinge": 0.0}
    assert thing.origin.joint_names == ("hinge",)
    assert thing.origin.sign == (1.0,)
    assert thing.visuals[0][0].color == (0.5, 0.5, 0.5, 1.0)
    point = thing.origin.object_T_asset @ [-0.26, 0.2, 0, 1]
    np.testing.assert_allclose(point[:3], thing.pivot[0], atol=1e-9)
    again = reader.read(cabinet(tmp_path / "one"), "oven", root=tmp_path)
    assert again.origin.sha256 == thing.origin.sha256
    other = reader.read(cabinet(tmp_path / "one", ("1.5", "1.4")), "oven", root=tmp_path)
    assert other.origin.sha256 != thing.origin.sha256


REPAIRS: dict[str, tuple[list[Change], str]] = {
    "line before declaration": ([("<?xml", "\n <?xml")], "White space before"),
    "version 0.0": ([('version="1.0"', 'version="0.0"')], "version '0.0'"),
    "no version": ([(' version="1.0"', "")], "version none"),
    "undeclared prefix": (
        [("</robot>", '<sensor:camera xyz:a="1"/></robot>')],
        "prefixes were declared: sensor, xyz",
    ),
    "hyphens in comment": ([("</robot>", "<!-- a -- b --></robot>")], "double hyphens"),
    "commas in scale": ([(SCALE, 'scale="1, 1, 1"')], "Commas between numbers"),
    "commas in origin": ([('xyz="-0.26 0.2 0"', 'xyz="-0.26,0.2,0"')], "Commas between numbers"),
    "single scale": ([(SCALE, 'scale="1"')], "single scale"),
    "mirrored": ([(SCALE, 'scale="-1 1 1"')], "mirrored"),
    "long axis": ([(AXIS, '<axis xyz="0 0 -7"/>')], "length 1"),
    "exchanged limits": ([(LIMIT, '<limit lower="1.5" upper="-0.0"/>')], "exchanged"),
    "two limits": ([(LIMIT, LIMIT + '<limit lower="0" upper="9"/>')], "first of several <limit>"),
    "transmission": (
        [("</robot>", '<transmission type="SimpleTransmission" name="t"/></robot>')],
        "transmission without <type>",
    ),
    "inertial": (
        [('<link name="door">', '<link name="door"><inertial><mass value="1"/></inertial>')],
        "inertial block",
    ),
    "colour of three": ([('rgba="0.5 0.5 0.5 1"', 'rgba="0.5 0.5 0.5"')], "without alpha"),
    "colour of bytes": ([('rgba="0.5 0.5 0.5 1"', 'rgba="128 128 128 255"')], "clamped"),
    "empty link": ([("</robot>", '<link name="lost"/></robot>')], "empty link"),
    "visual of nothing": ([('<link name="door">', '<link name="door"><visual/>')], "dropped"),
    "case": ([("meshes/body.obj", "Meshes/body.obj"), ("Meshes", "meshes")], ""),
    "case of name": ([("body.obj", "Body.OBJ")], "whatever their case"),
    "backslash": ([("meshes/body.obj", r"meshes\body.obj")], "Backslashes"),
    "loose root": (
        [
            (
                "</robot>",
                '<link name="world"/><joint name="f" type="floating"><parent link="world"/>'
                '<child link="body"/></joint></robot>',
            )
        ],
        "floating joint was held",
    ),
    "front": ([('name="cabinet"', 'name="cabinet"')], ""),
}


@pytest.mark.parametrize("name", REPAIRS)
def test_repaired(name: str, tmp_path: Path):
    changes, sentence = REPAIRS[name]
    thing = reader.read(cabinet(tmp_path, *changes), "oven", root=tmp_path)
    assert_is_cabinet(thing)
    said = thing.origin.repairs
    assert bool(said) == bool(sentence)
    assert all(sentence in repair for repair in said), said


SAME: dict[str, list[Change]] = {
    "package": [("meshes/body.obj", "package://any/meshes/body.obj")],
    "model": [("meshes/body.obj", "model://any/meshes/body.obj")],
    "gazebo": [("</robot>", "<gazebo reference='door'><a/></gazebo></robot>")],
    "collisions": [("</robot>", "<collision/></robot>")],
    "default space": [("<robot", '<robot xmlns="urn:robots"')],
    "negative zero": [('lower="0"', 'lower="-0.0"')],
    "dot in path": [("meshes/body.obj", "./meshes/../meshes/body.obj")],
}


@pytest.mark.parametrize("name", SAME)
def test_read_without_a_word(name: str, tmp_path: Path):
    folder = tmp_path / "any"
    thing = reader.read(cabinet(folder, *SAME[name]), "oven", root=tmp_path)
    assert_is_cabinet(thing)
    assert thing.origin.repairs == ()


@pytest.mark.parametrize(
    ("encoding", "said"), [("utf-8-sig", 1), ("utf-16", 1), ("latin-1", 0), ("utf-8", 0)]
)
def test_encodings(encoding: str, said: int, tmp_path: Path):
    urdf = cabinet(tmp_path)
    text = TEXT.replace('"cabinet"', '"Küche"')
    if encoding == "latin-1":
        text = text.replace('version="1.0"', 'version="1.0" encoding="latin-1"')
    urdf.write_bytes(text.encode(encoding))
    thing = reader.read(urdf, "oven", root=tmp_path)
    assert_is_cabinet(thing)
    assert len(thing.origin.repairs) == said


@pytest.mark.parametrize("form", ["stl", "ply", "glb", "dae", "obj"])
def test_mesh_formats(form: str, tmp_path: Path):
    urdf = cabinet(tmp_path, ("body.obj", f"body.{form}"))
    trimesh.creation.box((0.5, 0.4, 0.6)).export(tmp_path / f"meshes/body.{form}")
    assert_is_cabinet(reader.read(urdf, "oven", root=tmp_path))


@pytest.mark.parametrize("stray", ["-5 0 3", "nan 0 0", "0 inf 0"])
def test_vertices_of_no_triangle_are_nothing_to_see(stray: str, tmp_path: Path):
    """Left by a program that removed their triangles: they neither close a door nor frame it."""
    urdf = cabinet(tmp_path, ("door.obj", "door.ply"))
    door = trimesh.creation.box((0.02, 0.4, 0.6))
    vertices = [*(" ".join(map(str, row)) for row in door.vertices), stray]
    kinds = [f"property float {axis}" for axis in "xyz"]
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *kinds]
    head += [f"element face {len(door.faces)}", "property list uchar int vertex_indices"]
    faces = [f"3 {i} {j} {k}" for i, j, k in door.faces]
    text = "\n".join([*head, "end_header", *vertices, *faces, ""])
    (tmp_path / "meshes/door.ply").write_text(text)
    thing = reader.read(urdf, "oven", root=tmp_path)
    assert thing.origin.rest == {"hinge": 0.0}
    assert_is_cabinet(thing)
    assert np.abs(thing.part_mesh(1).vertices).max() <= 0.3 + 1e-6


def test_dae_in_inches(tmp_path: Path):
    urdf = cabinet(tmp_path, ("body.obj", "body.dae"))
    path = tmp_path / "meshes/body.dae"
    trimesh.creation.box(np.array((0.5, 0.4, 0.6)) / 0.0254).export(path)
    text = path.read_text()
    unit = '<unit name="inch" meter="0.0254"/>'
    assert "<asset>" in text
    path.write_text(text.replace("<asset>", f"<asset>{unit}"))
    assert_is_cabinet(reader.read(urdf, "oven", root=tmp_path))


def test_glb_nodes_are_placed(tmp_path: Path):
    urdf = cabinet(tmp_path, ("body.obj", "body.glb"))
    scene = trimesh.Scene()
    lift = trimesh.transformations.translation_matrix((0, 0, 0.15))
    for sign in (1, -1):
        half = trimesh.creation.box((0.5, 0.4, 0.3))
        scene.add_geometry(half, transform=lift if sign > 0 else np.linalg.inv(lift))
    scene.export(tmp_path / "meshes/body.glb")
    thing = reader.read(urdf, "oven", root=tmp_path)
    np.testing.assert_allclose(thing.extents(), (0.52, 0.4, 0.6), atol=1e-6)


def test_primitives(tmp_path: Path):
    mesh = '<mesh filename="meshes/body.obj" scale="1 1 1"/>'
    urdf = cabinet(tmp_path, (mesh, '<box size="0.5 0.4 0.6"/>'))
    assert_is_cabinet(reader.read(urdf, "oven", root=tmp_path))


ROOT_JOINT = (
    '<link name="base"/><joint name="fix" type="fixed"><parent link="base"/>'
    '<child link="body"/><origin rpy="{}"/></joint></robot>'
)


@pytest.mark.parametrize(
    ("rpy", "options", "front"),
    [
        (f"0 0 {pi / 2}", {}, "-y"),
        (f"0 0 {pi}", {}, "x"),
        ("0 0 0.3", {}, "-x"),
        (f"{-pi / 2} 0 0", {"up": "y"}, "-x"),
        (f"{-pi / 2} 0 0", {"up": "y", "front": "-x"}, None),
        (f"0 0 {pi}", {"front": "x"}, None),
    ],
)
def test_front_and_up(rpy: str, options: dict[str, str], front: str | None, tmp_path: Path):
    urdf = cabinet(tmp_path, ("</robot>", ROOT_JOINT.format(rpy)))
    thing = reader.read(urdf, "oven", root=tmp_path, **options)  # pyright: ignore[reportArgumentType]
    if rpy != "0 0 0.3":
        assert_is_cabinet(thing)
    told = [repair for repair in thing.origin.repairs if "front" in repair]
    expected = [] if front in (None, "-x") else [f"The front was told from the joint: {front}"]
    assert told == expected


@pytest.mark.parametrize(("wanted", "ratio"), [(None, 1.0), (2.0, 2.0), (0.001, 0.001)])
def test_scale(wanted: float | None, ratio: float, tmp_path: Path):
    thing = reader.read(cabinet(tmp_path), "oven", root=tmp_path, scale=wanted)
    np.testing.assert_allclose(thing.extents(), np.array((0.52, 0.4, 0.6)) * ratio, rtol=1e-6)


def test_millimetres_are_rescaled(tmp_path: Path):
    changes = [(SCALE, 'scale="1000 1000 1000"'), ("door.obj", 'door.obj" scale="1000 1000 1000')]
    changes += [("-0.2 0", "-200 0"), ("-0.26 0.2 0", "-260 200 0")]
    thing = reader.read(cabinet(tmp_path, *changes), "oven", root=tmp_path)
    assert np.linalg.norm(thing.extents()) == pytest.approx(thing.category.diagonal)
    assert "no size in metres" in thing.origin.repairs[0]


@pytest.mark.parametrize(
    ("limit", "rest", "sign", "upper"),
    [
        ("0 1.5", 0.0, 1.0, 1.5),
        ("0 3.0", 0.0, 1.0, pi / 2),
        ("-0.5 1.0", -0.5, 1.0, 1.5),
    ],
)
def test_rest_is_the_closed_limit(
    limit: str, rest: float, sign: float, upper: float, tmp_path: Path
):
    """The door is drawn closed at q = 0, or open by the amount that the limits say."""
    lower, higher = limit.split()
    turned = f'xyz="-0.26 0.2 0" rpy="0 0 {rest}"'
    urdf = cabinet(
        tmp_path,
        (LIMIT, f'<limit lower="{lower}" upper="{higher}"/>'),
        ('xyz="-0.26 0.2 0" rpy="0 0 0"', turned),
    )
    thing = reader.read(urdf, "oven", root=tmp_path)
    assert thing.origin.rest["hinge"] == pytest.approx(rest, abs=1e-6)
    assert thing.origin.sign == (sign,)
    np.testing.assert_allclose(thing.upper, [upper])
    np.testing.assert_allclose(thing.part_mesh(1).bounds[0, 0], -0.26, atol=1e-3)


def test_axis_points_so_that_growing_states_open(tmp_path: Path):
    urdf = cabinet(tmp_path, (AXIS, '<axis xyz="0 0 1"/>'), (LIMIT, '<limit lower="-1.5"/>'))
    thing = reader.read(urdf, "oven", root=tmp_path)
    assert_is_cabinet(thing)
    assert thing.origin.sign == (-1.0,)


def test_continuous_door_gets_the_categorys_travel(tmp_path: Path):
    urdf = cabinet(tmp_path, (LIMIT, ""), ('"revolute"', '"continuous"'))
    thing = reader.read(urdf, "oven", root=tmp_path)
    np.testing.assert_allclose(thing.upper, [pi / 2])
    assert thing.origin.rest == {"hinge": 0.0}


def test_body_hung_on_its_door(tmp_path: Path):
    """The names tell that the root is the moving part."""
    urdf = cabinet(
        tmp_path,
        ('<parent link="body"/>', '<parent link="door"/>'),
        ('<child link="door"/>', '<child link="body"/>'),
        ('<origin xyz="0 0 0" rpy="0 0 0"/>', '<origin xyz="0.26 -0.2 0"/>'),
        ('xyz="-0.26 0.2 0"', 'xyz="0 0 0"'),
        (AXIS, '<axis xyz="0 0 1"/>'),
    )
    thing = reader.read(urdf, "oven", root=tmp_path)
    assert_is_cabinet(thing)


def test_parts_hang_where_their_links_do(tmp_path: Path):
    """A knob on the door is the door's, a button on the body the body's; both stay at zero."""
    more = "".join(
        f'<link name="{name}"><visual><geometry><box size="0.02 0.02 0.02"/></geometry></visual>'
        f'</link><joint name="{name}_joint" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="0 -0.1 0.1"/><axis xyz="1 0 0"/>{limit}</joint>'
        for name, kind, parent, limit in [
            ("knob", "continuous", "door", ""),
            ("button", "prismatic", "body", '<limit lower="0.01" upper="0.05"/>'),
        ]
    )
    thing = reader.read(cabinet(tmp_path, ("</robot>", more + "</robot>")), "oven", root=tmp_path)
    assert thing.origin.joint_names == ("hinge",)
    assert thing.origin.rest == {"hinge": 0.0, "knob_joint": 0.0, "button_joint": 0.01}
    boxes = [len(thing.part_mesh(part).faces) for part in (0, 1)]
    assert boxes == [24, 24]
