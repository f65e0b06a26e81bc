# SPDX-License-Identifier: MIT
"""A twin as links and joints: parts as closed meshes at state 0, in the frame of the root.

The root link is the category's part 0 and its frame is `Twin.camera_T_part[0]`: of a model whose
frames were calibrated the object frame (z up, front towards -x), else the model's own. Parts are
brought to state 0 along their joints, so that the observed states put back what was observed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bench.twin.record import Twin
from bench.twin.surface import Samples, closed_mesh, joined, seen_samples
from scapo.categories import JointKind
from scapo.drawing import PART_COLORS
from scapo.export.urdf import DENSITY, RGBA, Inertia, Joint, Link, Surface
from scapo.geometry.matrices import moved

LEAST_MASS = 1e-3
"""kg."""
LEAST_GYRATION = 1e-5
"""m2, added to the moments of a kilogram: those of a box of 8 mm, so that none is degenerate."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Articulated:
    """What `scapo.export` writes, and where it was seen."""

    links: tuple[Link, ...]
    """One per part, the root first; without surfaces where nothing of the part is known."""
    joints: tuple[Joint, ...]
    """In the order of the category's."""
    state: dict[str, float]
    """As observed, by joint."""
    camera_T_root: Float[np.ndarray, "4 4"]


@lru_cache(maxsize=2)
def articulated(twin: Twin) -> Articulated:
    """Its surfaces, inertias and joints. The latest two are kept, for files and page alike."""
    names = [link_name(part) for part in twin.category.parts]
    root_T_camera = root_from_camera(twin)
    links = tuple(_link(twin, part, name, root_T_camera[part]) for part, name in enumerate(names))
    joints = tuple(
        Joint(
            name=f"{names[spec.child]}_joint",
            kind=spec.kind,
            parent=names[spec.parent],
            child=names[spec.child],
            pivot=moved(twin.pivot[j].astype(float), root_T_camera[spec.child]),
            axis=_unit(root_T_camera[spec.child][:3, :3] @ twin.axis[j]),
            lower=float(twin.limits[j, 0]),
            upper=float(twin.limits[j, 1]),
        )
        for j, spec in enumerate(twin.category.joints)
    )
    return Articulated(
        links=links,
        joints=joints,
        state={joint.name: float(twin.state[j]) for j, joint in enumerate(joints)},
        camera_T_root=twin.camera_T_part[0].astype(float),
    )


def link_name(part: str) -> str:
    """A part's name as URDF files have it."""
    return re.sub(r"[^\w.-]+", "_", part)


def root_from_camera(twin: Twin) -> Float[np.ndarray, "P 4 4"]:
    """What takes each part from where it was observed to state 0, in the root's frame."""
    moves = np.tile(
        np.linalg.inv(twin.camera_T_part[0].astype(float)), (len(twin.camera_T_part), 1, 1)
    )
    for j, spec in enumerate(twin.category.joints):
        back = motion(twin.pivot[j], twin.axis[j], -float(twin.state[j]), spec.kind)
        moves[spec.child] = moves[spec.parent] @ back
    return moves


def motion(
    pivot: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"], state: float, kind: JointKind
) -> Float[np.ndarray, "4 4"]:
    """What a joint does to its part, in the frame of pivot and axis."""
    made, unit = np.eye(4), _unit(axis)
    if kind == "prismatic":
        made[:3, 3] = unit * state
        return made
    made[:3, :3] = Rotation.from_rotvec(unit * state).as_matrix()
    made[:3, 3] = pivot - made[:3, :3] @ pivot
    return made


def _unit(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return vector.astype(float) / np.linalg.norm(vector)


def _link(twin: Twin, part: int, name: str, root_T_camera: Float[np.ndarray, "4 4"]) -> Link:
    samples = _samples(twin, part, root_T_camera)
    if not len(samples.points):
        centre = root_T_camera[:3, 3]
        tiny = LEAST_MASS * LEAST_GYRATION * np.eye(3)
        return Link(
            name=name,
            surfaces=(),
            inertia=Inertia(mass=LEAST_MASS, centre=np.zeros_like(centre), moments=tiny),
        )
    mesh = closed_mesh(samples)
    hull = mesh.convex_hull
    return Link(
        name=name,
        surfaces=(Surface(vertices=mesh.vertices, faces=mesh.faces, color=_color(twin, part)),),
        collision=(Surface(vertices=hull.vertices, faces=hull.faces),),
        inertia=inertia(mesh),
    )


def _samples(twin: Twin, part: int, root_T_camera: Float[np.ndarray, "4 4"]) -> Samples:
    """What is known of a part's surface at state 0, in the root's frame."""
    none = Samples(points=np.zeros((0, 3)), normals=np.zeros((0, 3)))
    model = seen = none
    own = twin.part == part
    if own.any():
        points = moved(twin.points[own].astype(float), root_T_camera)
        seen = seen_samples(points, root_T_camera[:3, 3])
    if twin.shape is not None and (own := twin.shape.part == part).any():
        model = Samples(
            points=moved(twin.shape.points[own].astype(float), root_T_camera),
            normals=twin.shape.normals[own].astype(float) @ root_T_camera[:3, :3].T,
        )
    return joined(model, seen)


def inertia(mesh: trimesh.Trimesh) -> Inertia:
    """Of a closed mesh filled at `DENSITY`, at least `LEAST_MASS` and never degenerate."""
    volume = float(mesh.volume)
    mass = max(DENSITY * volume, LEAST_MASS)
    moments = np.asarray(mesh.moment_inertia) / (mesh.density * volume)
    return Inertia(
        mass=mass,
        centre=np.asarray(mesh.center_mass, float),
        moments=mass * (moments + LEAST_GYRATION * np.eye(3)),
    )


def _color(twin: Twin, part: int) -> RGBA:
    """The mean of what was observed, else the part's own."""
    own = twin.part == part
    if twin.color is not None and own.any():
        red, green, blue = (twin.color[own].mean(0) / 255).tolist()
    else:
        text = PART_COLORS[part % len(PART_COLORS)]
        red, green, blue = (value / 255 for value in bytes.fromhex(text[1:]))
    return red, green, blue, 1.0
