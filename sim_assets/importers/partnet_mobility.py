# SPDX-License-Identifier: MIT
"""PartNet-Mobility models made plain: one link for each moving body, one frame, no textures.

The model is read as `scapo-data generate` reads it, with all repairs. What is fixed to a body is
merged into it, links are named after their semantics as well, and the model keeps all its joints
and limits, its own size, and its frame (z up, front -x). So any category can be taken from it.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from scapo.export.urdf import Joint, Link, Surface
from scapo.geometry.matrices import moved
from sim_assets.importers.models import Folder, Model, our_category, safe_word
from sim_assets.importers.records import read_json
from sim_assets.models.library import find as find_urdfs
from sim_assets.models.reader import Model as ReadModel
from sim_assets.models.reader import load
from sim_assets.models.resolver import SourceFiles
from sim_assets.models.robot import Joint as RobotJoint
from sim_assets.models.robot import Robot
from sim_assets.models.validate import AssetError, Repairs, refuse
from sim_assets.objects import Visual

SET = "partnet"
"""How the robots of this set are named."""


def find(path: Path) -> list[Folder]:
    """The models below a path; their category is what `meta.json` says, else the folder above.

    Raises:
        AssetError: None there.
    """
    root = path if path.is_dir() else path.parent
    return [
        Folder(
            path=urdf,
            name=urdf.relative_to(root).as_posix(),
            category=_category(urdf.resolve().parent),
            id=safe_word(urdf.resolve().parent.name),
        )
        for urdf in find_urdfs(path)
    ]


def _category(folder: Path) -> str:
    try:
        said = read_json(folder / "meta.json")["model_cat"]
    except (AssetError, KeyError, TypeError):
        said = None
    return our_category(said if isinstance(said, str) else folder.parent.name)


def read(folder: Folder) -> Model:
    """One model with all its joints.

    Raises:
        AssetError: It cannot be used, is of another set, or nothing moves.
    """
    repairs = Repairs()
    files = SourceFiles(urdf=folder.path, root=folder.path.parent, repairs=repairs)
    model = load(files)
    if model.known.set_name != "partnet-mobility":
        found = f"one of the kind {model.known.set_name!r}"
        raise refuse(folder.path, "a PartNet-Mobility model (its root an empty link `base`)", found)
    robot = model.robot
    moving = {joint.child: joint for joint in robot.movable() if _moves(joint, repairs)}
    if not moving:
        raise refuse(folder.path, "a joint with travel", "none")
    head = {robot.root: robot.root}
    for joint in robot.joints.values():
        head[joint.child] = joint.child if joint.child in moving else head[joint.parent]
    poses = robot.poses({})
    names = {link: _name(link, model) for link in (robot.root, *moving)}
    links = tuple(
        Link(
            name=names[top],
            surfaces=tuple(
                _surface(visual, poses[link])
                for link in robot.links
                if head[link] == top
                for visual in model.surfaces.get(link, ())
            ),
        )
        for top in names
    )
    joints = tuple(
        _joint(robot, joint, (names[head[joint.parent]], names[child]), poses[child])
        for child, joint in moving.items()
    )
    notes = repairs.sentences()
    return Model(name=f"{SET}_{folder.id}", links=links, joints=joints, notes=notes)


def _moves(joint: RobotJoint, repairs: Repairs) -> bool:
    if joint.mimic is not None:
        repairs.add("A joint that mimics another was made free", f"joint {joint.name!r}")
    if joint.kind == "continuous":
        return True
    if joint.lower is None or joint.upper is None or not joint.upper - joint.lower > 1e-6:
        repairs.add("A joint without travel was fixed", f"joint {joint.name!r}")
        return False
    return True


def _name(link: str, model: ReadModel) -> str:
    label = model.known.labels.get(link, link)
    return safe_word(link if label == link else f"{link}_{label}")


def _surface(visual: Visual, root_T_link: np.ndarray) -> Surface:
    vertices = moved(np.asarray(visual.mesh.vertices), root_T_link)
    faces = np.asarray(visual.mesh.faces)
    return Surface(vertices=vertices, faces=faces, color=visual.color, piece=True)


def _joint(
    robot: Robot, joint: RobotJoint, ends: tuple[str, str], root_T_child: np.ndarray
) -> Joint:
    """In the root's frame; limits are counted from where the surfaces are given."""
    at = robot.positions({})[joint.name]
    endless = joint.kind == "continuous"
    lower = -math.pi if endless or joint.lower is None else joint.lower - at
    upper = math.pi if endless or joint.upper is None else joint.upper - at
    axis = root_T_child[:3, :3] @ joint.axis
    return Joint(
        name=safe_word(joint.name),
        kind="prismatic" if joint.kind == "prismatic" else "revolute",
        parent=ends[0],
        child=ends[1],
        pivot=root_T_child[:3, 3],
        axis=axis / np.linalg.norm(axis),
        lower=lower,
        upper=upper,
        endless=endless,
    )
