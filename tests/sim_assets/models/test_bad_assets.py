# SPDX-License-Identifier: MIT
"""Models that must be refused with a reason, and never crash the reader."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sim_assets.models import meshes, reader, validate
from sim_assets.models import xml as xml_text
from sim_assets.models.validate import AssetError
from tests.helpers.urdfs import TEXT, cabinet

Change = tuple[str, str]
SCALE = 'scale="1 1 1"'
LIMIT = '<limit lower="0" upper="1.5"/>'
AXIS = '<axis xyz="0 0 -1"/>'
BODY_MESH = '<mesh filename="meshes/body.obj" scale="1 1 1"/>'
DOOR_LINK = TEXT[TEXT.index('  <link name="door">') : TEXT.index("  <joint")]
BODY_LINK = TEXT[TEXT.index('  <link name="body">') : TEXT.index('  <link name="door">')]
JOINT = TEXT[TEXT.index("  <joint") : TEXT.index("</robot>")]
BOMB = """<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">
<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]>"""
EXTERNAL = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/hostname">]>'


def extra_joint(kind: str, parent: str, child: str, name: str = "extra") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><limit lower="0" upper="1"/></joint></robot>'
    )


def mimic(target: str) -> Change:
    return LIMIT, f'{LIMIT}<mimic joint="{target}"/>'


TEXTS: dict[str, tuple[list[Change], str]] = {
    "entity bomb": ([('<?xml version="1.0"?>', BOMB)], "DTD"),
    "external entity": ([('<?xml version="1.0"?>', EXTERNAL)], "DTD"),
    "remote dtd": ([("<robot", '<!DOCTYPE r SYSTEM "http://a/b"><robot')], "DTD"),
    "malformed": ([("</robot>", "")], "well-formed"),
    "unclosed attribute": ([('name="hinge"', 'name="hinge')], "well-formed"),
    "control character": ([("cabinet", "cab\x01inet")], "well-formed"),
    "deep nesting": ([("</robot>", "<a>" * 3000 + "</a>" * 3000 + "</robot>")], "well-formed"),
    "another root": ([("<robot", "<sdf"), ("</robot>", "</sdf>")], "<sdf>"),
    "xacro": (
        [
            ("<robot", '<robot xmlns:xacro="http://ros.org/wiki/xacro"'),
            ("</robot>", '<xacro:include filename="a"/></robot>'),
        ],
        "xacro",
    ),
    "no links": ([(BODY_LINK, ""), (DOOR_LINK, ""), (JOINT, "")], "at least one <link>"),
    "single link": ([(DOOR_LINK, ""), (JOINT, "")], "no joint"),
    "link without name": ([('<link name="door">', "<link>")], "attribute 'name'"),
    "two links of a name": ([('<link name="door">', '<link name="body">')], "one link named"),
    "two joints of a name": ([("</robot>", JOINT + "</robot>")], "one joint named"),
    "no such child": ([('<child link="door"/>', '<child link="flap"/>')], "a link 'flap'"),
    "no such parent": ([('<parent link="body"/>', '<parent link="box"/>')], "a link 'box'"),
    "no parent": ([('<parent link="body"/>', "")], "a <parent>"),
    "no child": ([('<child link="door"/>', "")], "a <child>"),
    "two roots": ([(JOINT, "")], "one root"),
    "cycle": ([("</robot>", extra_joint("fixed", "door", "body"))], "cycle"),
    "itself": ([('<child link="door"/>', '<child link="body"/>')], "cycle"),
    "two parents": ([("</robot>", extra_joint("fixed", "body", "door"))], "two for link"),
    "unknown kind": ([('"revolute"', '"ball"')], "'ball'"),
    "no kind": ([(' type="revolute"', "")], "'type'"),
    "planar door": ([('"revolute"', '"planar"')], "planar"),
    "floating door": ([('"revolute"', '"floating"')], "floating"),
    "all fixed": ([('"revolute"', '"fixed"')], "1 fixed joint"),
    "another kind": ([('"revolute"', '"prismatic"')], "1 prismatic joint"),
    "no limit": ([(LIMIT, "")], "limits of the revolute joint"),
    "limit without numbers": ([(LIMIT, "<limit/>")], "limits of the revolute joint"),
    "nan limit": ([('upper="1.5"', 'upper="nan"')], "found from 0 to nan"),
    "infinite limit": ([('upper="1.5"', 'upper="inf"')], "found from 0 to inf"),
    "word as limit": ([('upper="1.5"', 'upper="wide"')], "numbers"),
    "no travel": ([('upper="1.5"', 'upper="0"')], "travel of at least"),
    "button": ([('upper="1.5"', 'upper="0.002"')], "travel of at least"),
    "degrees": ([('upper="1.5"', 'upper="90"')], "degrees"),
    "zero axis": ([(AXIS, '<axis xyz="0 0 0"/>')], "axis with a length"),
    "nan axis": ([(AXIS, '<axis xyz="0 nan 0"/>')], "finite"),
    "short axis": ([(AXIS, '<axis xyz="0 1"/>')], "3 numbers"),
    "nan origin": ([('xyz="-0.26 0.2 0"', 'xyz="nan 0 0"')], "finite"),
    "words as origin": ([('xyz="-0.26 0.2 0"', 'xyz="a b c"')], "numbers"),
    "decimal commas": ([('xyz="-0.26 0.2 0"', 'xyz="-0,26 0,2 0"')], "3 numbers"),
    "mimic of nothing": ([mimic("ghost")], "'ghost'"),
    "mimic of itself": ([mimic("hinge")], "cycle of mimics"),
    "no visuals": (
        [(BODY_LINK, '<link name="body"/>'), (DOOR_LINK, '<link name="door"/>')],
        "visual shapes",
    ),
    "invisible door": ([(DOOR_LINK, '<link name="door"/>')], "1 revolute joint"),
    "invisible body": ([(BODY_LINK, '<link name="body"/>')], "1 revolute joint"),
    "zero scale": ([(SCALE, 'scale="1 0 1"')], "without zeros"),
    "nan scale": ([(SCALE, 'scale="1 nan 1"')], "finite"),
    "scale of two": ([(SCALE, 'scale="1 1"')], "1 or 3 numbers"),
    "word as scale": ([(SCALE, 'scale="big"')], "numbers"),
    "huge scale": ([(SCALE, 'scale="1e30 1 1"')], "coordinates below"),
    "negative box": ([(BODY_MESH, '<box size="1 -1 1"/>')], "above zero"),
    "box without size": ([(BODY_MESH, "<box/>")], "3 numbers"),
    "sphere of none": ([(BODY_MESH, '<sphere radius="0"/>')], "above zero"),
    "cylinder without length": ([(BODY_MESH, '<cylinder radius="1"/>')], "1 numbers"),
    "unknown shape": ([(BODY_MESH, "<teapot/>")], "<teapot>"),
    "mesh without name": ([(BODY_MESH, "<mesh/>")], "'filename'"),
    "missing mesh": ([("body.obj", "lost.obj")], "no such file"),
    "folder as mesh": ([("meshes/body.obj", "meshes")], "no such file"),
    "traversal": ([("meshes/body.obj", "../../../../../etc/passwd")], "inside the folder"),
    "absolute path": ([("meshes/body.obj", "/etc/passwd")], "inside the folder"),
    "file scheme": ([("meshes/body.obj", "file:///etc/passwd")], "inside the folder"),
    "package traversal": ([("meshes/body.obj", "package://../../../etc/passwd")], "inside the"),
    "http": ([("meshes/body.obj", "http://example.org/body.obj")], "package://"),
    "unknown format": ([("meshes/body.obj", "cabinet.urdf")], "'.urdf'"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_refused_by_its_text(name: str, tmp_path: Path):
    changes, reason = TEXTS[name]
    urdf = cabinet(tmp_path, *changes)
    with pytest.raises(AssetError, match=reason) as caught:
        reader.read(urdf, "oven", root=tmp_path)
    assert "expected" in str(caught.value)
    assert "found" in str(caught.value)


def obj(vertices: str, faces: str = "f 1 2 3\n") -> bytes:
    return "".join(f"v {v}\n" for v in vertices.split(",")).encode() + faces.encode()


def ply(count: int, body: str = "") -> bytes:
    head = f"ply\nformat ascii 1.0\nelement vertex {count}\n"
    return (
        head + "property float x\nproperty float y\nproperty float z\nend_header\n" + body
    ).encode()


def gltf(uri: str) -> bytes:
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [accessor],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "buffers": [{"uri": uri, "byteLength": 36}],
        }
    ).encode()


ODD = b"<?xml version='1.0' encoding='x-no'?><a/>"
NOISE = np.random.default_rng(0).bytes(4096)
FILES: dict[str, tuple[str, bytes, str]] = {
    "empty": ("body.obj", b"", "an empty file"),
    "blank": ("body.obj", b" \n \n", "an empty file"),
    "noise obj": ("body.obj", NOISE, "found"),
    "noise stl": ("body.stl", NOISE, "found"),
    "noise ply": ("body.ply", NOISE, "found"),
    "noise glb": ("body.glb", NOISE, "found"),
    "noise gltf": ("body.gltf", NOISE, "found"),
    "noise dae": ("body.dae", NOISE, "found"),
    "no faces": ("body.obj", obj("0 0 0,1 0 0,0 1 0", ""), "found"),
    "points": ("body.ply", ply(3, "0 0 0\n1 0 0\n0 1 0\n"), "triangles"),
    "nan vertex": ("body.obj", obj("0 0 0,nan 0 0,0 1 0"), "finite"),
    "infinite vertex": ("body.obj", obj("0 0 0,inf 0 0,0 1 0"), "finite"),
    "bad index": ("body.obj", obj("0 0 0,1 0 0,0 1 0", "f 1 2 9\n"), "found"),
    "words": ("body.obj", obj("a b c,1 0 0,0 1 0"), "found"),
    "degenerate": ("body.obj", obj("0 0 0,1 0 0,2 0 0"), "degenerate"),
    "far away": ("body.obj", obj("0 0 0,1e12 0 0,0 1 0"), "coordinates below"),
    "lying stl": ("body.stl", b"\0" * 80 + struct.pack("<I", 4_000_000_000) + b"\0" * 100, "found"),
    "lying ply": ("body.ply", ply(10**12), "found"),
    "cut glb": ("body.glb", b"glTF" + struct.pack("<II", 2, 10**6) + b"\0" * 8, "found"),
    "gltf outside": ("body.gltf", gltf("../../../../../../etc/passwd"), "found"),
    "gltf remote": ("body.gltf", gltf("http://example.org/a.bin"), "found"),
    "dae bomb": ("body.dae", BOMB.encode() + b"<COLLADA>&c;</COLLADA>", "found"),
}


@pytest.mark.parametrize("name", FILES)
def test_refused_by_its_mesh(name: str, tmp_path: Path):
    file, data, reason = FILES[name]
    urdf = cabinet(tmp_path, ("meshes/body.obj", f"meshes/{file}"))
    (tmp_path / "meshes" / file).write_bytes(data)
    with pytest.raises(AssetError, match=reason):
        reader.read(urdf, "oven", root=tmp_path)


@pytest.mark.parametrize(
    "data", [b"", b"  \n", NOISE, b"<?xml version='1.0' encoding='x-no'?><a/>"]
)
def test_refused_without_xml(data: bytes, tmp_path: Path):
    (tmp_path / "a.urdf").write_bytes(data)
    with pytest.raises(AssetError, match="found"):
        reader.read(tmp_path / "a.urdf", "oven")


def test_refused_without_file(tmp_path: Path):
    with pytest.raises(AssetError, match="readable"):
        reader.read(tmp_path / "a.urdf", "oven")
    (tmp_path / "a.urdf").mkdir()
    with pytest.raises(AssetError, match="readable"):
        reader.read(tmp_path / "a.urdf", "oven")


def test_refused_outside_by_a_link(tmp_path: Path):
    urdf = cabinet(tmp_path / "inside", ("body.obj", "far.obj"))
    (tmp_path / "far.obj").write_bytes(obj("0 0 0,1 0 0,0 1 0"))
    (urdf.parent / "meshes/far.obj").symlink_to(tmp_path / "far.obj")
    with pytest.raises(AssetError, match="inside the folder"):
        reader.read(urdf, "oven", root=tmp_path / "inside")
    with pytest.raises(AssetError, match="inside the folder"):
        reader.read(urdf, "oven", root=tmp_path / "inside" / "meshes")


def test_material_files_outside_are_not_read(tmp_path: Path):
    """The mesh is good; what it asks for elsewhere is not opened."""
    urdf = cabinet(tmp_path / "inside")
    (tmp_path / "far.mtl").write_text("newmtl a\nKd 1 0 0\n")
    mesh = urdf.parent / "meshes/door.obj"
    mesh.write_text("mtllib ../../far.mtl\nusemtl a\n" + mesh.read_text())
    thing = reader.read(urdf, "oven", root=tmp_path / "inside")
    assert thing.visuals[1][0].color != (1.0, 0.0, 0.0, 1.0)


LIMITS: dict[str, tuple[object, str, int, str]] = {
    "urdf": (xml_text, "MAX_URDF_BYTES", 100, "MiB"),
    "triangles": (meshes, "MAX_FACES", 20, "triangles"),
}


@pytest.mark.parametrize("name", LIMITS)
def test_refused_by_size(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    module, constant, value, reason = LIMITS[name]
    monkeypatch.setattr(module, constant, value)
    with pytest.raises(AssetError, match=reason):
        reader.read(cabinet(tmp_path), "oven")


def test_refused_by_number_of_links(tmp_path: Path):
    many = "".join(f'<link name="l{k}"/>' for k in range(validate.MAX_LINKS))
    with pytest.raises(AssetError, match=f"at most {validate.MAX_LINKS} links"):
        reader.read(cabinet(tmp_path, ("</robot>", many + "</robot>")), "oven")


WISHES: dict[str, tuple[Callable[[Path], object], str]] = {
    "up": (lambda urdf: reader.read(urdf, "oven", up="above"), "direction"),
    "front": (lambda urdf: reader.read(urdf, "oven", front="-"), "direction"),
    "parallel": (lambda urdf: reader.read(urdf, "oven", up="z", front="-z"), "right angles"),
    "scale": (lambda urdf: reader.read(urdf, "oven", scale=-1.0), "above zero"),
    "nan scale": (lambda urdf: reader.read(urdf, "oven", scale=float("nan")), "above zero"),
    "two joints": (lambda urdf: reader.read(urdf, "eyeglasses"), "2 revolute joints"),
    "a drawer": (lambda urdf: reader.read(urdf, "drawer"), "1 prismatic joint"),
}


@pytest.mark.parametrize("name", WISHES)
def test_refused_wishes(name: str, tmp_path: Path):
    call, reason = WISHES[name]
    with pytest.raises(AssetError, match=reason):
        call(cabinet(tmp_path))


def test_unknown_category(tmp_path: Path):
    with pytest.raises(ValueError, match="expected one of"):
        reader.read(cabinet(tmp_path), "teapot")
