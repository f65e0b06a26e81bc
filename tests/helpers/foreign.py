# SPDX-License-Identifier: MIT
"""Small folders in the layouts of external sets, written from this project's own objects."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree

from sim_assets.objects import ArticulatedObject
from tests.helpers import boxes

HINGE = "铰链（旋转）"  # noqa: RUF001 - the word as the files have it


def whole_mesh(obj: ArticulatedObject) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and the part of each face."""
    meshes = [obj.part_mesh(part) for part in range(len(obj.visuals))]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    parts = [np.full(len(mesh.faces), part) for part, mesh in enumerate(meshes)]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return vertices, np.concatenate(faces), np.concatenate(parts)


def obj_lines(vertices: np.ndarray, faces: np.ndarray) -> str:
    rows = [f"v {x:.10f} {y:.10f} {z:.10f}" for x, y, z in vertices]
    return "\n".join(rows + [f"f {a} {b} {c}" for a, b, c in faces + 1]) + "\n"


def shape2motion(obj: ArticulatedObject, root: Path, name: str, number: str = "0001") -> Path:
    """`<root>/MDV02/<name>/<number>/`, half the size, away from the origin."""
    folder = root / "MDV02" / name / number
    folder.mkdir(parents=True)
    vertices, faces, part = whole_mesh(obj)
    (folder / "summary.obj").write_text(obj_lines(0.5 * vertices + 0.1, faces))
    labels = {7 + face: int(label) for face, label in enumerate(part)}
    np.save(folder / "sfs_idx_to_dof_name_idx.npy", labels, allow_pickle=True)  # type: ignore
    nodes = [
        {
            "dof_name": f"dof_Aa{j:03d}_r",
            "motion_type": "rotation",
            "center": (0.5 * obj.pivot[j] + 0.1).tolist(),
            "direction": (2 * obj.axis[j]).tolist(),
            "children": [],
        }
        for j in range(len(obj.pivot))
    ]
    if name == "eyeglasses":
        nodes = nodes[::-1]  # each beside the other's part
    still = {"motion_type": "none", "center": [0, 0, 0], "direction": [0, 0, 0]}
    tree = {"dof_name": "dof_rootd", **still, "children": nodes}
    (folder / "motion_attributes.json").write_text(json.dumps(tree))
    return folder


def hoi4d(obj: ArticulatedObject, root: Path, name: str, number: str = "001") -> Path:
    """`<root>/HOI4D/<name>/<number>/`: a mesh for each colour, the limits in degrees."""
    folder = root / "HOI4D" / name / number
    (folder / "objs").mkdir(parents=True)
    leaves, entries = [], []
    for part in range(len(obj.visuals)):
        names = [f"original-{part}-{k}" for k in range(len(obj.visuals[part]))]
        for mesh_name, visual in zip(names, obj.visuals[part], strict=True):
            text = obj_lines(3 * visual.mesh.vertices, visual.mesh.faces)
            (folder / "objs" / f"{mesh_name}.obj").write_text(text)
        leaves.append({"id": 10 + part, "name": f"piece {part}", "objs": names})
    for j in range(len(obj.pivot)):
        axis = {"origin": (3 * obj.pivot[j]).tolist(), "direction": obj.axis[j].tolist()}
        limit = {"a": float(np.degrees(obj.upper[j])), "b": 0, "noLimit": False}
        data = {"axis": axis, "limit": limit}
        entries.append({"id": j, "joint": HINGE, "jointData": data, "parts": [{"id": 11 + j}]})
    entries.append({"id": 9, "joint": "固定", "jointData": {}, "parts": [{"id": 10}]})
    tree = [{"id": 0, "children": [leaves[0], {"id": 1, "children": leaves[1:]}]}]
    (folder / "result.json").write_text(json.dumps(tree))
    text = json.dumps(entries, ensure_ascii=False)
    (folder / "mobility_v2.json").write_text(text, encoding="utf-8")
    return folder


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """An object in a state before an OpenCV camera: what an importer has to find."""

    points: np.ndarray
    part: np.ndarray
    camera_T_part: np.ndarray
    pivot: np.ndarray
    axis: np.ndarray


def view_of(
    obj: ArticulatedObject, state: Sequence[float] | np.ndarray, seed: int, count: int = 3000
) -> View:
    """Points all over the object, 2 m before the camera, turned at random."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    camera_T_object = np.eye(4)
    camera_T_object[:3, :3] = turn * np.sign(np.linalg.det(turn))
    camera_T_object[:3, 3] = (0.05, -0.02, 2.0)
    poses = camera_T_object @ obj.pose(np.asarray(state, float))
    points, part = [], []
    for number, pose in enumerate(poses):
        mesh = obj.part_mesh(number)
        face = rng.choice(len(mesh.faces), count // len(poses), p=mesh.area_faces / mesh.area)
        weight = rng.dirichlet((1, 1, 1), len(face))
        on_mesh = np.einsum("nk,nkd->nd", weight, mesh.triangles[face])
        points.append(on_mesh @ pose[:3, :3].T + pose[:3, 3])
        part.append(np.full(len(face), number))
    # Joint j hangs on the base, which carries its axis.
    pivot = obj.pivot @ poses[0, :3, :3].T + poses[0, :3, 3]
    return View(
        points=np.concatenate(points),
        part=np.concatenate(part),
        camera_T_part=poses,
        pivot=pivot,
        axis=obj.axis @ poses[0, :3, :3].T,
    )


FLIP = np.diag([1.0, -1.0, -1.0])
SIZE = 480 * 640


def real_record(view: View, theirs_R_ours: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """The dict of OP-Align's real set: each point at its pixel, f = 600, y up, decimetres."""
    rng = np.random.default_rng(seed)
    column = np.floor(600 * view.points[:, 0] / view.points[:, 2] + 320).astype(int)
    row = np.floor(600 * view.points[:, 1] / view.points[:, 2] + 240).astype(int)
    place, first = np.unique(row * 640 + column, return_index=True)
    pc = np.zeros((SIZE, 3))
    pc[place] = 10 * view.points[first] @ FLIP
    segmentation = np.zeros(SIZE, np.uint8)
    segmentation[place] = view.part[first] + 1
    detection = np.zeros(SIZE, bool)
    detection[place] = True
    # Background: two points that the detector takes for the object, one that it does not, one
    # pixel without a depth.
    empty = np.setdiff1d(np.arange(SIZE), place)[[5, 6, 7, 8]]
    pc[empty[:3]] = (0.1, 0.2, -9.0)
    detection[empty[[0, 1, 3]]] = True
    poses = view.camera_T_part
    rotation = FLIP @ poses[:, :3, :3] @ theirs_R_ours.T
    size = np.ones((len(poses), 3))
    part = np.concatenate([rotation.reshape(-1, 9), 10 * poses[:, :3, 3] @ FLIP, size], axis=1)
    return {
        "pc": pc,
        "color": rng.random((SIZE, 3), np.float32),
        "detection": detection,
        "segmentation": segmentation,
        "part": part,
        "joint": np.concatenate([10 * view.pivot @ FLIP, view.axis @ FLIP], axis=1),
    }


def write_npz(record: object, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, record)  # type: ignore
    return path


def light_record(
    view: View, theirs_R_ours: np.ndarray, diagonal: float, order: Sequence[int]
) -> dict[str, Any]:
    """The torch dict of OP-Align's Light files, its parts in the order given, the base marked."""
    centre = view.points.mean(0)
    poses = np.zeros((len(order), 4, 4))
    for place, part in enumerate(order):
        pose = view.camera_T_part[part]
        poses[place, :3, :3] = FLIP @ pose[:3, :3] @ theirs_R_ours.T
        poses[place, :3, 3] = FLIP @ (pose[:3, 3] - centre) / diagonal
        poses[place, 3, 3] = float(part != 0)
    label = np.argsort(order)[view.part]
    points = (view.points - centre) @ FLIP / diagonal
    pivot = (view.pivot - centre) @ FLIP / diagonal

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return {
        "pc": tensor(points),
        "af_pc": tensor(points.T),
        "label": torch.from_numpy(label.astype(np.int64)),
        "part_pv_point": tensor(pivot),
        "part_axis": tensor(view.axis @ FLIP),
        "pose_segs": tensor(poses),
        "idx": torch.tensor([3]),
    }


def write_pt(record: object, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(record, path)  # noqa: TID251 - the layout under test
    return path


def light_set(root: Path, names: dict[str, int]) -> None:
    """Files `<root>/<name>/<index>.pt` for each folder name and number of files."""
    view = view_of(boxes.laptop(), [0.5], seed=0, count=128)
    for name, count in names.items():
        for index in range(count):
            record = light_record(view, np.eye(3), 0.42, (0, 1))
            write_pt(record, root / name / f"{99 + index}.pt")


class Calls:
    """Pickles as a call of any function."""

    def __init__(self, function: Any, *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def assert_same(found: ArticulatedObject, obj: ArticulatedObject) -> None:
    """The same parts, joints and poses up to a scale about the box's centre."""
    scale = np.linalg.norm(found.extents()) / np.linalg.norm(obj.extents())
    np.testing.assert_allclose(found.axis, obj.axis, atol=1e-5)
    middle = found.pivot - scale * obj.pivot
    along = np.einsum("ij,ij->i", middle, obj.axis)
    np.testing.assert_allclose(middle - along[:, None] * obj.axis, 0, atol=1e-5)
    state = 0.7 * np.minimum(found.upper, obj.upper)
    for part, (pose, wanted) in enumerate(zip(found.pose(state), obj.pose(state), strict=True)):
        mine, theirs = (thing.part_mesh(part) for thing in (found, obj))
        moved = mine.vertices @ pose[:3, :3].T + pose[:3, 3]
        meant = scale * (theirs.vertices @ wanted[:3, :3].T + wanted[:3, 3])
        assert KDTree(meant).query(moved)[0].max() < 1e-5
        assert KDTree(moved).query(meant)[0].max() < 1e-5
        # A face may come with its reverse, so that both sides are seen.
        assert 0.999 < mine.area / (scale**2 * theirs.area) < 2.001
