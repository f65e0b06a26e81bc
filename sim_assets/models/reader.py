# SPDX-License-Identifier: MIT
"""Any URDF folder to an `ArticulatedObject`: find, select by split, read.

    for urdf in select(find(source), "train", root=source):
        thing = read(urdf, "oven", root=source)

`read` does one model: parse and repair (`parse`), surfaces (`meshes`), the category's joints and
their rest (`joints`), the object frame (`frames`), final checks (`validate`); all of it within the
memory and time that `limits` allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.visual import TextureVisuals

from scapo.categories import Category
from scapo.categories import category as find_category
from scapo.geometry.matrices import moved
from sim_assets.models import frames
from sim_assets.models.account import account
from sim_assets.models.frames import Vector
from sim_assets.models.joints import (
    Reduction,
    Rest,
    Surfaces,
    exchanged,
    find_rest,
    reduce,
    reordered,
)
from sim_assets.models.library import INNER, find, instance_id, select
from sim_assets.models.limits import bounded
from sim_assets.models.meshes import load_links, remade
from sim_assets.models.parse import parse
from sim_assets.models.resolver import SourceFiles
from sim_assets.models.robot import Robot
from sim_assets.models.sides import used_vertices
from sim_assets.models.sources import GENERIC, Traits, traits
from sim_assets.models.validate import Repairs, check_object, check_poses, check_robot, refuse
from sim_assets.objects import Account, ArticulatedObject, Origin, Visual

__all__ = ["find", "instance_id", "read", "select"]

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model:
    """A model as its files describe it."""

    robot: Robot
    surfaces: Surfaces
    known: Traits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Resting:
    """A model at rest, in coordinates of the root link and asset units."""

    model: Model
    reduction: Reduction
    rests: tuple[Rest, ...]
    poses: dict[str, Pose]
    parts: tuple[tuple[Visual, ...], ...]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    """Positive motion opens: of the moving part as seen from the base."""

    def bounds(self, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "P 2 3"]:
        """Of each part, in axes turned by `rotation`."""
        points = [self.points(part) @ rotation.T for part in range(len(self.parts))]
        return np.stack([np.stack([p.min(0), p.max(0)]) for p in points])

    def points(self, part: int) -> Float[np.ndarray, "N 3"]:
        """Vertices that a part's triangles use."""
        meshes = [visual.mesh for visual in self.parts[part]]
        return np.concatenate([mesh.vertices[used_vertices(mesh.faces)] for mesh in meshes])


def read(
    urdf: Path,
    category: str | Category,
    *,
    up: str | None = None,
    front: str | None = None,
    scale: float | None = None,
    root: Path | None = None,
) -> ArticulatedObject:
    """Read one model as an object of a category.

    Args:
        urdf: The file.
        category: One of `scapo.categories.CATEGORIES`, or another.
        up: Which axis of the URDF's root link is up, such as "z" or "-y"; by the source if None.
        front: Which axis the front faces; by the source, else told from the joint, if None.
        scale: Metres per unit of the URDF; by the source if None.
        root: The source folder: no file outside of it is opened, instance ids are relative to it.
            By default the model's own folder, or package.

    Returns:
        The object, in the object frame at rest.

    Raises:
        AssetError: The model cannot be used; the message says why.
        ValueError: No such category.
    """
    spec = category if isinstance(category, Category) else find_category(category)
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise refuse(urdf, "a scale above zero", f"{scale}")
    files = SourceFiles(urdf=urdf, root=root or package_root(urdf), repairs=Repairs())
    with bounded(urdf):
        return _read(files, spec, up, front, scale)


def _read(
    files: SourceFiles, spec: Category, up: str | None, front: str | None, scale: float | None
) -> ArticulatedObject:
    urdf, model = files.urdf, load(files)
    reduction = reduce(model.robot, model.surfaces, spec, model.known)
    upward = _upward(model, reduction, spec, up, files.repairs)
    rests = find_rest(model.robot, model.surfaces, reduction, spec, upward)
    resting = _resting(model, reduction, rests)
    rotation = _rotation(resting, spec, upward, (up, front), files.repairs)
    resting = _ordered(resting, spec, rotation)
    bounds = resting.bounds(rotation)
    low, high = bounds[:, 0].min(0), bounds[:, 1].max(0)
    size = float(np.linalg.norm(high - low))
    ratio = frames.metres_per_unit(spec, size, model.known.metric, scale, files.repairs)
    similarity = np.eye(4)
    similarity[:3, :3] = ratio * rotation
    similarity[:3, 3] = -ratio * (low + high) / 2
    thing = _object(resting, spec, similarity, files)
    check_object(urdf, thing)
    return thing


def load(files: SourceFiles) -> Model:
    """Parse a URDF and load its surfaces, checked but not yet brought to any category.

    Raises:
        AssetError: The model cannot be used.
    """
    if not files.is_inside(files.urdf):
        raise refuse(files.urdf, f"a file inside the folder {files.root.name!r}", "one outside")
    if not all(part.isprintable() for part in files.urdf.parts[len(files.root.parts) :]):
        raise refuse(files.urdf, "names that can be printed", "others")
    with bounded(files.urdf):
        robot = parse(files.urdf, files.repairs)
        known = traits(robot)
        check_robot(files.urdf, robot, known.remark)
        check_poses(files.urdf, robot.poses({}))
        for file in (files.urdf, *known.files):
            files.read(file)
        return Model(robot=robot, surfaces=load_links(robot, files), known=known)


def package_root(urdf: Path) -> Path:
    """The folder that holds all files of a model when the caller names none.

    That of the URDF; above a folder `urdf` or `robots`, the package, and for `package://` names
    its parent.
    """
    folder = urdf.resolve().parent
    return folder.parent.parent if folder.name in INNER else folder


def _upward(
    model: Model, reduction: Reduction, category: Category, up: str | None, repairs: Repairs
) -> Vector:
    """Unit, root link: by the caller, then the source, then the joint where none is known."""
    path, known = model.robot.path, model.known
    usual = frames.direction(up or known.up, path)
    if up is not None or known.set_name != GENERIC:
        return usual
    poses = model.robot.poses({})
    axis = np.stack([poses[joint.child][:3, :3] @ joint.axis for joint in reduction.joints])
    told = frames.told_up(category, usual, axis)
    if not np.array_equal(told, usual):
        repairs.add(f"What is up was told from the joint: {frames.name_of(told)}")
    return told


def _resting(model: Model, reduction: Reduction, rests: tuple[Rest, ...]) -> _Resting:
    robot, surfaces = model.robot, model.surfaces
    names = [joint.name for joint in reduction.joints]
    poses = robot.poses({n: r.position for n, r in zip(names, rests, strict=True)})
    rows = zip(reduction.joints, rests, reduction.inverted, strict=True)
    axes = [
        poses[joint.child][:3, :3] @ joint.axis * rest.direction * (-1.0 if inverted else 1.0)
        for joint, rest, inverted in rows
    ]
    parts = tuple(
        tuple(
            _moved(visual, poses[name])
            for name in robot.links
            if name in part
            for visual in surfaces.get(name, ())
        )
        for part in reduction.parts
    )
    return _Resting(
        model=model,
        reduction=reduction,
        rests=rests,
        poses=poses,
        parts=parts,
        pivot=np.stack([poses[joint.child][:3, 3] for joint in reduction.joints]),
        axis=np.stack(axes),
    )


def _rotation(
    resting: _Resting,
    category: Category,
    upward: Vector,
    wanted: tuple[str | None, str | None],
    repairs: Repairs,
) -> Float[np.ndarray, "3 3"]:
    """object_R_asset: by the caller, then a joint that is sure, then the source, then the joint."""
    path, known = resting.model.robot.path, resting.model.known
    if category.name == "scissors":
        return _along_blades(resting, upward, wanted[1])
    if wanted[1] is not None:
        return frames.basis(upward, frames.direction(wanted[1], path), path)
    middle = resting.bounds(np.eye(3))[1:].mean(1)
    told = frames.told_front(category, upward, resting.pivot, resting.axis, middle)
    usual = frames.direction(known.front or "-x", path)
    if known.front is not None and wanted[0] is None and not told.sure:
        return frames.basis(upward, usual, path)
    if not np.array_equal(told.front, usual):
        repairs.add(f"The front was told from the joint: {frames.name_of(told.front)}")
    return frames.basis(upward, told.front, path)


def _along_blades(resting: _Resting, upward: Vector, front: str | None) -> Float[np.ndarray, "3 3"]:
    """Scissors: z along the axis towards up, x along the closed blades, tips towards +x."""
    normal = resting.axis[0]
    if normal @ upward < -1e-6:
        normal = -normal
    parts = [resting.points(part) - resting.pivot[0] for part in range(2)]
    along = frames.blades(parts, normal)
    if front is not None and along @ frames.direction(front, resting.model.robot.path) > 0:
        along = -along
    return np.stack([along, np.cross(normal, along), normal])


def _ordered(resting: _Resting, category: Category, rotation: Float[np.ndarray, "3 3"]) -> _Resting:
    """Parts by where they are; the scissors blade from which the other opens about -z."""
    reduction, rests = resting.reduction, resting.rests
    if category.name == "scissors" and (rotation @ resting.axis[0])[2] > 0:
        return _resting(resting.model, exchanged(reduction), rests)
    order = frames.order(category, resting.bounds(rotation)[1:].mean(1))
    if order == sorted(order):
        return resting
    moved_rests = tuple(rests[k] for k in order)
    return _resting(resting.model, reordered(reduction, order), moved_rests)


def _object(
    resting: _Resting, category: Category, object_T_asset: Pose, files: SourceFiles
) -> ArticulatedObject:
    ratio = float(np.cbrt(np.linalg.det(object_T_asset[:3, :3])))
    rotation = object_T_asset[:3, :3] / ratio
    visuals = tuple(
        _merged([_moved(visual, object_T_asset) for visual in part]) for part in resting.parts
    )
    pivot = moved(resting.pivot, object_T_asset)
    upper = np.array([rest.upper for rest in resting.rests])
    for j, spec in enumerate(category.joints):
        if spec.kind == "prismatic":
            bounds = np.concatenate([visual.mesh.bounds for visual in visuals[j + 1]])
            pivot[j] = (bounds.min(0) + bounds.max(0)) / 2
            upper[j] *= ratio
        upper[j] = min(upper[j], spec.upper)
    joints = resting.reduction.joints
    at = {joint.name: rest.position for joint, rest in zip(joints, resting.rests, strict=True)}
    axis = resting.axis @ rotation.T
    return ArticulatedObject(
        category=category,
        instance=instance_id(files.urdf, files.root),
        visuals=visuals,
        pivot=pivot,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        upper=upper,
        origin=Origin(
            source=files.urdf.resolve().relative_to(files.root.resolve()).as_posix(),
            sha256=files.digest(),
            object_T_asset=object_T_asset,
            rest={name: float(q) for name, q in resting.model.robot.positions(at).items()},
            joint_names=tuple(joint.name for joint in joints),
            sign=tuple(rest.direction for rest in resting.rests),
            repairs=files.repairs.sentences(),
            account=_told(resting, category, visuals, ratio),
        ),
    )


def _told(
    resting: _Resting, category: Category, parts: tuple[tuple[Visual, ...], ...], ratio: float
) -> Account:
    bounds = np.concatenate([visual.mesh.bounds for part in parts for visual in part])
    sides = bounds.max(0) - bounds.min(0)
    model = resting.model
    return account(model.robot, model.known, resting.reduction, category, sides, ratio)


def _moved(visual: Visual, a_T_b: Pose) -> Visual:
    vertices = moved(np.asarray(visual.mesh.vertices), a_T_b)
    return Visual(mesh=remade(visual.mesh, vertices, visual.mesh.faces), color=visual.color)


def _merged(visuals: list[Visual]) -> tuple[Visual, ...]:
    """Untextured surfaces of one colour as one: renderers pay for each."""
    groups: dict[object, list[Visual]] = {}
    for k, visual in enumerate(visuals):
        textured = isinstance(visual.mesh.visual, TextureVisuals)
        groups.setdefault(k if textured else visual.color, []).append(visual)
    return tuple(_joined(group) for group in groups.values())


def _joined(visuals: list[Visual]) -> Visual:
    if len(visuals) == 1:
        return visuals[0]
    meshes = [visual.mesh for visual in visuals]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    mesh = trimesh.Trimesh(vertices, np.concatenate(faces), process=False, validate=False)
    return Visual(mesh=mesh, color=visuals[0].color)
