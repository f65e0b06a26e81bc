# SPDX-License-Identifier: MIT
"""JSON records and OBJ meshes of other sets: what is read, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sim_assets.importers import records
from sim_assets.importers.records import direction, member, part_of, read_json, read_obj, vector
from sim_assets.models.validate import AssetError

FILE = Path("set/joint.json")


def test_json_is_read_whatever_its_byte_order_mark(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps({"ä": [1]}).encode())
    assert read_json(path) == {"ä": [1]}


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "\x00"])
def test_other_than_json_is_refused(text: str, tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(AssetError, match=r"a\.json: expected JSON, found"):
        read_json(path)


def test_missing_and_large_files_are_refused(tmp_path: Path, monkeypatch):
    with pytest.raises(AssetError, match="expected a readable file, found No such file"):
        read_json(tmp_path / "none.json")
    monkeypatch.setattr(records, "MAX_JSON_BYTES", 10)
    (tmp_path / "a.json").write_text('"0123456789"')
    with pytest.raises(AssetError, match="found more"):
        read_json(tmp_path / "a.json")


def test_members_have_their_kind():
    assert member(FILE, {"a": 1}, "a", (int, float)) == 1
    for record, key, message in (
        ([], "a", r"expected an object, found \[\]"),
        ({}, "a", "expected 'a' as int, found none"),
        ({"a": "1"}, "a", "expected 'a' as int, found '1'"),
        ({"a": True}, "a", "expected 'a' as int, found True"),
    ):
        with pytest.raises(AssetError, match=f"joint.json: {message}"):
            member(FILE, record, key, int)


def test_vectors_and_directions():
    assert vector(FILE, {"v": ["1", 2, 3.5]}, "v").tolist() == [1.0, 2.0, 3.5]
    assert direction(FILE, {"v": [0, 3, 4]}, "v") == pytest.approx([0, 0.6, 0.8])
    for value in ([1, 2], [1, 2, float("nan")], [1, 2, "x"], [1, 2, None]):
        with pytest.raises(AssetError, match="'v' as three"):
            vector(FILE, {"v": value}, "v")
    with pytest.raises(AssetError, match="'v' with a length"):
        direction(FILE, {"v": [0, 0, 0]}, "v")


def test_an_obj_is_read_as_trimesh_reads_it(tmp_path: Path):
    path = tmp_path / "a.obj"
    box = trimesh.creation.box((1, 2, 3))
    path.write_text(f"# a comment\n{box.export(file_type='obj')}")
    mesh = read_obj(path)
    other = trimesh.load_mesh(path, process=False)
    assert np.array_equal(mesh.vertices[mesh.faces], np.asarray(other.triangles))


def test_relative_indices_count_from_the_end_and_textures_are_left_alone(tmp_path: Path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf -3/1 -2/1 -1/1\nf 1//1 3//1 2//1\n")
    assert read_obj(path).faces.tolist() == [[0, 1, 2], [0, 2, 1]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a mesh with triangles, found 0 vertices, 0 faces"),
        ("v 0 0 0\nf 1 1 x\n", "lines 'v x y z' and 'f i j k'"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3 4\n", "three numbers for each vertex"),
        ("v 0 0\nf 1 1 1\n", "three numbers for each vertex"),
        ("v 0 0 0\nf 1 1 2\n", "vertex indices from 1 to 1"),
        ("v 0 0 0\nf 1 1 -2\n", "vertex indices from 1 to 1"),
        ("v 0 0 nan\nf 1 1 1\n", "finite coordinates"),
    ],
)
def test_other_meshes_are_refused(text: str, message: str, tmp_path: Path):
    path = tmp_path / "a.obj"
    path.write_text(text)
    with pytest.raises(AssetError, match=f"a.obj: expected .*{message}|a.obj: expected {message}"):
        read_obj(path)


def test_some_triangles_keep_the_vertices_that_they_use():
    box = trimesh.creation.box((1, 1, 1))
    mesh = records.Mesh(vertices=np.asarray(box.vertices), faces=np.asarray(box.faces))
    chosen = np.array([0, 5])
    part = part_of(mesh, chosen)
    assert np.array_equal(part.vertices[part.faces], mesh.vertices[mesh.faces[chosen]])
    assert len(part.vertices) == len(np.unique(mesh.faces[chosen]))
