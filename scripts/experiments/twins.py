#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""Do exported twins load, and do their joints move them as the true objects move?

    python scripts/experiments/twins.py DATA CATEGORY [CATEGORY ...] [--split val] [--count 20]
        [--model released|MODEL] [--source MODELS] [--bare]

DATA is a folder of procedural objects (`sim-art-2/clean`) with images, or of the models in MODELS.
Without `--model` the true parts, poses and joints stand for the prediction and the model's shape is
1,600 points of the true surface (`--bare`: none, the observed points alone), so that what is left
is the export's own error. With it all is what `scapo-bench infer` would say of each view's image:
by a run, a checkpoint or a released model, `released` for that of each category's own name.

Prints a row for each category: objects, hinge directions within 5 degrees, pivots within 5 % of
the object's diagonal, URDFs that SAPIEN loads and drives through their range, URDFs that yourdfpy
loads, and the Chamfer distance (mean of both ways, % of the diagonal: mean, worst) between the
true object and the twin, as observed and at four other states, the base's part kept in place.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import yourdfpy
from scipy.spatial import KDTree

from bench.infer.answer import ask
from bench.infer.cloud import Cloud
from bench.infer.model import Model, load_model
from bench.infer.readers import ReadOptions, read_input
from bench.metrics import sample_errors
from bench.scoring.truth import Truth, blocks
from bench.twin.articulated import articulated
from bench.twin.export import write_twin
from bench.twin.record import BACKGROUND, Shape, Twin
from scapo.geometry.points import farthest_points
from scapo.store import Split, open_split
from sim_assets.generation.assets import recover
from sim_assets.objects import ArticulatedObject
from sim_assets.sampling.cloud import sample_surface

SHAPE, DENSE, ASKED = 1600, 40_000, 2_000
"""Points of the stand-in for a template; of each surface for the Chamfer distance, and how many of
them are asked for their nearest."""
SHARES = (0.05, 0.35, 0.65, 0.95)
"""Of the travel: the other states."""
HINGE, PIVOT = 5.0, 0.05
FALL = 8.0
"""Seconds of simulation that a twin has to come to rest."""


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One view of one object, and what is said of it."""

    thing: ArticulatedObject
    camera_T_part: np.ndarray
    state: np.ndarray
    twin: Twin
    true_of: np.ndarray
    """The true part of each predicted one."""
    direction: float
    pivot: float
    """Worst joint; degrees, and share of the diagonal."""


def outer_surface(thing: ArticulatedObject, count: int) -> tuple[np.ndarray, ...]:
    """Points, normals and parts of the surface at rest, without what lies inside other pieces."""
    rng = np.random.default_rng(0)
    meshes = [thing.part_mesh(part) for part in range(len(thing.visuals))]
    areas = np.array([mesh.area for mesh in meshes])
    found = []
    for part, mesh in enumerate(meshes):
        drawn = max(int(2 * count * areas[part] / areas.sum()), count // 4)
        points, face = sample_surface(mesh, drawn, rng)
        normals = mesh.face_normals[face]
        hidden = np.zeros(len(points), bool)
        for visual in thing.visuals[part]:
            hidden |= visual.mesh.contains(points + 1e-4 * normals)
        found.append((points[~hidden], normals[~hidden], np.full((~hidden).sum(), part)))
    points, normals, part = (np.concatenate(one) for one in zip(*found, strict=True))
    if count > SHAPE:
        kept = rng.permutation(len(points))[:count]
    else:
        kept = farthest_points(torch.from_numpy(points), min(count, len(points))).numpy()
    return points[kept], normals[kept], part[kept]


def posed(points: np.ndarray, part: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Points of parts in the frame of the poses."""
    return np.einsum("nij,nj->ni", poses[part, :3, :3], points) + poses[part, :3, 3]


def true_twin(thing: ArticulatedObject, truth: Truth, i: int, bare: bool) -> Twin:
    """The labels as a prediction."""
    poses, shape = truth.camera_T_part[i], None
    if not bare:
        points, normals, part = outer_surface(thing, SHAPE)
        turns = poses.copy()
        turns[:, :3, 3] = 0
        shape = Shape(
            points=posed(points, part, poses), normals=posed(normals, part, turns), part=part
        )
    upper = np.maximum(thing.upper, truth.joint_state[i])
    return Twin(
        name=thing.instance,
        category=thing.category,
        points=truth.points[i],
        part=np.where(truth.part[i] < 0, BACKGROUND, truth.part[i]),
        camera_T_part=poses,
        pivot=truth.joint_pivot[i],
        axis=truth.joint_axis[i],
        state=truth.joint_state[i],
        limits=np.stack([np.zeros_like(upper), upper], -1),
        shape=shape,
    )


def found_twin(split: Split, truth: Truth, i: int, model: Model) -> Twin:
    """What `infer` makes of a view: of its depth image where there is one, else of its cloud."""
    index = truth.first + i
    image = next(split.folder.glob(f"images/*/{index:04}.png"), None)
    if image is None:
        return ask(str(index), Cloud(points=truth.points[i]), model, "refine")
    return ask(str(index), read_input(image, ReadOptions()), model, "refine")


def samples(split: Split, given: argparse.Namespace) -> list[Sample]:
    """The first view of each of the first objects."""
    made: dict[int, Sample] = {}
    category = split.manifest.category
    name = category if given.model == "released" else given.model
    model = None if name is None else load_model(name, "cpu", None)
    for truth in blocks(split):
        for i, instance in enumerate(truth.instance.tolist()):
            if instance in made or len(made) == given.count:
                continue
            thing = recover(split.manifest, instance, given.source)
            if model is None:
                twin = true_twin(thing, truth, i, given.bare)
            else:
                twin = found_twin(split, truth, i, model)
            made[instance] = sample(thing, truth, i, twin)
    return list(made.values())


def sample(thing: ArticulatedObject, truth: Truth, i: int, twin: Twin) -> Sample:
    """With the errors of its joints, as the benchmark measures them."""
    near = KDTree(twin.points).query(truth.points[i])[1]  # a depth image has other points
    label = np.where(twin.part == BACKGROUND, 0, twin.part)[near]
    errors = sample_errors(
        part_true=truth.part[i][None],
        camera_T_part_true=truth.camera_T_part[i][None],
        pivot_true=truth.joint_pivot[i][None],
        axis_true=truth.joint_axis[i][None],
        part_pred=label[None],
        camera_T_part_pred=None,
        pivot_pred=twin.pivot[None],
        axis_pred=twin.axis[None],
    )
    slides = np.array([joint.kind == "prismatic" for joint in thing.category.joints])
    off = np.where(slides, 0.0, errors["joint_pivot"][0])
    return Sample(
        thing=thing,
        camera_T_part=truth.camera_T_part[i],
        state=truth.joint_state[i],
        twin=twin,
        true_of=errors["order"][0].astype(int),
        direction=float(np.max(errors["joint_direction"][0])),
        pivot=float(np.max(off) / np.linalg.norm(thing.extents())),
    )


def chamfers(one: Sample, urdf: Path) -> list[float]:
    """As observed first, then at the other states; % of the diagonal."""
    robot = yourdfpy.URDF.load(str(urdf))
    made = articulated(one.twin)
    names = [link.name for link in made.links]
    drawn = {}
    for name in names:
        file = urdf.parent / f"meshes/{name}-0.obj"
        if file.is_file():
            mesh = trimesh.load_mesh(file)
            count = max(200, DENSE // len(names))
            drawn[name] = sample_surface(mesh, count, np.random.default_rng(1))[0]
    points, _, part = outer_surface(one.thing, DENSE)
    errors = []
    for target in [one.state, *(share * one.thing.upper for share in SHARES)]:
        robot.update_cfg(twin_state(one, target - one.state))
        found = np.concatenate(
            [
                trimesh.transform_points(
                    drawn[name], made.camera_T_root @ robot.get_transform(name, names[0])
                )
                for name in drawn
            ]
        )
        poses = one.thing.pose(target)
        kept = int(one.true_of[0])  # the true part in the place of the twin's root
        camera_T_object = one.camera_T_part[kept] @ np.linalg.inv(poses[kept])
        true = posed(points, part, camera_T_object @ poses)
        both = one_way(true, found) + one_way(found, true)
        errors.append(50 * both / float(np.linalg.norm(one.thing.extents())))
    return errors


def one_way(points: np.ndarray, others: np.ndarray) -> float:
    """Mean distance of some of the points to the nearest of the others, m."""
    asked = np.random.default_rng(2).choice(len(points), min(ASKED, len(points)), replace=False)
    return float(np.mean(KDTree(others).query(points[asked])[0]))


def twin_state(one: Sample, moved: np.ndarray) -> dict[str, float]:
    """The twin's joints when the true ones have moved on by so much."""
    made = articulated(one.twin)
    wanted = {}
    for j, joint in enumerate(made.joints):
        parts = {int(one.true_of[0]), int(one.true_of[one.twin.category.joints[j].child])}
        true = next(
            k
            for k, spec in enumerate(one.thing.category.joints)
            if {spec.parent, spec.child} & parts - {0}
        )
        axis = (one.camera_T_part[0] @ np.append(one.thing.axis[true], 0))[:3]
        swapped = -1.0 if int(one.true_of[0]) == one.thing.category.joints[true].child else 1.0
        sense = swapped * (1.0 if axis @ one.twin.axis[j] >= 0 else -1.0)
        wanted[joint.name] = made.state[joint.name] + sense * float(moved[true])
    return wanted


def simulated(urdf: Path, *, fixed: bool) -> tuple[Any, Any]:
    """Robot and scene in SAPIEN, under gravity."""
    import sapien

    scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    scene.set_timestep(1 / 240)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = fixed
    builder = loader.load_file_as_articulation_builder(str(urdf))
    for link in builder.link_builders:
        link.visual_records.clear()  # they need a renderer
    return builder.build(), scene


def drives(urdf: Path) -> bool:
    """Whether SAPIEN loads it and its joints go from end to end and back as they are told."""
    robot, scene = simulated(urdf, fixed=True)
    low, high = robot.get_qlimits().T
    for joint in robot.active_joints:
        joint.set_drive_properties(stiffness=4000, damping=130, mode="acceleration")
    for end, start in ((high, low), (low, high)):
        for share in [*np.linspace(0, 1, 180), *[1.0] * 120]:
            for k, joint in enumerate(robot.active_joints):
                joint.set_drive_target(float(start[k] + share * (end[k] - start[k])))
            scene.step()
        if not (np.abs(robot.qpos - end) < 0.05 * (high - low) + 0.01).all():
            return False
    return True


def rests(urdf: Path, state: dict[str, float]) -> bool:
    """Whether it falls onto a floor, joints loose, and lies there after `FALL` seconds."""
    robot, scene = simulated(urdf, fixed=False)
    low, high = robot.get_qlimits().T
    robot.set_qpos(np.array([state[joint.name] for joint in robot.active_joints]))
    bounds = np.array([link.compute_global_aabb_tight() for link in robot.links])
    size = float(np.linalg.norm(bounds[:, 1].max(0) - bounds[:, 0].min(0)))
    scene.add_ground(float(bounds[:, 0, 2].min()) - 0.1 * size, render=False)
    for _ in range(int(FALL * 240)):
        scene.step()
        over = np.maximum(low - robot.qpos, robot.qpos - high).max()
        speed = np.linalg.norm(robot.root_linear_velocity)
        if not (over < 0.1 and speed < 10 * np.sqrt(9.81 * size) + 1):  # NaN is neither
            return False
    still = np.linalg.norm(robot.root_linear_velocity) < 0.1 * np.sqrt(9.81 * size)
    return bool(still and np.abs(robot.qvel).max() < 0.5)


def measure(category: str, found: list[Sample]) -> str:
    """The row of a category."""
    loaded = driven = rested = 0
    errors = []
    with tempfile.TemporaryDirectory() as folder:
        for k, one in enumerate(found):
            urdf = write_twin(one.twin, Path(folder) / str(k))[0]
            errors.append(chamfers(one, urdf))
            loaded += 1  # by yourdfpy, in `chamfers`
            driven += drives(urdf)
            rested += rests(urdf, articulated(one.twin).state)
    table = np.array(errors)
    straight = sum(one.direction <= HINGE for one in found)
    near = sum(one.pivot <= PIVOT for one in found)
    return (
        f"{category:11s} {len(found):4d} {straight:6d} {near:6d} {driven:7d} {rested:7d} "
        f"{loaded:9d}   "
        f"{table[:, 0].mean():6.2f} {table[:, 0].max():6.2f}   "
        f"{table[:, 1:].mean():6.2f} {table[:, 1:].max():6.2f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("category", nargs="+")
    parser.add_argument("--split", default="test")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--model")
    parser.add_argument("--source", type=Path)
    parser.add_argument("--bare", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print("category       n  hinge  pivot  SAPIEN   rests  yourdfpy  as observed    other states")
    for category in given.category:
        split = open_split(given.data, category, given.split)
        print(measure(category, samples(split, given)), flush=True)


if __name__ == "__main__":
    main()
