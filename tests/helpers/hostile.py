# SPDX-License-Identifier: MIT
"""Small models that ask for much: each is a function of a folder, and its URDF stands there."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from tests.helpers.urdfs import cabinet

BODY = '<mesh filename="meshes/body.obj" scale="1 1 1"/>'
MESH = '<visual><geometry><mesh filename="meshes/body.obj"/></geometry></visual>'
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
VERTEX, FACE = "v 0 0 0\n", "f 1 2 3\n"
MATERIAL = "usemtl m{0}\n" + FACE
Maker = Callable[[Path], None]


def with_mesh(name: str, data: bytes | Callable[[Path], object]) -> Maker:
    """The cabinet, its body a file with these bytes, or one that a function writes."""

    def make(folder: Path) -> None:
        cabinet(folder, ("meshes/body.obj", f"meshes/{name}"))
        path = folder / "meshes" / name
        path.unlink(missing_ok=True)
        if callable(data):
            data(path)
        else:
            path.write_bytes(data)

    return make


def with_text(old: str, new: str) -> Maker:
    return lambda folder: (cabinet(folder, (old, new)), None)[1]


def gltf(nodes: int = 1, count: int = 3, chain: bool = False, **accessor: object) -> bytes:
    points = np.eye(3, dtype="<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(points).decode()
    position = {"componentType": 5126, "count": count, "type": "VEC3", **accessor}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0] if chain else list(range(nodes))}],
        "nodes": [
            {"mesh": 0, **({"children": [k + 1]} if chain and k + 1 < nodes else {})}
            for k in range(nodes)
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [position],
        "bufferViews": [{"buffer": 0, "byteLength": len(points)}],
        "buffers": [{"uri": uri, "byteLength": len(points)}],
    }
    return json.dumps(tree).encode()


def dae(nodes: int) -> bytes:
    one = '<node id="n{0}"><instance_geometry url="#g"/></node>'
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="9">
0 0 0 1 0 0 0 1 0</float_array><technique_common><accessor source="#a" count="3" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/>
</vertices><triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p>
</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
{"".join(map(one.format, range(nodes)))}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()


def sparse_stl(path: Path) -> None:
    faces = 10_000_000
    path.write_bytes(bytes(80) + struct.pack("<I", faces))
    os.truncate(path, 84 + 50 * faces)


def chain(folder: Path) -> None:
    """5,000 links in a row, each on a hinge."""
    links, joints = [], []
    for k in range(4990):
        links.append(f'<link name="l{k}">{MESH if k % 1000 == 0 else ""}</link>')
        parent = f"l{k - 1}" if k else "body"
        joints.append(
            f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
            '<limit lower="0" upper="1"/></joint>'
        )
    cabinet(folder, ("</robot>", "".join(links + joints) + "</robot>"))


def mimics(folder: Path) -> None:
    """Joints that mimic one another in a row."""
    chain(folder)
    text = (folder / "cabinet.urdf").read_text()
    for k in range(1, 2000):
        old = f'<child link="l{k}"/>'
        text = text.replace(old, f'{old}<mimic joint="j{k - 1}"/>')
    (folder / "cabinet.urdf").write_text(text)


def picture_bomb(folder: Path) -> None:
    """A picture of 900 million texels in 110 kB."""
    cabinet(folder)
    mesh = folder / "meshes/body.obj"
    lines = mesh.read_text().splitlines()
    corners = [line.replace(" ", "/1 ") + "/1" for line in lines if line.startswith("f")]
    faces = [line.replace("f/1", "f") for line in corners]
    kept = [line for line in lines if line.startswith("v ")]
    mesh.write_text("\n".join(["mtllib b.mtl", *kept, "vt 0 0", "usemtl m", *faces]) + "\n")
    (folder / "meshes/b.mtl").write_text("newmtl m\nmap_Kd bomb.png\n")
    data = io.BytesIO()
    Image.new("1", (1 << 13, 1 << 13)).save(data, "PNG")
    header = bytearray(data.getvalue())
    header[16:24] = struct.pack(">II", 30_000, 30_000)
    (folder / "meshes/bomb.png").write_bytes(bytes(header))


def instead(make: Callable[[Path], object]) -> Maker:
    """The URDF itself is something else."""

    def spoil(folder: Path) -> None:
        urdf = cabinet(folder)
        urdf.unlink()
        make(urdf)

    return spoil


SPHERES = '<visual><geometry><sphere radius="0.{0:05}"/></geometry></visual>'
SOLID = "solid {0}\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
SOLID += "endloop\nendfacet\nendsolid {0}\n"
PLY = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
PLY += "property float y\nproperty float z\nelement face 10000000\n"
PLY += "property list uchar int vertex_indices\nend_header\n"
MANY = PLY.replace("vertex 3", "vertex 99999999999")


def shapes(form: str) -> Maker:
    """The cabinet, its body of 19,000 shapes more."""
    many = "".join(form.format(k + 1) for k in range(19_000))
    return with_text(BODY, f"{BODY}</geometry></visual>{many}<visual><geometry>{BODY}")


def lines(first: str, many: str, count: int, last: str = "") -> Callable[[Path], object]:
    """Writes a text file of equal lines, or of lines with their numbers in them."""

    def write(path: Path) -> None:
        with path.open("w") as file:
            file.write(first)
            for start in range(0, count, 100_000):
                part = range(start, min(start + 100_000, count))
                file.write("".join(map(many.format, part)) if "{" in many else many * len(part))
            file.write(last)

    return write


MODELS: dict[str, Maker] = {
    "glTF of a count": with_mesh("b.gltf", gltf(count=300_000_000)),
    "glTF of a large count": with_mesh("b.gltf", gltf(count=10**15)),
    "glTF of 60,000 instances": with_mesh("b.gltf", gltf(nodes=60_000, bufferView=0)),
    "glTF of 20,000 levels": with_mesh("b.gltf", gltf(nodes=20_000, chain=True, bufferView=0)),
    "COLLADA of 60,000 instances": with_mesh("b.dae", dae(60_000)),
    "20,000 equal spheres": shapes(SPHERES.format(1)),
    "20,000 spheres": shapes(SPHERES),
    "STL of 10 million faces": with_mesh("b.stl", sparse_stl),
    "STL of 60,000 solids": with_mesh("b.stl", lines("", SOLID, 60_000)),
    "OBJ of 10 million faces": with_mesh("b.obj", lines(TRIANGLE, FACE, 10_000_000)),
    "OBJ of one line": with_mesh("b.obj", lines(f"{TRIANGLE}f", " 1 2 3", 20_000_000)),
    "OBJ of 30 million vertices": with_mesh("b.obj", lines("", VERTEX, 30_000_000, FACE)),
    "OBJ of 200,000 materials": with_mesh("b.obj", lines(TRIANGLE, MATERIAL, 200_000)),
    "PLY of 10 million faces": with_mesh("b.ply", PLY.encode() + bytes(36)),
    "PLY of many vertices": with_mesh("b.ply", MANY.encode()),
    "300,000 comments": with_text("<robot", "<!--" * 300_000 + "<robot"),
    "a number of 30 MB": with_text('xyz="-0.26 0.2 0"', f'xyz="{"1" * 30_000_000} 0 0"'),
    "2,000 mimics in a row": mimics,
    "a pipe": instead(os.mkfifo),
    "a device": instead(lambda path: path.symlink_to("/dev/zero")),
    "a link to itself": instead(lambda path: path.symlink_to(path.name)),
    "a link to nothing": instead(lambda path: path.symlink_to("none")),
    "a link outside": instead(lambda path: path.symlink_to("/etc/hostname")),
    "a mesh that is a pipe": with_mesh("b.obj", os.mkfifo),
    "a mesh that is a device": with_mesh("b.obj", lambda path: path.symlink_to("/dev/zero")),
    "digits of other scripts": with_text('xyz="-0.26 0.2 0"', 'xyz="-0.26 \u0660 0"'),
    "digits with underscores": with_text('xyz="-0.26 0.2 0"', 'xyz="-0.26 0_2 0"'),
    "a link far away": with_text('xyz="-0.26 0.2 0"', 'xyz="1e308 1e308 0"'),
    "a name of a megabyte": with_text('<link name="door">', f'<link name="{"x" * 1_000_000}">'),
    "a name with a line break": with_text('<link name="door">', '<link name="a&#10;b&#27;[2J">'),
}  # fmt: skip
"""All of these are to be refused."""
