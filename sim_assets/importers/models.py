# SPDX-License-Identifier: MIT
"""What the readers of foreign models share: folders are found, bodies joined by hinges.

A reader brings one folder to the `links` and `joints` of `scapo.export.urdf`, in the coordinates
and units of its files; `sets` writes them.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scapo.categories import CATEGORIES, Category
from scapo.export.urdf import Joint, Link, Surface
from scapo.geometry.matrices import moved
from sim_assets.importers.records import Mesh, Vector
from sim_assets.models.joints import hull_area, hull_points
from sim_assets.models.validate import refuse
from sim_assets.objects import joint_motion

STEPS = 91
MAX_WORD = 200
"""Characters of the name of a file or link."""
CLOSED = 0.35
"""Of the hull's range over a turn, above its smallest: a thick door or lid that is pushed into its
body makes the hull smaller still, while a laptop that stands open by 30 degrees comes to more."""
CLEARLY = 0.1
"""Of the hull's range over a turn: less says nothing about which way opens."""
OUR_NAMES = {
    "washing_machine": "washer",
    "washingmachine": "washer",
    "laptop_h": "laptop",
    "laptop_m": "laptop",
    "scissor": "scissors",
}
"""Names of sets -> ours, where they differ in more than case."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Folder:
    """One model of a set."""

    path: Path
    name: str
    """Relative to what was searched, for messages."""
    category: str
    """Ours where the set's name is one of ours, else the set's in snake_case."""
    id: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Model:
    """A model as `scapo.export.urdf.write_urdf` takes it."""

    name: str
    """Of the robot; begins with the set's name."""
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    notes: tuple[str, ...] = ()
    """What was put right or left out, one sentence each."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """What moves as one."""

    name: str
    meshes: tuple[Mesh, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hinge:
    """How body `child` turns against body `parent`."""

    parent: int
    child: int
    pivot: Vector
    axis: Vector
    """Unit."""
    limits: tuple[float, float] | None
    """rad from how the meshes are given; None: the set does not say."""


def our_category(name: str) -> str:
    """A set's category by our name for it, else in snake_case.

    >>> our_category("WashingMachine"), our_category("Laptop"), our_category("StorageFurniture")
    ('washer', 'laptop', 'storage_furniture')
    """
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip()).lower()
    word = re.sub(r"[^a-z0-9_]+", "_", snake).strip("_") or "models"
    return OUR_NAMES.get(word, word)


def safe_word(text: str) -> str:
    """Letters, digits, `_`, `.` and `-` of ASCII, as names of files and links; not too many."""
    word = re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("._") or "x"
    if len(word) <= MAX_WORD:
        return word
    return f"{word[:80]}-{hashlib.sha256(os.fsencode(text)).hexdigest()[:8]}"


def find_folders(path: Path, marks: Collection[str]) -> list[Folder]:
    """Folders below (or at) a path that hold one of the names `marks`, sorted.

    Their own name is the id, that of the folder above the category. Names that begin with "." are
    left alone, and links to folders are not followed.

    Raises:
        AssetError: No such folder, or none in it.
    """
    if not path.is_dir():
        raise refuse(path, "a folder", "a file" if path.exists() else "nothing")
    found = []
    for here, below, names in os.walk(path):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if not set(marks).isdisjoint((*names, *below)):
            found.append(_folder(Path(here), path))
            below.clear()
    if not found:
        raise refuse(path, f"folders with {' or '.join(sorted(marks))}", "none")
    return sorted(found, key=lambda folder: folder.path.parts)


def _folder(here: Path, root: Path) -> Folder:
    full = here.resolve()
    return Folder(
        path=here,
        name=here.relative_to(root).as_posix() if here != root else full.name,
        category=our_category(full.parent.name),
        id=safe_word(full.name),
    )


def joined(
    bodies: Sequence[Body], hinges: Sequence[Hinge], category: str
) -> tuple[tuple[Link, ...], tuple[Joint, ...]]:
    """Links and joints of bodies on hinges; limits that a set does not give are told.

    Args:
        bodies: The base first.
        hinges: Those nearer to the base first.
        category: Tells the travel where the set does not; unknown ones turn without end.
    """
    links = tuple(
        Link(
            name=body.name,
            surfaces=tuple(Surface(vertices=m.vertices, faces=m.faces) for m in body.meshes),
        )
        for body in bodies
    )
    points = [_hull(body) for body in bodies]
    joints = []
    for number, hinge in enumerate(hinges):
        others = np.concatenate([p for k, p in enumerate(points) if k != hinge.child])
        limits = hinge.limits or told_limits(hinge, others, points[hinge.child], category)
        joints.append(
            Joint(
                name=f"joint_{number}",
                kind="revolute",
                parent=bodies[hinge.parent].name,
                child=bodies[hinge.child].name,
                pivot=hinge.pivot,
                axis=hinge.axis,
                lower=limits[0] if limits else -math.pi,
                upper=limits[1] if limits else math.pi,
                endless=limits is None,
            )
        )
    return links, tuple(joints)


def _hull(body: Body) -> Float[np.ndarray, "N 3"]:
    return hull_points(np.concatenate([mesh.vertices for mesh in body.meshes]))


def told_limits(
    hinge: Hinge,
    still: Float[np.ndarray, "N 3"],
    moving: Float[np.ndarray, "M 3"],
    category: str,
) -> tuple[float, float] | None:
    """Limits of a hinge that has none, by the category's travel and the shape.

    Where the model is closed as given (the hull of the whole is about the smallest), it opens from
    0: towards where the hull grows more, if that is clear, else towards positive angles. Else it
    is given open, and the limits run from the angle that closes it. Temples, which rest unfolded,
    fold towards positive angles.

    Returns:
        Lower and upper in rad, or None for a category that is not ours.
    """
    spec: Category | None = CATEGORIES.get(category)
    if spec is None or spec.joints[0].kind != "revolute":
        return None
    travel = spec.joints[0].upper
    if spec.rest != "smallest-box":
        return 0.0, travel

    def area(angle: float) -> float:
        turned = moved(moving, joint_motion(hinge.pivot, hinge.axis, angle, "revolute"))
        return hull_area(np.concatenate([still, turned]))

    angles = np.linspace(-travel, travel, STEPS)
    areas = np.array([area(angle) for angle in angles])
    spread = float(np.ptp(areas))
    if areas[STEPS // 2] <= areas.min() + CLOSED * spread:
        gain = areas[STEPS // 2 + 1 :].mean() - areas[: STEPS // 2].mean()
        return (-travel, 0.0) if gain < -CLEARLY * spread else (0.0, travel)
    closed = float(angles[areas.argmin()])
    fine = closed + np.linspace(-1, 1, 41) * (angles[1] - angles[0])
    closed = float(fine[np.argmin([area(angle) for angle in fine])])
    return (closed, closed + travel) if closed < 0 else (closed - travel, closed)
