# SPDX-License-Identifier: MIT
"""The files that a URDF names: found by their scheme, hashed, and never outside the source."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from sim_assets.models.resolver import MAX_MATERIALS, MeshResolver, SourceFiles
from sim_assets.models.validate import AssetError, Repairs


@pytest.fixture
def files(tmp_path: Path) -> SourceFiles:
    """root/robot/urdf/a.urdf with meshes beside and above it, and a file outside the root."""
    folder = tmp_path / "root/robot"
    for name in ("urdf/a.urdf", "urdf/beside.obj", "meshes/above.obj", "meshes/above.mtl"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    (tmp_path / "outside.obj").write_text("secret")
    (folder / "meshes/link.obj").symlink_to(tmp_path / "outside.obj")
    return SourceFiles(urdf=folder / "urdf/a.urdf", root=tmp_path / "root", repairs=Repairs())


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("beside.obj", "urdf/beside.obj"),
        ("file://beside.obj", "urdf/beside.obj"),
        ("meshes/above.obj", "meshes/above.obj"),
        ("../meshes/above.obj", "meshes/above.obj"),
        ("package://robot/meshes/above.obj", "meshes/above.obj"),
        ("package://another-name/meshes/above.obj", "meshes/above.obj"),
        ("model://robot/meshes/above.obj", "meshes/above.obj"),
        ("meshes\\above.obj", "meshes/above.obj"),
        ("meshes/ABOVE.obj", "meshes/above.obj"),
    ],
)
def test_files_are_found_by_scheme_and_place(name: str, found: str, files: SourceFiles):
    assert files.locate(name).resolve() == (files.root / "robot" / found).resolve()


@pytest.mark.parametrize(
    "name", ["../../../outside.obj", "meshes/link.obj", "package://robot/../../outside.obj"]
)
def test_nothing_outside_the_source_is_found(name: str, files: SourceFiles):
    with pytest.raises(AssetError, match="mesh files inside the folder 'root'"):
        files.locate(name)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.obj", "no such file in the source folder"),
        ("http://host/a.obj", "a file name, package://, model:// or file://"),
        (" / ", "the name of a mesh file"),
        ("a\0.obj", "the name of a mesh file"),
    ],
)
def test_other_names_are_refused(name: str, message: str, files: SourceFiles):
    with pytest.raises(AssetError, match=message):
        files.locate(name)


def test_the_digest_is_over_names_and_bytes_of_what_was_read(files: SourceFiles):
    for name in ("meshes/above.obj", "beside.obj"):
        files.read(files.locate(name))
    parts = {
        "robot/meshes/above.obj": b"meshes/above.obj",
        "robot/urdf/beside.obj": b"urdf/beside.obj",
    }
    lines = [f"{name} {hashlib.sha256(data).hexdigest()}\n" for name, data in parts.items()]
    assert files.digest() == hashlib.sha256("".join(lines).encode()).hexdigest()


def test_a_mesh_gets_its_side_files_and_no_others(files: SourceFiles):
    resolver = MeshResolver(files, files.root / "robot/meshes/above.obj")
    assert resolver.get("above.mtl") == b"meshes/above.mtl"
    assert resolver.namespaced("../urdf").get("beside.obj") == b"urdf/beside.obj"
    for name in ("none.mtl", "link.obj", "../../../outside.obj", "a\0"):
        with pytest.raises(FileNotFoundError):
            resolver.get(name)
    with pytest.raises(PermissionError, match="read only"):
        resolver.write("above.mtl", b"")


def test_a_file_of_very_many_materials_is_left_out_and_said(files: SourceFiles):
    """A loader opens the picture of each."""
    resolver = MeshResolver(files, files.root / "robot/meshes/above.obj")
    path = files.root / "robot/meshes/above.mtl"
    path.write_text("newmtl m\n" * MAX_MATERIALS)
    assert resolver.get("above.mtl") == path.read_bytes()
    path.write_text("newmtl m\n" * (MAX_MATERIALS + 1))
    with pytest.raises(FileNotFoundError):
        resolver.get("above.mtl")
    assert files.repairs.sentences() == ("Materials were left out of a file of over 10000",)
