# SPDX-License-Identifier: MIT
"""Procedural assets as URDF folders that any simulator loads (`scapo-data build`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from scapo.export.urdf import Joint, Link, Surface, write_urdf
from sim_assets.objects import ArticulatedObject, Visual
from sim_assets.procedural import generate


def _surface(visual: Visual) -> Surface:
    return Surface(vertices=visual.mesh.vertices, faces=visual.mesh.faces, color=visual.color)


def links_and_joints(obj: ArticulatedObject) -> tuple[list[Link], list[Joint]]:
    """The object as `scapo.export` takes it: one link per part, named after it."""
    names = [part.replace(" ", "_") for part in obj.category.parts]
    links = [
        Link(name=name, surfaces=tuple(_surface(visual) for visual in visuals))
        for name, visuals in zip(names, obj.visuals, strict=True)
    ]
    joints = [
        Joint(
            name=obj.origin.joint_names[j],
            kind=joint.kind,
            parent=names[joint.parent],
            child=names[joint.child],
            pivot=obj.pivot[j],
            axis=obj.axis[j],
            upper=float(obj.upper[j]),
        )
        for j, joint in enumerate(obj.category.joints)
    ]
    return links, joints


def write_object(obj: ArticulatedObject, folder: Path) -> Path:
    """Write `folder/mobility.urdf` and its meshes; returns the URDF's path."""
    links, joints = links_and_joints(obj)
    return write_urdf(folder, links, joints, obj.instance)


def build(
    category: str, *, count: int, seed: int, out: Path, split: str = "train"
) -> Iterator[Path]:
    """Write instances 0 .. count - 1 to `out/<category>/<instance>/mobility.urdf`, one by one.

    Args:
        category: One of `sim_assets.procedural.RECIPES`.
        count: Number of instances, at least 1.
        seed: Of the data set.
        out: Folder; what lies there under other names stays.
        split: Whose instances.

    Yields:
        The path of each URDF once its folder is complete.

    Raises:
        ValueError: Unknown category or split, or a count below 1.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1, found {count}")
    for index in range(count):
        obj = generate(category, split, seed, index)
        yield write_object(obj, out / category / obj.instance)
