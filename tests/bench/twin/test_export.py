# SPDX-License-Identifier: MIT
"""Files of a twin as other programs load them."""

from __future__ import annotations

import json
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yourdfpy

from bench.twin.export import write_twin
from tests.helpers.twins import STEP, Made, cabinet, glasses

STATE = 0.6
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture(scope="module")
def made() -> Made:
    return cabinet(STATE)


@pytest.fixture(scope="module")
def files(made: Made, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_twin(made.twin, tmp_path_factory.mktemp("twin"))


def test_the_files_are_there_and_equal_twins_give_equal_bytes(
    made: Made, files: list[Path], tmp_path: Path
):
    names = ["mobility.urdf", "meshes/body-0.obj", "meshes/body-collision-0.obj"]
    names += ["meshes/door-0.obj", "meshes/door-collision-0.obj", "mobility.srdf"]
    names += ["twin.glb", "twin.json"]
    assert [path.relative_to(files[0].parent).as_posix() for path in files] == names
    again = write_twin(made.twin, tmp_path / "again")
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in files]


def test_the_observed_state_is_told_and_puts_every_part_where_it_was_seen(
    made: Made, files: list[Path]
):
    told = json.loads(files[-1].read_text())
    assert told["state"] == {"door_joint": pytest.approx(STATE)}
    robot = yourdfpy.URDF.load(str(files[0]))
    low, high = robot.actuated_joints[0].limit.lower, robot.actuated_joints[0].limit.upper
    assert (low, high) == (0.0, pytest.approx(1.5))
    robot.update_cfg(told["state"])
    shape = made.twin.shape
    assert shape is not None
    for part, name in enumerate(("body", "door")):
        mesh = trimesh.load_mesh(files[0].parent / f"meshes/{name}-0.obj")
        mesh.apply_transform(np.array(told["camera_T_root"]) @ robot.get_transform(name, "body"))
        gap = trimesh.proximity.closest_point(mesh, shape.points[shape.part == part][::9])[1]
        assert gap.max() < STEP / 2
        assert gap.mean() < STEP / 5


def test_the_glb_shows_the_observed_state(made: Made, files: list[Path]):
    robot = yourdfpy.URDF.load(str(files[0]))
    robot.update_cfg({"door_joint": STATE})
    body = trimesh.load_mesh(files[0].parent / "meshes/body-0.obj")
    door = trimesh.load_mesh(files[0].parent / "meshes/door-0.obj")
    door.apply_transform(robot.get_transform("door", "body"))
    expected = np.concatenate([body.vertices, door.vertices]) @ Y_UP.T
    found = trimesh.load_scene(files[-2]).to_mesh().vertices
    for ends in (np.min, np.max):
        np.testing.assert_allclose(ends(found, axis=0), ends(expected, axis=0), atol=2e-5)
    np.testing.assert_allclose(found.mean(0), expected.mean(0), atol=2e-5)


def test_what_is_in_the_way_is_not_overwritten(made: Made, tmp_path: Path):
    (tmp_path / "meshes").mkdir()
    with pytest.raises(FileExistsError):
        write_twin(made.twin, tmp_path)


@pytest.mark.skipif(find_spec("sapien") is None, reason="SAPIEN (extra [sim]) is not installed")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("kind", ["safe", "eyeglasses"])
def test_it_opens_and_closes_in_sapien(kind: str, files: list[Path], tmp_path: Path):
    """Driven from one end of its range to the other and back, hulls and all."""
    urdf = files[0] if kind == "safe" else write_twin(glasses(), tmp_path / "glasses")[0]
    robot, scene = simulated(urdf)
    low, high = robot.get_qlimits().T
    assert len(low) == (1 if kind == "safe" else 2)
    assert min(link.mass for link in robot.links) > 0
    for joint in robot.active_joints:
        joint.set_drive_properties(stiffness=4000, damping=130, mode="acceleration")
    for start, end in ((low, high), (high, low)):
        for share in [*np.linspace(0, 1, 240), *[1.0] * 120]:
            for k, joint in enumerate(robot.active_joints):
                joint.set_drive_target(float(start[k] + share * (end[k] - start[k])))
            scene.step()
            assert np.isfinite(robot.qpos).all()
            assert np.abs(robot.qvel).max() < 5.0
            assert (low - 0.05 < robot.qpos).all()
            assert (robot.qpos < high + 0.05).all()
        np.testing.assert_allclose(robot.qpos, end, atol=0.05)


def simulated(urdf: Path) -> tuple[Any, Any]:
    """The robot and its scene."""
    sapien: Any = import_module("sapien")
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(1 / 240)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    builder = loader.load_file_as_articulation_builder(str(urdf))
    for link in builder.link_builders:
        link.visual_records.clear()  # they need a renderer
    return builder.build(), scene
