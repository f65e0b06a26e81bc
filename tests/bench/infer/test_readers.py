# SPDX-License-Identifier: MIT
"""The same cloud from every kind of file, and what is broken in a file named in one line."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bench.infer.cloud import InputError
from bench.infer.readers import ReadOptions, find_inputs, read_input

RNG = np.random.default_rng(0)
POINTS = (RNG.uniform(-0.3, 0.3, (300, 3)) + np.array([0, 0, 1.5])).astype(np.float32)
COLOR = RNG.integers(0, 256, (300, 3)).astype(np.uint8)
FLOATS = "property float x\nproperty float y\nproperty float z\n"
TINTS = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


def ply(kind: str = "binary_little_endian", count: int = 300, faces: str = "") -> bytes:
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\n{FLOATS}{TINTS}{faces}end_header\n"
    if kind == "ascii":
        rows = zip(POINTS.tolist(), COLOR.tolist(), strict=True)
        return (head + "\n".join(" ".join(map(str, [*p, *c])) for p, c in rows) + "\n").encode()
    big = ">" if "big" in kind else "<"
    table = np.zeros(300, [("p", f"{big}f4", 3), ("c", "u1", 3)])
    table["p"], table["c"] = POINTS, COLOR
    return head.encode() + table.tobytes()


def npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


FACES = "element face 1\nproperty list uchar int vertex_indices\n"
FILES = {
    "a.ply": ply(),
    "big.ply": ply("binary_big_endian"),
    "text.PLY": ply("ascii"),
    "mesh.ply": ply(faces=FACES) + bytes([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]),
    "a.npz": npz(points=POINTS, color=COLOR),
    "double.npz": npz(points=POINTS.astype(float), color=COLOR / 255.0),
    "bytes.npz": npz(points=POINTS, color=COLOR.astype(float)),
}


@pytest.mark.parametrize("name", FILES)
def test_every_kind_of_file_gives_the_cloud(name, tmp_path):
    (tmp_path / name).write_bytes(FILES[name])
    cloud = read_input(tmp_path / name, ReadOptions())
    np.testing.assert_allclose(cloud.points, POINTS, rtol=1e-6)
    assert cloud.color is not None
    assert np.abs(cloud.color.astype(int) - COLOR).max() <= 1
    assert cloud.sensor is None
    assert cloud.warnings == ()


def test_the_camera_may_stand_elsewhere(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npz(points=POINTS - [0, 0, 1.5], sensor=np.array([0, 0, -1.5])))
    assert read_input(path, ReadOptions()).warnings == ()
    moved = read_input(path, ReadOptions(sensor=(0, 3, 0)))
    assert moved.sensor is not None
    assert moved.sensor.tolist() == [0, 3, 0]


def header(shape: str, kind: str = "<f4") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def zipped(**entries: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in entries.items():
            archive.writestr(f"{name}.npy", data)
    return buffer.getvalue()


def bare() -> bytes:
    """An archive whose entry lacks the suffix of an array."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("points", b"none")
    return buffer.getvalue()


def damaged() -> bytes:
    """A packed array of which the middle is lost."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, points=POINTS)
    data = bytearray(buffer.getvalue())
    data[200:600] = bytes(400)
    return bytes(data)


BROKEN = {
    "short.ply": (ply()[:-100], "expected a readable PLY file"),
    "rows.ply": (ply("ascii")[:-400], "expected (300 vertices|a readable PLY)"),
    "huge.ply": (ply(count=10**12), "at most 50,000,000 points, found 1,000,000,000,000"),
    "none.ply": (
        ply(count=0).split(b"end_header\n")[0] + b"end_header\n",
        "expected at least 64 finite points, found 0",
    ),
    "empty.ply": (b"", "expected a PLY header"),
    "junk.ply": (b"junk" * 999, "expected a PLY header"),
    "empty.pcd": (b"", "expected a PCD header"),
    "empty.npz": (b"", "expected a readable .npz"),
    "cut.npz": (FILES["a.npz"][:900], "expected a readable .npz"),
    "bomb.npz": (zipped(points=header("(900000000000, 3)")), "at most 50,000,000 points"),
    "wide.npz": (zipped(points=header("(100, 900000000000)")), "three numbers a row"),
    "pickle.npz": (zipped(points=header("(100, 3)", "|O")), "expected numbers"),
    "lies.npz": (zipped(points=header("(100, 3)")), "expected a readable .npz"),
    "torn.npz": (zipped(points=b"\x93NUMPY\x01\x00\x10\x00{'descr':'<f4'  "), "a readable .npz"),
    "bare.npz": (bare(), "expected a readable .npz"),
    "packed.npz": (damaged(), "expected a readable .npz"),
    "other.npz": (npz(xyz=POINTS, rgb=COLOR), r"array points of shape \(N, 3\), found xyz, rgb$"),
    "nothing.npz": (zipped(), r"an array points of shape \(N, 3\), found none$"),
    "flat.npz": (npz(points=POINTS[:, :2]), r"found one of shape \(300, 2\)"),
    "tint.npz": (npz(points=POINTS, color=COLOR[:5]), "color: expected shape"),
    "far.npz": (npz(points=POINTS, sensor=np.zeros(2)), "sensor: expected 3 finite numbers"),
    "three.npz": (npz(points=POINTS[:3]), "at least 64 finite points, found 3"),
    "nan.npz": (npz(points=POINTS * np.nan), "found 0 and 300 that are NaN"),
    "a.obj": (b"v 0 0 0", "expected one of .ply .pcd .npz"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_named(name, tmp_path):
    data, message = BROKEN[name]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as refused:
        read_input(path, ReadOptions())
    assert str(path) in str(refused.value)


def test_of_an_entry_no_more_is_unpacked_than_its_array(tmp_path):
    """A few kilobytes of an upload may be packed from any amount."""
    buffer = io.BytesIO()
    np.save(buffer, POINTS)
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", buffer.getvalue() + bytes(100 << 20))
    tracemalloc.start()
    cloud = read_input(path, ReadOptions())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert peak < 10 << 20


def test_numbers_too_large_for_their_type_are_left_out_without_a_word_on_stderr(tmp_path):
    few = POINTS.astype(np.float16)
    few[:3] = np.float16(np.inf)
    path = tmp_path / "half.npz"
    path.write_bytes(npz(points=few))
    cloud = read_input(path, ReadOptions())
    assert len(cloud.points) == len(POINTS) - 3
    assert "3 of 300 points left out" in cloud.warnings[0]


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scale_that_no_unit_has_is_refused(scale):
    with pytest.raises(InputError, match="--scale: expected a finite number above 0, found"):
        ReadOptions(scale=scale)


@pytest.mark.parametrize("place", [(0.0, np.nan, 1.0), (np.inf, 0.0, 0.0)])
def test_a_camera_stands_somewhere(place):
    with pytest.raises(InputError, match="--sensor: expected 3 finite numbers, found"):
        ReadOptions(sensor=place)


def test_flags_of_depth_images_are_refused_for_clouds(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(FILES["a.ply"])
    with pytest.raises(InputError, match="expected a depth image with --mask"):
        read_input(path, ReadOptions(mask=Path("m.png")))
    with pytest.raises(InputError, match="expected a file, found none"):
        read_input(tmp_path / "b.ply", ReadOptions())


def test_a_depth_image_has_an_up_as_a_cloud_has(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.full((48, 64), 900, np.uint16)).save(path)
    found = read_input(path, ReadOptions(intrinsics="60,60,32,24", up=(0, -1, 0)))
    assert found.up is not None
    assert found.up.tolist() == [0, -1, 0]


def test_a_depth_image_is_in_the_frame_of_its_camera(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.full((48, 64), 900, np.uint16)).save(path)
    with pytest.raises(InputError, match=r"a\.png: expected a cloud with --sensor, found a depth"):
        read_input(path, ReadOptions(intrinsics="60,60,32,24", sensor=(0, 1, 0)))


def test_a_folder_stands_for_what_can_be_read_in_it(tmp_path):
    for name in ("b.png", "b.mask.png", "b.json", "a.ply", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in find_inputs([tmp_path])] == ["a.ply", "b.png"]
    assert find_inputs([tmp_path / "x.npz"]) == [tmp_path / "x.npz"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected files \.ply \.pcd"):
        find_inputs([tmp_path / "empty"])
