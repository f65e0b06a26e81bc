# SPDX-License-Identifier: MIT
"""Links and joints in any order become one tree from the root outwards, or are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim_assets.models.parse import build_robot
from sim_assets.models.robot import Joint, Kind, Link, Shape
from sim_assets.models.validate import AssetError, Repairs

PATH = Path("chair/chair.urdf")


def joint(name: str, parent: str, child: str, kind: Kind = "revolute") -> Joint:
    axis = np.array([0.0, 0.0, 1.0])
    return Joint(
        name=name, kind=kind, parent=parent, child=child, parent_T_joint=np.eye(4), axis=axis
    )


def links(*names: str, solid: str = "") -> dict[str, Link]:
    shapes: dict[str, tuple[Shape, ...]] = {name: (_shape(),) for name in solid.split()}
    return {name: Link(name=name, shapes=shapes.get(name, ())) for name in names}


def _shape() -> Shape:
    return object.__new__(Shape)  # its presence alone is asked for


def joints(*rows: Joint) -> dict[str, Joint]:
    return {row.name: row for row in rows}


def test_joints_come_breadth_first_from_the_root_whatever_the_file_s_order() -> None:
    rows = joints(joint("c", "b", "d"), joint("b", "a", "c"), joint("a", "a", "b"))
    robot = build_robot(PATH, "r", links("d", "c", "b", "a"), rows, Repairs())
    assert robot.root == "a"
    assert list(robot.joints) == ["b", "a", "c"]
    assert list(robot.links) == ["a", "c", "b", "d"]


def test_an_empty_link_that_nothing_hangs_on_is_dropped_and_said() -> None:
    repairs = Repairs()
    rows = joints(joint("j", "a", "b"))
    robot = build_robot(PATH, "r", links("world", "a", "b", solid="a b"), rows, repairs)
    assert list(robot.links) == ["a", "b"]
    assert "'world'" in repairs.sentences()[0]


def test_two_solid_roots_are_refused_by_name() -> None:
    rows = joints(joint("j", "a", "b"))
    with pytest.raises(AssetError, match=r"one root link.*'a', 'c'"):
        build_robot(PATH, "r", links("a", "b", "c", solid="a b c"), rows, Repairs())


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_a_free_joint_may_hang_the_whole_object_only(kind: Kind) -> None:
    whole = joints(joint("free", "world", "a", kind), joint("j", "a", "b"))
    repairs = Repairs()
    robot = build_robot(PATH, "r", links("world", "a", "b", solid="a b"), whole, repairs)
    assert robot.root == "world"
    assert "'free'" in repairs.sentences()[0]
    piece = {**whole, "j": replace(whole["j"], kind=kind)}
    with pytest.raises(AssetError, match=f"the {kind} joint 'j' between visible links"):
        build_robot(PATH, "r", links("world", "a", "b", solid="a b"), piece, Repairs())
