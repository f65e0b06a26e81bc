# SPDX-License-Identifier: MIT
"""Write an articulated object as a folder with a URDF and OBJ meshes (`glb`: as one GLB).

Knows nothing of where the object came from: links carry surfaces in one common frame at rest (the
root link's), joints their pivot and axis in that frame. Every joint is written with its pivot as
origin and no rotation; so the root link's frame is the common frame, and zero is the state in
which the surfaces are given: rest, where limits start at 0. Equal input gives equal bytes; a folder
appears under its name only when complete.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from jaxtyping import Float, Int

from scapo.categories import JointKind
from scapo.store.folders import whole_folder

RGBA = tuple[float, float, float, float]
Vector = Float[np.ndarray, "3"]
DENSITY = 300.0
"""kg/m3, of the bounding box of a link: furniture and appliances are mostly air."""
BOTH_SIDES = "# nothing to add: open surfaces have both sides"
"""First line of an OBJ that is but a piece of a surface, so that it does not show what is open."""
_SOLID = "-collision"
"""In the names of meshes that are there for collisions alone."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """One triangle mesh of a link."""

    vertices: Float[np.ndarray, "N 3"]
    """Metres, in the root link's frame at rest."""
    faces: Int[np.ndarray, "F 3"]
    """Counter-clockwise seen from outside."""
    color: RGBA = (0.7, 0.7, 0.7, 1.0)
    """sRGB."""
    piece: bool = False
    """Of a surface that others close, or that has its reverse beside it where it is open."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inertia:
    """Mass and its distribution, in the root link's frame at rest."""

    mass: float
    """kg, greater than 0."""
    centre: Vector
    """Of mass, m."""
    moments: Float[np.ndarray, "3 3"]
    """About the centre, kg m2; positive definite."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Link:
    """A rigid part."""

    name: str
    surfaces: tuple[Surface, ...]
    collision: tuple[Surface, ...] | None = None
    """What it collides with; None: its surfaces."""
    inertia: Inertia | None = None
    """None: of its bounding box at a nominal density."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Joint:
    """One joint between two links; its state runs from `lower` to `upper`."""

    name: str
    kind: JointKind
    parent: str
    child: str
    pivot: Vector
    """In the root link's frame at rest, m."""
    axis: Vector
    upper: float
    """rad or m."""
    effort: float = 50.0
    """N m or N."""
    velocity: float = 2.0
    """rad/s or m/s."""
    lower: float = 0.0
    """rad or m; below 0 where the surfaces are not given at a limit."""
    endless: bool = False
    """A hinge without limits, which then say nothing."""


def write_urdf(
    folder: Path, links: Sequence[Link], joints: Sequence[Joint], name: str = "object"
) -> Path:
    """Write `folder/mobility.urdf` and `folder/meshes/*.obj`.

    A folder that this function wrote before, and that nobody has changed since, is replaced.

    Args:
        folder: Its name becomes visible only when all files are written.
        links: The root first.
        joints: A tree over the links.
        name: Of the robot.

    Returns:
        The path of `mobility.urdf`.

    Raises:
        ValueError: Names that repeat or are unknown, links that are no tree, bad numbers; a file, a
            link or somebody else's folder in the way, which is left alone.
    """
    _check(folder, links, joints)
    with whole_folder(folder) as temporary:
        write_files(temporary, links, joints, name)
    return folder / "mobility.urdf"


def write_files(
    folder: Path, links: Sequence[Link], joints: Sequence[Joint], name: str = "object"
) -> list[Path]:
    """The same into a folder that is there, beside what it holds; returns the files, URDF first.

    Args:
        folder: Without a folder `meshes`.
        links: As for `write_urdf`.
        joints: As for `write_urdf`.
        name: Of the robot.

    Raises:
        ValueError: As `write_urdf`.
    """
    _check(folder, links, joints)
    (folder / "meshes").mkdir()
    frames = link_origins(links, joints)
    written = [folder / "mobility.urdf"]
    text = urdf_text(links, joints, name)
    written[0].write_text(text, encoding="utf-8", newline="\n")
    for link in links:
        for file, surface in _meshes(link):
            text = f"{BOTH_SIDES}\n" if surface.piece else ""
            text += obj_text(surface.vertices - frames[link.name], surface.faces)
            (folder / file).write_text(text, encoding="ascii")
            written.append(folder / file)
    return written


def _check(folder: Path, links: Sequence[Link], joints: Sequence[Joint]) -> None:
    names = [link.name for link in links] + [joint.name for joint in joints]
    distinct = len(set(names)) == len(names)
    if not links or not distinct or not all(re.fullmatch(r"[\w.-]+", name) for name in names):
        raise ValueError(
            f"{folder}: expected distinct names of letters, digits, '_', '.', '-' for at least one "
            f"link and every joint, found {names}"
        )
    for link in links:
        for surface in link.surfaces:
            if not len(surface.faces) or not np.isfinite(surface.vertices).all():
                raise ValueError(f"{folder}: link {link.name!r}: expected finite, non-empty meshes")
    reached = {links[0].name}
    for joint in joints:
        _check_joint(folder, joint, reached)
        reached.add(joint.child)
    if missing := sorted({link.name for link in links} ^ reached):
        raise ValueError(f"{folder}: expected one tree over the links, found {missing} outside it")


def _check_joint(folder: Path, joint: Joint, reached: set[str]) -> None:
    if joint.parent not in reached or joint.child in reached:
        raise ValueError(
            f"{folder}: joint {joint.name!r}: expected a parent nearer to the root and a new "
            f"child, found {joint.parent!r} -> {joint.child!r}"
        )
    size, travel = float(np.linalg.norm(joint.axis)), joint.upper - joint.lower
    if not (abs(size - 1) < 1e-4 and np.isfinite(joint.pivot).all() and travel > 0):
        raise ValueError(
            f"{folder}: joint {joint.name!r}: expected a unit axis, a finite pivot and a "
            f"travel > 0, found axis norm {size:.4g}, pivot {joint.pivot}, travel {travel}"
        )


def link_origins(links: Sequence[Link], joints: Sequence[Joint]) -> dict[str, Vector]:
    """Origin of each link's frame at rest, in the root's frame."""
    origins = {links[0].name: np.zeros(3)}
    return origins | {joint.child: np.asarray(joint.pivot, float) for joint in joints}


def _mesh_name(link: Link, number: int, use: str = "") -> str:
    return f"meshes/{link.name}{use}-{number}.obj"


def _meshes(link: Link) -> list[tuple[str, Surface]]:
    """The surfaces of a link, those that it collides with too, by file."""
    shown = [(_mesh_name(link, k), surface) for k, surface in enumerate(link.surfaces)]
    solid = enumerate(link.collision or ())
    return shown + [(_mesh_name(link, k, _SOLID), surface) for k, surface in solid]


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    """Shortest decimals within 1e-9, no negative zeros."""
    rounded = np.round(np.asarray(values, float), 9) + 0.0
    return " ".join(np.format_float_positional(value, trim="-") for value in rounded)


def obj_text(vertices: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "F 3"]) -> str:
    """A Wavefront OBJ: nine decimals of a metre, faces counted from 1."""
    rounded = np.round(np.asarray(vertices, float), 9) + 0.0
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in rounded.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
    return "\n".join(lines) + "\n"


def urdf_text(links: Sequence[Link], joints: Sequence[Joint], name: str = "object") -> str:
    """The XML of `mobility.urdf`; meshes are named relative to it."""
    robot = Element("robot", name=name)
    frames = link_origins(links, joints)
    for link in links:
        _add_link(robot, link, frames[link.name])
    for joint in joints:
        kind = "continuous" if joint.endless else joint.kind
        node = SubElement(robot, "joint", name=joint.name, type=kind)
        SubElement(node, "parent", link=joint.parent)
        SubElement(node, "child", link=joint.child)
        SubElement(node, "origin", xyz=_numbers(joint.pivot - frames[joint.parent]), rpy="0 0 0")
        SubElement(node, "axis", xyz=_numbers(joint.axis))
        SubElement(node, "limit", _limits(joint))
        SubElement(node, "dynamics", damping="0.1", friction="0.1")
    indent(robot)
    return '<?xml version="1.0"?>\n' + tostring(robot, encoding="unicode") + "\n"


def _limits(joint: Joint) -> dict[str, str]:
    """Attributes of `<limit>`; an endless joint has no ends."""
    ends = {"lower": _numbers([joint.lower]), "upper": _numbers([joint.upper])}
    force = {"effort": _numbers([joint.effort]), "velocity": _numbers([joint.velocity])}
    return force if joint.endless else ends | force


def _add_link(robot: Element, link: Link, origin: Vector) -> None:
    node = SubElement(robot, "link", name=link.name)
    if link.surfaces or link.inertia is not None:
        _add_inertial(node, _inertia(link, origin))
    for number, surface in enumerate(link.surfaces):
        visual = SubElement(node, "visual", name=f"{link.name}-{number}")
        _add_mesh(visual, _mesh_name(link, number))
        material = SubElement(visual, "material", name=f"{link.name}-{number}-color")
        SubElement(material, "color", rgba=_numbers(np.round(surface.color, 4)))
    use = "" if link.collision is None else _SOLID
    for number in range(len(link.surfaces if link.collision is None else link.collision)):
        collision = SubElement(node, "collision", name=f"{link.name}-{number}")
        _add_mesh(collision, _mesh_name(link, number, use))


def _add_mesh(node: Element, file: str) -> None:
    SubElement(node, "origin", xyz="0 0 0", rpy="0 0 0")
    geometry = SubElement(node, "geometry")
    SubElement(geometry, "mesh", filename=file, scale="1 1 1")


def box_inertia(points: Float[np.ndarray, "N 3"]) -> tuple[float, Vector, Vector]:
    """Mass (kg), centre and principal moments (kg m2) of the box about points, along its sides.

    At a nominal density; at least 1 g and 1 cm.
    """
    size = np.maximum(np.ptp(points, axis=0), 0.01)
    mass = max(DENSITY * float(np.prod(size)), 1e-3)
    return mass, (points.min(0) + points.max(0)) / 2, mass / 12 * (np.sum(size**2) - size**2)


def _inertia(link: Link, origin: Vector) -> Inertia:
    """In the link's own frame; where it has none, that of its bounding box."""
    if link.inertia is not None:
        return replace(link.inertia, centre=link.inertia.centre - origin)
    points = np.concatenate([surface.vertices for surface in link.surfaces]) - origin
    mass, centre, moments = box_inertia(points)
    return Inertia(mass=mass, centre=centre, moments=np.diag(moments))


def _add_inertial(node: Element, body: Inertia) -> None:
    inertial = SubElement(node, "inertial")
    SubElement(inertial, "origin", xyz=_numbers(body.centre), rpy="0 0 0")
    SubElement(inertial, "mass", value=_numbers([body.mass]))
    SubElement(inertial, "inertia", {name: _moment(body.moments[at]) for name, at in _MOMENTS})


_MOMENTS = (
    ("ixx", (0, 0)),
    ("ixy", (0, 1)),
    ("ixz", (0, 2)),
    ("iyy", (1, 1)),
    ("iyz", (1, 2)),
    ("izz", (2, 2)),
)


def _moment(value: float) -> str:
    return np.format_float_scientific(value, precision=6) if value else "0"
