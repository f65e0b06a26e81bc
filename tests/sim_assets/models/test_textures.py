# SPDX-License-Identifier: MIT
"""Textures: looked up as a graphics card does, on the right side, the same in every renderer."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from scapo.geometry.camera import Intrinsics
from sim_assets.models.meshes import GREY
from sim_assets.models.reader import read
from sim_assets.models.textures import (
    LEFT_OUT,
    barycentric,
    is_readable,
    look_up,
    read_texels,
    texture_of,
)
from sim_assets.objects import ArticulatedObject
from sim_assets.rendering.backends import make_renderer, resolve_backend
from sim_assets.rendering.base import RenderError
from sim_assets.sampling.cloud import SurfaceSamples
from sim_assets.sampling.viewpoints import generator
from tests.helpers.urdfs import cabinet

CAMERA = Intrinsics.from_fov(np.radians(50), 200, 200)
CORNERS = np.array([[[250, 10, 20], [20, 240, 30]], [[30, 40, 230], [240, 230, 20]]], np.uint8)
"""Of a picture: red and green above, blue and yellow below."""
QUAD = """mtllib door.mtl
v -0.01 0.2 -0.3
v -0.01 -0.2 -0.3
v -0.01 -0.2 0.3
v -0.01 0.2 0.3
vt 0 0
vt 1 0
vt 1 1
vt 0 1
"""
TEXTURED = QUAD + "usemtl picture\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
"""A sheet in front (-x), upright to a viewer who looks along +x and sees +y on the left."""
TWO = "usemtl red\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\nusemtl blue\nf 3/3 2/2 1/1\nf 4/4 3/3 1/1\n"
MATERIALS = """newmtl picture
Kd 1 1 1
map_Kd picture.png
newmtl red
Kd 1 0 0
newmtl blue
Kd 0 0 1
"""


def png(texels: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(texels).save(data, "PNG")
    return data.getvalue()


def thing(
    folder: Path, faces: str = TEXTURED, picture: bytes | None = None, *changes: tuple[str, str]
) -> ArticulatedObject:
    """The cabinet, with a sheet instead of its door."""
    urdf = cabinet(folder, *changes)
    (folder / "meshes/door.obj").write_text(faces)
    (folder / "meshes/door.mtl").write_text(MATERIALS)
    if picture is not None:
        (folder / "meshes/picture.png").write_bytes(picture)
    return read(urdf, "safe", scale=1.0)


def seen(backend: str, shown: ArticulatedObject, behind: bool = False) -> np.ndarray:
    """Colours of the door alone, from in front or from the back, z up."""
    try:
        found = resolve_backend(backend)
    except RenderError as error:
        pytest.skip(str(error))
    pose = np.eye(4)
    # Camera x to the object's -y, y to -z, z to +x; from behind the first and the last reversed.
    turn = -1.0 if behind else 1.0
    pose[:3, :3] = [[0, -turn, 0], [0, 0, -1], [turn, 0, 0]]
    pose[2, 3] = 1.5
    with make_renderer(found, color=True) as renderer:
        renderer.open(shown)
        frame = renderer.render(np.zeros(1), pose, CAMERA, 1)
    assert frame.color is not None
    rows, columns = np.nonzero(frame.part == 1)
    assert len(rows) > 1000
    return frame.color[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def test_colours_between_texels_are_those_of_bilinear_interpolation():
    rng = np.random.default_rng(0)
    texels = rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)
    uv = rng.uniform(-2, 2, (400, 2))
    at = np.stack([(1 - uv[:, 1]) * 5 - 0.5, uv[:, 0] * 7 - 0.5])
    expected = np.stack(
        [
            map_coordinates(texels[..., k].astype(float), at, order=1, mode="grid-wrap")
            for k in range(3)
        ],
        -1,
    )
    assert np.abs(look_up(texels, uv) - expected).max() <= 0.5 + 1e-9
    centres = np.stack(np.meshgrid((np.arange(7) + 0.5) / 7, 1 - (np.arange(5) + 0.5) / 5), -1)
    assert np.array_equal(look_up(texels, centres.reshape(-1, 2)).reshape(5, 7, 3), texels)


def test_weights_of_corners():
    rng = np.random.default_rng(1)
    triangles = rng.normal(size=(50, 3, 3))
    weights = rng.dirichlet((1, 1, 1), 50)
    points = (weights[:, :, None] * triangles).sum(1)
    np.testing.assert_allclose(barycentric(triangles, points), weights, atol=1e-9)
    sliver = np.zeros((1, 3, 3))
    assert np.array_equal(barycentric(sliver, np.ones((1, 3))), [[1, 0, 0]])


@pytest.mark.parametrize("backend", ["raycast", "sapien", "maniskill"])
@pytest.mark.filterwarnings("ignore")  # of the packages that ManiSkill brings
def test_a_texture_is_upright_and_not_mirrored(backend, tmp_path):
    large = np.kron(CORNERS, np.ones((16, 16, 1), np.uint8))
    shown = thing(tmp_path, TEXTURED, png(large))
    assert texture_of(shown.visuals[1][0]) is not None
    picture = seen(backend, shown)
    height, width = picture.shape[:2]
    for row, column in np.ndindex(2, 2):
        spot = picture[(1 + 2 * row) * height // 4, (1 + 2 * column) * width // 4]
        assert np.abs(spot.astype(int) - CORNERS[row, column]).max() <= 1
    mirrored = seen(backend, shown, behind=True)
    assert np.abs(mirrored[height // 4, width // 4].astype(int) - CORNERS[0, 1]).max() <= 1


def test_ray_casting_and_sapien_show_the_same_texture(tmp_path):
    coarse = np.random.default_rng(2).integers(0, 256, (8, 8, 3)).astype(np.uint8)
    shown = thing(tmp_path, TEXTURED, png(coarse))
    a, b = seen("sapien", shown), seen("raycast", shown)
    assert a.shape == b.shape
    assert np.abs(a.astype(int) - b).max() <= 2


@pytest.mark.parametrize("backend", ["raycast", "sapien"])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_sheet_of_two_materials_shows_each_on_its_side(backend, order, tmp_path):
    first, second = TWO.split("usemtl blue")
    pieces = (first, "usemtl blue" + second)
    shown = thing(tmp_path, QUAD + pieces[order[0]] + pieces[order[1]])
    assert (seen(backend, shown) == (255, 0, 0)).all(-1).mean() > 0.99
    assert (seen(backend, shown, behind=True) == (0, 0, 255)).all(-1).mean() > 0.99


def test_a_clouds_colours_are_the_textures(tmp_path):
    shown = thing(tmp_path, TEXTURED, png(np.kron(CORNERS, np.ones((16, 16, 1), np.uint8))))
    poses = np.tile(np.eye(4), (2, 1, 1))
    cloud = SurfaceSamples(shown, color=True).sample(poses, 4000, 16, generator("texture"))
    assert cloud.color is not None
    door = shown.part_mesh(1)
    middle = door.bounds.mean(0)
    on = cloud.part == 1
    points = cloud.points[on] - middle
    clear = (np.abs(points[:, 1]) > 0.03) & (np.abs(points[:, 2]) > 0.03)
    clear &= (np.abs(points[:, 1]) < 0.17) & (np.abs(points[:, 2]) < 0.27)
    expected = CORNERS[(points[:, 2] < 0).astype(int), (points[:, 1] < 0).astype(int)]
    assert clear.sum() > 500
    assert np.array_equal(cloud.color[on][clear], expected[clear])
    assert SurfaceSamples(shown).sample(poses, 64, 1, generator("plain")).color is None


def test_a_texture_that_is_no_picture_is_left_out_and_said_so(tmp_path):
    for name, data in (("cut", png(CORNERS)[:-30]), ("text", b"not a picture")):
        shown = thing(tmp_path / name, TEXTURED, data)
        assert texture_of(shown.visuals[1][0]) is None
        assert shown.visuals[1][0].color == (1.0, 1.0, 1.0, 1.0)
        said = [line for line in shown.origin.repairs if "texture" in line]
        assert len(said) == 1, name
    absent = thing(tmp_path / "absent", TEXTURED)
    assert texture_of(absent.visuals[1][0]) is None
    assert absent.origin.repairs == ("A file that a mesh names is not there (picture.png)",)


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 2 2\n%%EndComments\nshowpage\n"


def saved(form: str, texels: np.ndarray = CORNERS) -> bytes:
    data = io.BytesIO()
    Image.fromarray(texels).save(data, form, **({"lossless": True} if form == "WEBP" else {}))
    return data.getvalue()


@pytest.mark.parametrize("form", ["PNG", "BMP", "TGA", "WEBP", "GIF", "JPEG"])
def test_pictures_are_told_by_their_content(form, tmp_path):
    shown = thing(tmp_path, TEXTURED, saved(form))
    found = texture_of(shown.visuals[1][0])
    assert found is not None
    texels = read_texels(found.material)
    assert texels is not None
    assert texels.shape == (2, 2, 3)
    assert shown.origin.repairs == ()


@pytest.mark.parametrize("form", ["EPS", "TIFF", "ICO", "PPM"])
@pytest.mark.parametrize("place", ["obj", "glb"])
def test_no_other_format_is_decoded(form, place, tmp_path, monkeypatch):
    """PostScript is a program: Pillow would hand it to Ghostscript when the picture is decoded."""

    def never(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr("PIL.EpsImagePlugin.Ghostscript", never)
    picture = POSTSCRIPT if form == "EPS" else saved(form)
    if place == "obj":
        shown = thing(tmp_path, TEXTURED, picture)
    else:
        (tmp_path / "meshes").mkdir(parents=True)
        (tmp_path / "meshes/door.glb").write_bytes(textured_glb(picture))
        shown = thing(tmp_path, TEXTURED, None, ("meshes/door.obj", "meshes/door.glb"))
    assert texture_of(shown.visuals[1][0]) is None
    where = f"door.{place}"
    assert shown.origin.repairs == (f"{LEFT_OUT} ({where})",)


def textured_glb(picture: bytes) -> bytes:
    """A sheet whose texture is these bytes, in a material that is converted while it is read."""
    sheet = trimesh.Trimesh(
        [[0, 0.2, -0.3], [0, -0.2, -0.3], [0, -0.2, 0.3]], [[0, 1, 2]], process=False
    )
    sheet.visual = TextureVisuals(
        uv=np.zeros((3, 2)), material=PBRMaterial(baseColorTexture=Image.fromarray(CORNERS))
    )
    data: Any = trimesh.Scene(sheet).export(file_type="glb")
    size = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + size])
    buffer = data[28 + size :]
    tree["images"] = [{"bufferView": len(tree["bufferViews"]), "mimeType": "image/png"}]
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(picture)})
    tree["textures"] = [{"source": 0}]
    specular = {"diffuseTexture": {"index": 0}}
    tree["materials"] = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": specular}}]
    for mesh in tree["meshes"]:
        mesh["primitives"][0]["material"] = 0
    buffer += picture
    tree["buffers"] = [{"byteLength": len(buffer)}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_a_texture_outside_the_models_folder_is_not_read(tmp_path):
    (tmp_path / "picture.png").write_bytes(png(CORNERS))
    folder = tmp_path / "model"
    urdf = cabinet(folder)
    (folder / "meshes/door.obj").write_text(TEXTURED)
    outside = MATERIALS.replace("picture.png", "../../picture.png")
    (folder / "meshes/door.mtl").write_text(outside)
    shown = read(urdf, "safe", scale=1.0, root=folder)
    assert texture_of(shown.visuals[1][0]) is None


def test_the_urdfs_colour_stands_in_for_the_texture(tmp_path):
    change = (
        '<geometry><mesh filename="meshes/door.obj"/></geometry>',
        '<geometry><mesh filename="meshes/door.obj"/></geometry>'
        '<material name="blue"><color rgba="0 0 1 1"/></material>',
    )
    shown = thing(tmp_path, TEXTURED, png(CORNERS), change)
    assert texture_of(shown.visuals[1][0]) is None
    assert (seen("raycast", shown) == (0, 0, 255)).all()


def test_absurd_pictures_and_factors():
    assert not is_readable(Image.new("1", (1 << 14, 1 << 13)))
    assert is_readable(Image.fromarray(CORNERS))
    half = PBRMaterial(
        baseColorTexture=Image.fromarray(CORNERS), baseColorFactor=[128, 255, 0, 255]
    )
    texels = read_texels(half)
    assert texels is not None
    assert texels[0, 0].tolist() == [round(250 * 128 / 255), 10, 0]
    assert read_texels(object()) is None
    plain = trimesh.creation.box((1, 1, 1))
    plain.visual = TextureVisuals(uv=np.zeros((len(plain.vertices), 2)), material=half)
    assert GREY == (0.7, 0.7, 0.7, 1.0)
