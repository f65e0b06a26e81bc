# SPDX-License-Identifier: MIT
"""Shape2Motion as the published loaders read it: `<root>/MDV02/<category>/<id>/`.

- `summary.obj`: the whole object at rest, lines "v x y z" and "f i j k" only;
- `sfs_idx_to_dof_name_idx.npy`: a pickled dict {face index: part index}, the faces contiguous;
- `motion_attributes.json`: a tree of nodes (`dof_name`, `motion_type`, `center`, `direction`,
  `children`); a part's index is its node's position in pre-order.

Quirks: of eyeglasses the motion records of nodes 1 and 2 are exchanged. Of every other category
only the first rotation node moves (ours: with all that hangs on it). There are no joint limits:
`models.told_limits` tells them. Units are not metres; the axis y of the files is level (the
published swap symmetry of its laptops shows it), z is taken as up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from sim_assets.formats.archives import read_npy
from sim_assets.importers.models import Body, Folder, Hinge, Model, find_folders, joined, safe_word
from sim_assets.importers.records import (
    Vector,
    direction,
    member,
    part_of,
    read_json,
    read_obj,
    vector,
)
from sim_assets.models.validate import read_number, refuse

SET = "shape2motion"
MESH = "summary.obj"
LABELS = "sfs_idx_to_dof_name_idx.npy"
MOTION = "motion_attributes.json"
MAX_NODES = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Node:
    """One part of the tree."""

    name: str
    parent: int
    """Position in pre-order; -1 of the root."""
    motion: str
    center: Vector
    direction: Vector
    """Unit; meaningless unless `motion` is "rotation"."""


def find(path: Path) -> list[Folder]:
    """Model folders below a path.

    Raises:
        AssetError: None there.
    """
    return find_folders(path, (MESH, LABELS, MOTION))


def read(folder: Folder) -> Model:
    """One model, in the coordinates of its files.

    Raises:
        AssetError: A file is missing or damaged, or nothing moves.
        UnpickleError: The labels hold more than data.
    """
    mesh = read_obj(folder.path / MESH)
    nodes = read_nodes(folder.path / MOTION)
    labels = read_labels(folder.path / LABELS, len(mesh.faces), len(nodes))
    if folder.category == "eyeglasses":
        nodes = exchanged(nodes, folder.path / MOTION)
    movers = [k for k, node in enumerate(nodes) if node.motion == "rotation"]
    if folder.category != "eyeglasses":
        movers = movers[:1]
    if not movers:
        raise refuse(folder.path / MOTION, "a node with motion_type 'rotation'", "none")
    owner = _owners(nodes, movers)
    bodies = []
    for head in (-1, *movers):
        parts = [k for k in range(len(nodes)) if owner[k] == head and (labels == k).any()]
        if not parts:
            what = "the base" if head < 0 else f"part {head}"
            raise refuse(folder.path / LABELS, f"faces of {what}", "none")
        name = "base" if head < 0 else f"part_{head}_{safe_word(nodes[head].name)}"
        meshes = tuple(part_of(mesh, np.flatnonzero(labels == k)) for k in parts)
        bodies.append(Body(name=name, meshes=meshes))
    place = {head: k for k, head in enumerate((-1, *movers))}
    hinges = [
        Hinge(
            parent=place[owner[nodes[k].parent]] if nodes[k].parent >= 0 else 0,
            child=place[k],
            pivot=nodes[k].center,
            axis=nodes[k].direction,
            limits=None,
        )
        for k in movers
    ]
    links, joints = joined(bodies, hinges, folder.category)
    return Model(name=f"{SET}_{folder.category}_{folder.id}", links=links, joints=joints)


def _owners(nodes: list[Node], movers: list[int]) -> list[int]:
    """For each node the mover that it moves with, -1 for the base.

    A root that moves is itself alone: all else would move with it.
    """
    owner: list[int] = []
    for k, node in enumerate(nodes):
        above = owner[node.parent] if node.parent >= 0 else -1
        owner.append(k if k in movers else (-1 if above == 0 else above))
    return owner


def exchanged(nodes: list[Node], path: Path) -> list[Node]:
    """Eyeglasses: nodes 1 and 2 with each other's motion.

    Raises:
        AssetError: There are fewer than three nodes.
    """
    if len(nodes) < 3:
        raise refuse(path, "three nodes of eyeglasses", str(len(nodes)))
    first, second = nodes[1], nodes[2]

    def moving(node: Node, like: Node) -> Node:
        return Node(
            name=node.name,
            parent=node.parent,
            motion=like.motion,
            center=like.center,
            direction=like.direction,
        )

    return [nodes[0], moving(first, second), moving(second, first), *nodes[3:]]


def read_nodes(path: Path) -> list[Node]:
    """The tree in pre-order.

    Raises:
        AssetError: Unreadable, or a node lacks what it needs.
    """
    nodes = list(_walk(path, read_json(path)))
    if len(nodes) > MAX_NODES:
        raise refuse(path, f"at most {MAX_NODES} nodes", str(len(nodes)))
    return nodes


def _walk(path: Path, root: object) -> Iterator[Node]:
    waiting: list[tuple[object, int]] = [(root, -1)]
    count = 0
    while waiting:
        record, parent = waiting.pop()
        motion = member(path, record, "motion_type", str).strip().lower()
        moves = motion == "rotation"
        yield Node(
            name=member(path, record, "dof_name", str),
            parent=parent,
            motion=motion,
            center=vector(path, record, "center") if moves else np.zeros(3),
            direction=direction(path, record, "direction") if moves else np.zeros(3),
        )
        has_children = isinstance(record, dict) and record.get("children") is not None
        children = member(path, record, "children", list) if has_children else []
        waiting += [(child, count) for child in reversed(children)]
        count += 1


def read_labels(path: Path, faces: int, parts: int) -> Int[np.ndarray, " F"]:
    """The part of each face, in face order.

    Args:
        path: Of the pickled dict.
        faces: Number of faces of the mesh.
        parts: Number of nodes of the tree.

    Raises:
        AssetError: No dict of integers, other faces than the mesh's, unknown parts.
        UnpickleError: It holds more than data.
    """
    table = read_npy(path)
    if not isinstance(table, dict) or not table:
        raise refuse(path, "a dict {face index: part index}", type(table).__name__)
    try:
        keys = np.array([_whole(key) for key in table])
        values = np.array([_whole(value) for value in table.values()])
    except (TypeError, ValueError, OverflowError) as error:
        raise refuse(path, "whole numbers as faces and parts", str(error)) from error
    order = np.argsort(keys)
    if (np.diff(keys[order]) != 1).any() or len(keys) != faces:
        found = f"{len(keys)} from {keys.min()} to {keys.max()}"
        raise refuse(path, f"{faces} contiguous faces, as {MESH} has", found)
    if values.min() < 0 or values.max() >= parts:
        found = f"{values.min()} to {values.max()}"
        raise refuse(path, f"part indices below {parts}, as {MOTION} has nodes", found)
    return values[order]


def _whole(value: object) -> int:
    found = read_number(value.item() if isinstance(value, np.generic) else value)
    if not found.is_integer() or abs(found) > 2**53:
        raise ValueError(f"{value!r:.40}")
    return int(found)
