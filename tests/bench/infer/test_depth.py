# SPDX-License-Identifier: MIT
"""Depth images become points in metres; cameras of other images and other files are refused."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bench.infer.cloud import InputError
from bench.infer.depth import (
    companions,
    depth_in_metres,
    read_depth,
    read_intrinsics,
    read_mask,
)

WIDTH, HEIGHT = 64, 48
CAMERA = "60,62,33,23.5"
MATRIX = [[60.0, 0, 33], [0, 62, 23.5], [0, 0, 1]]


@pytest.fixture
def image(tmp_path):
    """A slanted surface in millimetres, a hole in it, and its mask."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    depth = (1000 + 5 * u + 3 * v).astype(np.uint16)
    depth[20:24, 30:34] = 0
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:40, 15:50] = 255
    Image.fromarray(depth).save(tmp_path / "a.png")
    Image.fromarray(mask).save(tmp_path / "m.png")
    return tmp_path / "a.png", tmp_path / "m.png", depth / 1000, mask > 0


def test_points_project_to_their_pixels_at_their_depth(image):
    path, mask, depth, shown = image
    cloud = read_depth(path, CAMERA, mask, None)
    v, u = np.nonzero(shown & (depth > 0))
    x, y, z = cloud.points.T.astype(float)
    np.testing.assert_allclose(z, depth[v, u], atol=1e-6)
    np.testing.assert_allclose(60 * x / z + 33, u + 0.5, atol=1e-3)
    np.testing.assert_allclose(62 * y / z + 23.5, v + 0.5, atol=1e-3)
    twice = read_depth(path, CAMERA, mask, 0.002)
    np.testing.assert_allclose(twice.points, 2 * cloud.points, rtol=1e-5)


def test_a_mask_with_a_palette_is_read_by_its_colours(image):
    """Programs number colours as they like, also black as 1 and white as 0."""
    _, mask, _, shown = image
    picture = Image.fromarray((~shown).astype(np.uint8), "L").convert("P")
    picture.putpalette([255, 255, 255, 0, 0, 0])
    picture.save(mask)
    np.testing.assert_array_equal(read_mask(mask, (HEIGHT, WIDTH)), shown)


@pytest.mark.parametrize("bands", ["L", "LA", "RGB", "RGBA"])
def test_a_mask_is_read_from_colours_and_greys_but_not_from_transparency(bands, image):
    path, mask, _, shown = image
    picture = Image.open(mask).convert(bands.rstrip("A"))
    if bands.endswith("A"):
        picture.putalpha(255)
    picture.save(mask)
    np.testing.assert_array_equal(read_mask(mask, (HEIGHT, WIDTH)), shown)
    assert len(read_depth(path, CAMERA, mask, None).points) == np.count_nonzero(
        shown & (depth_in_metres(path, None) > 0)
    )


def test_floats_are_metres(image, tmp_path):
    path, mask, depth, _ = image
    floats = np.where(depth > 0, depth, np.nan).astype(np.float32)
    Image.fromarray(floats).save(tmp_path / "f.tiff")
    found = read_depth(tmp_path / "f.tiff", CAMERA, mask, None)
    np.testing.assert_allclose(found.points, read_depth(path, CAMERA, mask, None).points, atol=1e-5)


@pytest.mark.parametrize(
    "record",
    [
        {"K": MATRIX},
        {"cam_K": [x for row in MATRIX for x in row]},
        {"camera_matrix": {"rows": 3, "cols": 3, "data": [x for row in MATRIX for x in row]}},
        {"intrinsic_matrix": [x for row in np.array(MATRIX).T.tolist() for x in row]},
        {"fx": 60, "fy": 62, "ppx": 33, "ppy": 23.5},
        {"intrinsics": {"fx": 60, "fy": 62, "cx": 33, "cy": 23.5}},
    ],
    ids=lambda record: next(iter(record)),
)
def test_cameras_are_read_as_calibrations_write_them(record, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(record))
    wanted = read_intrinsics(CAMERA, WIDTH, HEIGHT)
    assert wanted.row() == (60, 62, 33, 23.5, WIDTH, HEIGHT)
    assert read_intrinsics(str(path), WIDTH, HEIGHT) == wanted


OPENCV = """%YAML:1.0
---
image_width: 64
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 60., 0., 33., 0., 62., 2.35e+01, 0., 0., 1. ]
"""


@pytest.mark.parametrize(
    "text",
    ["image_width: 64\ncamera_matrix:\n  data: [60, 0, 33, 0, 62, 23.5, 0, 0, 1]\n", OPENCV],
    ids=["ROS", "OpenCV"],
)
def test_yaml_is_read_too(text, tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    assert read_intrinsics(str(path), WIDTH, HEIGHT).row()[:4] == (60, 62, 33, 23.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3", "expected four numbers"),
        ("60,62,33,x", "expected four numbers"),
        ("-60,62,33,23", "expected finite fx, fy > 0"),
        ("nan,62,33,23", "expected finite fx, fy > 0"),
        ("600,620,330,235", "principal point in the image of 64 x 48"),
        ("33,23.5,60,62", "principal point in the image"),
        ("6000,6200,33,23", "field of view"),
        ("1,1,33,23", "field of view"),
        ("60,200,33,23", "square pixels"),
        ("nowhere.json", "expected fx,fy,cx,cy or a file, found neither"),
    ],
)
def test_cameras_of_other_images_are_refused(text, message):
    with pytest.raises(InputError, match=message) as refused:
        read_intrinsics(text, WIDTH, HEIGHT)
    assert text in str(refused.value)


@pytest.mark.parametrize("sides", [("width", "height"), ("image_width", "image_height")])
def test_a_camera_of_another_size_than_the_image_is_refused(sides, tmp_path):
    """At twice the size its principal point may lie in the image yet."""
    path = tmp_path / "camera.json"
    for size, fits in (((WIDTH, HEIGHT), True), ((2 * WIDTH, 2 * HEIGHT), False)):
        said = dict(zip(sides, size, strict=True))
        path.write_text(json.dumps({"fx": 120, "fy": 124, "cx": 63.5, "cy": 47, **said}))
        if fits:
            assert read_intrinsics(str(path), WIDTH, HEIGHT).fx == 120
            continue
        with pytest.raises(InputError, match="an image of 64 x 48, found that of one of 128 x 96"):
            read_intrinsics(str(path), WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "JSON or YAML"), ('{"fx": 1,\n "fy": 2', "JSON or YAML, found expected .* in line 2, "),
     ('{"fx": 1, "fy": , "cx": 1, "cy": 1}', r"found the values \[1, None, 1, 1\]"),
     ("[1]", "a matrix K or num"), ('{"K": [1, 2]}', "a matrix K or num"),
     ('{"fx": 1}', r"found \['fx'\]"),
     ('{"fx": NaN, "fy": 1, "cx": 1, "cy": 1}', r"found the values \['NaN', 1, 1, 1\]"),
     ("!!python/object/apply:os.system [ls]", "JSON or YAML")],
)  # fmt: skip
def test_files_that_are_no_camera_are_refused(text, message, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        read_intrinsics(str(path), WIDTH, HEIGHT)
    assert "\n" not in str(refused.value)


def test_what_is_no_depth_image_is_refused(image, tmp_path):
    path, mask, depth, _ = image
    with pytest.raises(InputError, match="expected --intrinsics"):
        read_depth(path, None, mask, None)
    with pytest.raises(InputError, match="16 bits or floats and one channel, found uint8"):
        read_depth(mask, CAMERA, mask, None)
    with pytest.raises(InputError, match=r"expected depths of 0.02 to 50.0 m, found 1.23e\+03"):
        read_depth(path, CAMERA, mask, 1.0)
    with pytest.raises(InputError, match=r"gone\.png: expected a readable mask, found none$"):
        read_depth(path, CAMERA, tmp_path / "gone.png", None)
    with pytest.raises(InputError, match=r"expected a readable mask, found a folder$"):
        read_depth(path, CAMERA, tmp_path, None)
    Image.fromarray(np.zeros((8, 9), np.uint8)).save(tmp_path / "small.png")
    with pytest.raises(InputError, match="64 x 48, found 9 x 8"):
        read_depth(path, CAMERA, tmp_path / "small.png", None)
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(tmp_path / "none.png")
    with pytest.raises(InputError, match="pixels of the object with a depth, found none"):
        read_depth(path, CAMERA, tmp_path / "none.png", None)
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save(tmp_path / "blind.png")
    with pytest.raises(InputError, match="expected depths above 0, found none"):
        read_depth(tmp_path / "blind.png", CAMERA, None, None)
    for size in (0, 40, path.stat().st_size - 30):
        cut = tmp_path / "cut.png"
        cut.write_bytes(path.read_bytes()[:size])
        with pytest.raises(InputError, match="expected a readable depth image"):
            read_depth(cut, CAMERA, mask, None)
    assert depth.any()


def test_what_lies_beside_an_image_belongs_to_it(tmp_path):
    image = tmp_path / "a.png"
    assert companions(image).mask is None
    assert companions(image).intrinsics is None
    (tmp_path / "intrinsics.yaml").touch()
    assert companions(image).intrinsics == str(tmp_path / "intrinsics.yaml")
    (tmp_path / "a.json").touch()
    (tmp_path / "a.mask.png").touch()
    assert companions(image).intrinsics == str(tmp_path / "a.json")
    assert companions(image).mask == tmp_path / "a.mask.png"


def test_a_tag_that_nobody_asks_about_says_nothing_on_stderr(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    Image.fromarray(np.full((40, 50), 1.5, np.float32)).save(path)
    data = bytearray(path.read_bytes())
    place = int.from_bytes(data[4:8], "little")
    last = place + 2 + 12 * (int.from_bytes(data[place : place + 2], "little") - 1)
    data[last + 4 : last + 8] = b"\xff\xff\0\0"  # values of the last tag: more than the file holds
    path.write_bytes(data)
    with contextlib.suppress(InputError):  # as Pillow likes
        depth_in_metres(path, None)
