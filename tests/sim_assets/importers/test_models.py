# SPDX-License-Identifier: MIT
"""Shape2Motion and HOI4D: their quirks, and damaged folders refused in one line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_assets.importers import hoi4d, shape2motion
from sim_assets.importers.models import Hinge, Model, told_limits
from sim_assets.importers.records import read_obj
from sim_assets.importers.sets import ModelReader
from tests.helpers import boxes, foreign


def motion(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the tree of a Shape2Motion folder in place."""
    path = folder / "motion_attributes.json"
    tree = json.loads(path.read_text())
    change(tree)
    path.write_text(json.dumps(tree))


def node(name: str, kind: str, *children: dict[str, Any]) -> dict[str, Any]:
    return {
        "dof_name": name,
        "motion_type": kind,
        "center": [1, 2, 3],
        "direction": [0, 0, 2],
        "children": list(children),
    }


def cubes(folder: Path, count: int) -> None:
    """A mesh of `count` unit cubes along x, each a part of its own."""
    folder.mkdir(parents=True)
    lines, labels = [], {}
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = [(1, 3, 2), (2, 3, 4), (5, 6, 7), (6, 8, 7), (1, 2, 5), (2, 6, 5)]
    faces += [(3, 7, 4), (4, 7, 8), (1, 5, 3), (3, 5, 7), (2, 4, 6), (4, 8, 6)]
    for k in range(count):
        lines += [f"v {x + 2 * k} {y} {z}" for x, y, z in corners]
        lines += [f"f {a + 8 * k} {b + 8 * k} {c + 8 * k}" for a, b, c in faces]
        labels |= {len(labels) + i: np.int64(k) for i in range(12)}
    (folder / "summary.obj").write_text("\n".join(lines))
    np.save(folder / "sfs_idx_to_dof_name_idx.npy", labels, allow_pickle=True)  # type: ignore


def read_tree(folder: Path, count: int, tree: dict[str, Any]) -> Model:
    cubes(folder, count)
    (folder / "motion_attributes.json").write_text(json.dumps(tree))
    (found,) = shape2motion.find(folder)
    return shape2motion.read(found)


def extents(model: Model) -> dict[str, list[float]]:
    """First x coordinates of each link's cubes, which tell the parts."""
    return {
        link.name: [surface.vertices[:, 0].min() for surface in link.surfaces]
        for link in model.links
    }


def test_only_the_first_rotation_moves_with_what_hangs_on_it(tmp_path: Path):
    knob = node("knob", "rotation")
    door = node("door", "rotation", node("handle", "none"), knob)
    tree = node("root", "none", node("tray", "translation"), door, node("lamp", "rotation"))
    model = read_tree(tmp_path / "fridge" / "0007", 6, tree)
    assert model.name == "shape2motion_fridge_0007"
    # Pre-order: root 0, tray 1, door 2, handle 3, knob 4, lamp 5.
    assert extents(model) == {"base": [0, 2, 10], "part_2_door": [4, 6, 8]}
    (joint,) = model.joints
    assert (joint.parent, joint.child, joint.endless) == ("base", "part_2_door", True)
    np.testing.assert_allclose(joint.axis, [0, 0, 1])
    np.testing.assert_allclose(joint.pivot, [1, 2, 3])


def test_records_of_eyeglasses_are_exchanged(tmp_path: Path):
    left, right = node("left", "rotation"), node("right", "rotation")
    left["center"], right["center"] = [4, 0, 0], [2, 0, 0]
    tree = node("root", "none", left, right)
    model = read_tree(tmp_path / "eyeglasses" / "0001", 3, tree)
    assert extents(model) == {"base": [0], "part_1_left": [2], "part_2_right": [4]}
    pivots = {joint.child: joint.pivot.tolist() for joint in model.joints}
    assert pivots == {"part_1_left": [2, 0, 0], "part_2_right": [4, 0, 0]}


def test_a_root_that_turns_is_itself_alone(tmp_path: Path):
    tree = node("root", "rotation", node("body", "none"))
    model = read_tree(tmp_path / "tap" / "1", 2, tree)
    assert extents(model) == {"base": [2], "part_0_root": [0]}
    assert [(joint.parent, joint.child) for joint in model.joints] == [("base", "part_0_root")]


S2M: dict[str, tuple[Callable[[Path], object], str]] = {
    "no mesh": (lambda f: (f / "summary.obj").unlink(), "summary.obj: expected a readable file"),
    "no labels": (
        lambda f: (f / "sfs_idx_to_dof_name_idx.npy").unlink(),
        "idx.npy: expected a readable",
    ),
    "mesh of words": (lambda f: (f / "summary.obj").write_text("v a b c\nf 1 2 3"), "lines 'v x y"),
    "empty mesh": (lambda f: (f / "summary.obj").write_text(""), "a mesh with triangles, found 0"),
    "quads": (
        lambda f: (f / "summary.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 1"),
        "three numbers for each vertex and face",
    ),
    "index": (lambda f: (f / "summary.obj").write_text("v 0 0 0\nf 1 2 3"), "indices from 1 to 1"),
    "nan": (lambda f: (f / "summary.obj").write_text("v 0 nan 0\nf 1 1 1"), "finite coordinates"),
    "other faces": (
        lambda f: labels(f, {0: 0, 1: 1}),
        "24 contiguous faces, .*2 from 0 to 1",
    ),
    "gap": (lambda f: labels(f, {k + (k > 5): 0 for k in range(24)}), "found 24 from 0 to 24"),
    "part": (lambda f: labels(f, dict.fromkeys(range(24), 9)), "part indices below 2, .*found 9"),
    "one part": (lambda f: labels(f, dict.fromkeys(range(24), 0)), "faces of part 1, found none"),
    "words": (lambda f: labels(f, dict.fromkeys(range(24), "door")), "whole numbers as faces"),
    "half": (lambda f: labels(f, dict.fromkeys(range(24), 0.5)), "whole numbers as faces"),
    "list": (lambda f: labels(f, [0, 1]), "a dict {face index: part index}"),
    "no json": (lambda f: (f / "motion_attributes.json").write_text("{"), "json: expected JSON"),
    "nothing moves": (
        lambda f: change_node(f, motion_type="none"),
        "json: expected a node with motion_type 'rotation', found none",
    ),
    "no type": (lambda f: motion(f, lambda t: t.pop("motion_type")), "'motion_type' as str, found"),
    "center": (lambda f: change_node(f, center=[1, 2]), "'center' as three finite numbers"),
    "text": (lambda f: change_node(f, center=[1, 2, "x"]), "'center' as three numbers"),
    "infinite": (lambda f: change_node(f, center=[1, 2, 1e999]), "three finite numbers"),
    "no axis": (lambda f: change_node(f, direction=[0, 0, 0]), "'direction' with a length"),
    "children": (lambda f: change_node(f, children=3), "'children' as list, found 3"),
    "child": (lambda f: change_node(f, children=[7]), "expected an object, found 7"),
}


def labels(folder: Path, value: Any) -> None:
    np.save(folder / "sfs_idx_to_dof_name_idx.npy", value, allow_pickle=True)


def change_node(folder: Path, **values: object) -> None:
    motion(folder, lambda tree: tree["children"][0].update(values))


def refused(reader: ModelReader, folder: Path, message: str) -> None:
    """In one line that begins with the model's folder."""
    (found,) = reader.find(folder)
    with pytest.raises(ValueError, match=message) as caught:
        reader.read(found)
    assert str(caught.value).startswith(f"{folder}/")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", S2M)
def test_damaged_shape2motion(name: str, tmp_path: Path):
    damage, message = S2M[name]
    folder = foreign.shape2motion(boxes.laptop(), tmp_path, "laptop")
    damage(folder)
    refused(shape2motion, folder, message)


def change_json(folder: Path, file: str, change: Callable[[Any], object]) -> None:
    value = json.loads((folder / file).read_text(encoding="utf-8"))
    changed = change(value)
    text = json.dumps(value if changed is None else changed)
    (folder / file).write_text(text, encoding="utf-8")


def tree(change: Callable[[Any], object]) -> Callable[[Path], None]:
    return lambda folder: change_json(folder, "result.json", change)


def mobility(change: Callable[[Any], object]) -> Callable[[Path], None]:
    return lambda folder: change_json(folder, "mobility_v2.json", change)


HOI4D: dict[str, tuple[Callable[[Path], object], str]] = {
    "no tree": (lambda f: (f / "result.json").unlink(), "result.json: expected a readable file"),
    "no motion": (lambda f: (f / "mobility_v2.json").unlink(), "v2.json: expected a readable file"),
    "no mesh": (lambda f: (f / "objs/original-1-0.obj").unlink(), "1-0.obj: expected a readable"),
    "tree of no list": (tree(lambda t: {"a": 1}), "result.json: expected a list"),
    "no parts": (tree(lambda t: []), "parts with 'objs', found none"),
    "neither": (tree(lambda t: t[0].pop("children") and None), "'children' as list, found none"),
    "id": (tree(lambda t: leaf(t).update(id="door")), "'id' as an integer, found 'door'"),
    "same id": (tree(lambda t: leaf(t).update(id=11)), "one part 11 with meshes"),
    "no meshes": (tree(lambda t: leaf(t).update(objs=[])), "one part 10 with meshes"),
    "path": (tree(lambda t: leaf(t).update(objs=["../../x"])), "mesh names without folders"),
    "no hinge": (mobility(lambda m: m[1:]), "an entry with 'joint'"),
    "english": (mobility(lambda m: m[0].update(joint="hinge")), "an entry with 'joint'"),
    "part": (mobility(lambda m: m[0].update(parts=[{"id": 99}])), "found part 99"),
    "twice": (mobility(lambda m: [m[0], m[0]]), "each on one hinge, found part 11"),
    "all": (mobility(lambda m: m[0].update(parts=[{"id": 10}, {"id": 11}])), "stands still"),
    "no data": (mobility(lambda m: m[0].pop("jointData") and None), "'jointData' as dict"),
    "axis": (mobility(lambda m: data(m)["axis"].update(direction=[0, 0, 0])), "with a length"),
    "limit": (mobility(lambda m: data(m).update(limit={"a": 1})), "'limit' with numbers a and b"),
    "nan": (mobility(lambda m: data(m).update(limit={"a": 0, "b": "nan"})), "finite limits"),
}


def leaf(frames: Any) -> Any:
    return frames[0]["children"][0]


def data(entries: Any) -> Any:
    return entries[0]["jointData"]


@pytest.mark.parametrize("name", HOI4D)
def test_damaged_hoi4d(name: str, tmp_path: Path):
    damage, message = HOI4D[name]
    folder = foreign.hoi4d(boxes.laptop(), tmp_path, "laptop")
    damage(folder)
    refused(hoi4d, folder, message)


LIMITS = {
    "degrees": ({"a": 0, "b": 90}, (0, math.pi / 2)),
    "reversed": ({"a": 30, "b": -110}, (-math.radians(110), math.radians(30))),
    "text": ({"a": "0", "b": "90"}, (0, math.pi / 2)),
    "radians": ({"a": 0, "b": 1.5}, (0, 1.5)),
}


@pytest.mark.parametrize("name", LIMITS)
def test_limits_of_hoi4d(name: str, tmp_path: Path):
    limit, wanted = LIMITS[name]
    folder = foreign.hoi4d(boxes.laptop(), tmp_path, "laptop")
    mobility(lambda m: data(m).update(limit=limit))(folder)
    (joint,) = hoi4d.read(hoi4d.find(tmp_path)[0]).joints
    assert (joint.lower, joint.upper) == pytest.approx(wanted)


@pytest.mark.parametrize("limit", [None, {"a": 0, "b": 0}, {"a": 1, "b": 2, "noLimit": True}])
def test_limits_that_hoi4d_leaves_open(limit: object, tmp_path: Path):
    folder = foreign.hoi4d(boxes.laptop(), tmp_path, "laptop")
    mobility(lambda m: data(m).update(limit=limit))(folder)
    (joint,) = hoi4d.read(hoi4d.find(tmp_path)[0]).joints
    assert (joint.lower, joint.upper) == pytest.approx((0, math.radians(135)))


def test_parts_in_the_order_of_traversal_and_safes_left_out(tmp_path: Path):
    for number in ("033", "034", "043", "050", "051"):
        foreign.hoi4d(boxes.laptop(), tmp_path, "safe", number)
    foreign.hoi4d(boxes.laptop(), tmp_path, "laptop", "034")
    found = [(folder.category, folder.id) for folder in hoi4d.find(tmp_path)]
    safes = [("safe", number) for number in ("033", "043", "051")]
    assert found == [("laptop", "034"), *safes]
    leaves = hoi4d.read_leaves(tmp_path / "HOI4D/laptop/034/result.json")
    assert list(leaves) == [10, 11]
    model = hoi4d.read(hoi4d.find(tmp_path)[0])
    assert [link.name for link in model.links] == ["base_piece_0", "part_1_piece_1"]


@pytest.mark.parametrize(
    ("opening", "turn"), [(0.0, 1.0), (45.0, 1.0), (100.0, 1.0), (45.0, -1.0), (100.0, -1.0)]
)
def test_told_limits_of_a_laptop_given_open(opening: float, turn: float):
    """The limits run from the closed state, whichever way the axis points.

    Of a laptop given closed both ways look alike, and positive angles are taken.
    """
    obj = boxes.laptop()
    pose = obj.pose(np.radians([opening]))[1]
    screen = obj.part_mesh(1).vertices @ pose[:3, :3].T + pose[:3, 3]
    hinge = Hinge(parent=0, child=1, pivot=obj.pivot[0], axis=turn * obj.axis[0], limits=None)
    limits = told_limits(hinge, obj.part_mesh(0).vertices, screen, "laptop")
    assert limits is not None
    closed, wide = limits if turn > 0 else limits[::-1]
    assert math.degrees(turn * closed) == pytest.approx(-opening, abs=8)
    assert abs(wide - closed) == pytest.approx(math.radians(135))


def test_told_limits_of_doors_and_unknown_categories():
    body = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    door = body * (0.02, 1, 1) - (0.03, 0, 0)
    for turn in (1.0, -1.0):
        axis = np.array([0, 0, -turn])
        hinge = Hinge(parent=0, child=1, pivot=np.array([0, 1.0, 0]), axis=axis, limits=None)
        travel = math.radians(90)
        wanted = (0, travel) if turn > 0 else (-travel, 0)
        assert told_limits(hinge, body, door, "oven") == pytest.approx(wanted)
        assert told_limits(hinge, body, door, "fridge") is None


def test_obj_lines_of_other_kinds(tmp_path: Path):
    path = tmp_path / "a.obj"
    path.write_text("# made\no x\nv 0 0 0 1\nv 1 0 0\n\nv 0 1 0\nvn 0 0 1\nf 1/1/1 2//1 -1\n")
    mesh = read_obj(path)
    assert mesh.faces.tolist() == [[0, 1, 2]]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
