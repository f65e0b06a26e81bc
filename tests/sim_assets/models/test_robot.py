# SPDX-License-Identifier: MIT
"""Forward kinematics against yourdfpy and pytorch_kinematics, on random trees."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import yourdfpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sim_assets.models.parse import parse
from sim_assets.models.robot import Robot, transform
from sim_assets.models.validate import Repairs

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pytorch_kinematics

KINDS = ("revolute", "continuous", "prismatic", "fixed")


def random_urdf(seed: int, count: int) -> str:
    """A random tree of links with boxes; joints in shuffled order."""
    rng = np.random.default_rng(seed)

    def numbers(values: np.ndarray) -> str:
        return " ".join(repr(float(value)) for value in values)

    links = [f'<link name="l{k}"/>' for k in range(count + 1)]
    joints = []
    for k in range(1, count + 1):
        kind = KINDS[rng.integers(4)]
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        origin = f'xyz="{numbers(rng.normal(size=3))}" rpy="{numbers(rng.uniform(-3, 3, 3))}"'
        joints.append(
            f'<joint name="j{k}" type="{kind}"><parent link="l{rng.integers(k)}"/>'
            f'<child link="l{k}"/><origin {origin}/><axis xyz="{numbers(axis)}"/>'
            f'<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        )
    rng.shuffle(joints)
    return f'<robot name="r">{"".join(links)}{"".join(joints)}</robot>'


def read_text(text: str, folder: Path) -> Robot:
    path = folder / "robot.urdf"
    path.write_text(text)
    return parse(path, Repairs())


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 8))
def test_poses_as_yourdfpy_and_pytorch_kinematics(seed: int, count: int, tmp_path: Path):
    robot = read_text(random_urdf(seed, count), tmp_path)
    rng = np.random.default_rng(seed)
    at = {joint.name: float(rng.uniform(-2, 2)) for joint in robot.movable()}
    poses = robot.poses(at)
    assert set(poses) == set(robot.links)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other = yourdfpy.URDF.load(str(robot.path), load_meshes=False)
        chain = pytorch_kinematics.build_chain_from_urdf(robot.path.read_bytes())
    other.update_cfg(at)
    chain = chain.to(dtype=torch.float64)
    found = chain.forward_kinematics(at) if at else {}
    for name, pose in poses.items():
        expected = other.get_transform(name, robot.root)
        np.testing.assert_allclose(pose, expected, atol=1e-7)
        if name in found:
            # It keeps the joints' origins in float32, whatever it is asked for.
            np.testing.assert_allclose(pose, found[name].get_matrix()[0].numpy(), atol=1e-5)


MIMIC = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="second" type="revolute"><parent link="a"/><child link="c"/><axis xyz="0 0 1"/>
  <limit lower="-9" upper="9" effort="1" velocity="1"/>
  <mimic joint="first" multiplier="-2" offset="0.1"/></joint>
<joint name="first" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
  <limit lower="0.25" upper="1" effort="1" velocity="1"/></joint>
<joint name="third" type="prismatic"><parent link="c"/><child link="d"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="0.5" effort="1" velocity="1"/><mimic joint="second"/></joint></robot>"""


def test_mimics_and_clamping(tmp_path: Path):
    robot = read_text(MIMIC, tmp_path)
    assert robot.positions({}) == pytest.approx({"first": 0.25, "second": -0.4, "third": 0.0})
    assert robot.positions({"first": 0.9}) == pytest.approx(
        {"first": 0.9, "second": -1.7, "third": 0.0}
    )
    assert robot.positions({"second": 0.3})["third"] == pytest.approx(0.3)
    other = yourdfpy.URDF.load(str(robot.path))
    other.update_cfg({"first": 0.9})
    pose = robot.poses({"first": 0.9})["c"]
    np.testing.assert_allclose(pose, other.get_transform("c", "a"), atol=1e-9)


def test_tree_order_and_subtrees(tmp_path: Path):
    robot = read_text(MIMIC, tmp_path)
    assert robot.root == "a"
    assert list(robot.links) == ["a", "c", "b", "d"]
    assert robot.subtree(robot.joints["second"]) == {"c", "d"}


def test_transform_is_roll_then_pitch_then_yaw():
    pose = transform((1.0, 2.0, 3.0), (np.pi / 2, 0.0, -np.pi / 2))
    # PartNet-Mobility's fixed joint: y up becomes z up, z towards the viewer becomes -x.
    np.testing.assert_allclose(pose[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(pose[:3, :3] @ [0, 0, 1], [-1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3])
