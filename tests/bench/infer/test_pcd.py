# SPDX-License-Identifier: MIT
"""Point Cloud Data files of all three kinds, and broken ones."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from bench.infer.cloud import InputError
from bench.infer.pcd import read_pcd, unpacked

XYZ = np.array([[1.0, 2.0, 3.0], [4.0, 5.5, -6.0], [0.25, 0.5, 0.75]], np.float32)
RGB = np.array([[255, 1, 2], [3, 250, 4], [5, 6, 128]], np.uint8)
SMALL = "A2FiY2HgBQIAAOD/AOAaAAJlbmQ="
PACKED = (RGB.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)).astype(np.uint32)


def pcd(data: str, body: bytes, *, count=3, fields="x y z rgb", extra="") -> bytes:
    names = fields.split()
    lines = [
        "# .PCD v0.7", "VERSION 0.7", f"FIELDS {fields}", f"SIZE {' '.join('4' for _ in names)}",
        f"TYPE {' '.join('U' if n == 'rgba' else 'F' for n in names)}", f"WIDTH {count}",
        "HEIGHT 1", f"VIEWPOINT {extra or '0 0 0 1 0 0 0'}", f"POINTS {count}", f"DATA {data}",
    ]  # fmt: skip
    return "\n".join(lines).encode() + b"\n" + body


def packed(plain: bytes) -> bytes:
    """LZF of literals only, 32 at a time."""
    pieces = [plain[i : i + 32] for i in range(0, len(plain), 32)]
    return b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)


def body(data: str, fields: str = "x y z rgb") -> bytes:
    tint = PACKED.view(np.float32) if fields.endswith("rgb") else PACKED
    columns = [*XYZ.T, tint]
    if data == "ascii":
        shown = [*XYZ.T.astype(str), PACKED.astype(str)]
        return "\n".join(" ".join(row) for row in zip(*shown, strict=True)).encode()
    if data == "binary":
        rows = zip(*columns, strict=True)
        return b"".join(value.tobytes() for row in rows for value in row)
    plain = b"".join(column.tobytes() for column in columns)
    small = packed(plain)
    return np.array([len(small), len(plain)], "<u4").tobytes() + small


def counted(counts: str) -> bytes:
    """With a line on how many values each field has."""
    return pcd("binary", bytes(999)).replace(b"WIDTH", b"COUNT " + counts.encode() + b"\nWIDTH")


@pytest.mark.parametrize("fields", ["x y z rgb", "x y z rgba"])
@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_every_kind_gives_points_and_colours(data, fields, tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(data, body(data, fields), fields=fields))
    found = read_pcd(path)
    np.testing.assert_array_equal(found.points, XYZ)
    np.testing.assert_array_equal(found.color, RGB)
    assert found.sensor is None


def test_fields_in_another_order_and_a_sensor_elsewhere(tmp_path):
    path = tmp_path / "a.pcd"
    rows = np.concatenate([np.full((3, 1), 9, np.float32), XYZ[:, ::-1]], 1)
    text = pcd("binary", rows.tobytes(), fields="normal_x z y x", extra="1 2 3 1 0 0 0")
    path.write_bytes(text)
    found = read_pcd(path)
    np.testing.assert_array_equal(found.points, XYZ)
    np.testing.assert_array_equal(found.sensor, [1, 2, 3])
    assert found.color is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected a PCD header"),
        (b"ply\nformat", "expected a PCD header"),
        (pcd("binary", body("binary")[:20]), "expected 48 bytes of points, found 20"),
        (pcd("ascii", b"1 2 3 4\n1 2 3 4"), "expected 3 points, found 2"),
        (pcd("ascii", b"1 2 x 4\n" * 3), "expected rows of numbers"),
        (pcd("binary_compressed", b"abc"), "expected 48 bytes of points"),
        (pcd("binary_compressed", body("binary_compressed")[:30]), "expected 48 bytes of points"),
        (pcd("zip", b""), "expected DATA ascii"),
        (pcd("binary", b"", count=10**12), "at most 50,000,000 points"),
        (pcd("binary", b"", count=-1), "expected a PCD header with FIELDS"),
        (pcd("binary", bytes(48), fields="a b c d"), "expected fields x y z, found a b c d"),
        (pcd("ascii", b"1 2 3 4\n" * 3, fields="a b c d"), "expected fields x y z, found a b c d"),
        (pcd("binary", body("binary"), extra="1"), "found VIEWPOINT 1$"),
        (counted("3 1 1 1"), "types and counts that do not fit"),
        (counted("1 1 1 0"), "types and counts that do not fit"),
        (counted("1 1 1 -1"), "types and counts that do not fit"),
        (b"FIELDS x y z\nDATA binary\n", "expected a PCD header with FIELDS"),
    ],
)
def test_broken_files_are_refused(data, message, tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as refused:
        read_pcd(path)
    assert str(path) in str(refused.value)


def test_lzf_as_the_library_packs_it():
    # lzf.compress(b"abcabcabcabcabcabc" + bytes(300) + b"end") of liblzf 3.6
    small = base64.b64decode(SMALL)
    assert unpacked(small, 321, "a") == b"abcabcabcabcabcabc" + bytes(300) + b"end"
    for cut in range(len(small)):
        with pytest.raises(InputError):
            unpacked(small[:cut], 321, "a")
    with pytest.raises(InputError, match="broken stream"):
        unpacked(bytes([32, 5]), 3, "a")
