# SPDX-License-Identifier: MIT
"""Procedural assets on disk: other readers find the same parts and joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yourdfpy

from sim_assets.generation.build import build, write_object
from sim_assets.models import reader
from sim_assets.procedural import RECIPES, generate

categories = pytest.mark.parametrize("category", RECIPES)


@categories
def test_yourdfpy_agrees_on_poses_and_meshes(category: str, tmp_path: Path):
    (urdf,) = build(category, count=1, seed=4, out=tmp_path)
    obj = generate(category, "train", 4, 0)
    assert urdf == tmp_path / category / obj.instance / "mobility.urdf"
    robot = yourdfpy.URDF.load(str(urdf))
    state = 0.6 * obj.upper
    robot.update_cfg(dict(zip(obj.origin.joint_names, state, strict=True)))
    poses = obj.pose(state)
    for part, name in enumerate(obj.category.parts):
        link = name.replace(" ", "_")
        link_T_world = robot.get_transform(link, robot.base_link)
        for number, visual in enumerate(obj.visuals[part]):
            mesh = trimesh.load_mesh(urdf.parent / f"meshes/{link}-{number}.obj", process=False)
            found = trimesh.transform_points(mesh.vertices, link_T_world)
            meant = trimesh.transform_points(visual.mesh.vertices, poses[part])
            np.testing.assert_allclose(found, meant, atol=1e-6)
            np.testing.assert_array_equal(mesh.faces, visual.mesh.faces)
    for j, name in enumerate(obj.origin.joint_names):
        limit = robot.joint_map[name].limit
        assert (limit.lower, limit.upper) == pytest.approx((0.0, obj.upper[j]), abs=1e-7)


@categories
def test_our_reader_finds_the_same_object(category: str, tmp_path: Path):
    obj = generate(category, "test", 4, 1)
    urdf = write_object(obj, tmp_path / category / obj.instance)
    found = reader.read(urdf, category, root=tmp_path)
    np.testing.assert_allclose(found.pivot, obj.pivot, atol=1e-6)
    np.testing.assert_allclose(found.axis, obj.axis, atol=1e-6)
    np.testing.assert_allclose(found.upper, obj.upper, atol=1e-6)
    for part in range(len(obj.visuals)):
        bounds = found.part_mesh(part).bounds
        np.testing.assert_allclose(bounds, obj.part_mesh(part).bounds, atol=1e-6)


def test_equal_bytes_twice(tmp_path: Path):
    for name in ("a", "b"):
        assert len(list(build("scissors", count=2, seed=9, out=tmp_path / name))) == 2
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) > 8
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_bad_arguments(tmp_path: Path):
    with pytest.raises(ValueError, match="count: expected at least 1, found 0"):
        next(build("oven", count=0, seed=0, out=tmp_path))
    with pytest.raises(ValueError, match="category 'chair'"):
        next(build("chair", count=1, seed=0, out=tmp_path))
    assert list(tmp_path.iterdir()) == []
