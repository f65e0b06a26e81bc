# SPDX-License-Identifier: MIT
"""From a category's design to an ArticulatedObject: centred, rounded, with its origin recorded."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import trimesh

from scapo.categories import Category
from scapo.categories import category as find_category
from sim_assets.objects import ArticulatedObject, Origin, Visual
from sim_assets.procedural.parameters import HeldOut
from sim_assets.procedural.shapes import mirrored

VERSION = "scapo-procedural/2"
"""Changes whenever the same arguments give another object."""
DECIMALS = 7
"""Coordinates are rounded to 1e-7 m, so that files reproduce them exactly."""

RGB = tuple[float, float, float]
Parts = tuple[list[Visual], ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Design:
    """What a category's builder returns, in any frame with the object frame's axes."""

    parts: Parts
    pivot: Sequence[Sequence[float] | np.ndarray] | np.ndarray
    """Per joint, m; for prismatic joints replaced by the centre of the moving part's box."""
    axis: Sequence[Sequence[float] | np.ndarray] | np.ndarray
    upper: Sequence[float]
    """rad or m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How a category is made."""

    shape: type
    """Dataclass of its free parameters."""
    build: Callable[[Any], Design]
    held_out: HeldOut
    main: tuple[str, ...] = ()
    """Parameters that set the object's proportions: they leave their ranges where the trait is
    `PROPORTIONS`."""
    rearranged: tuple[str, ...] = ()
    """Other traits that `build` knows."""
    symmetric: Mapping[str, object] | None = None
    """Parameters that make the category's swap symmetry exact; None if it has none."""


def painted(mesh: trimesh.Trimesh, color: RGB) -> Visual:
    """A visual of this opaque colour."""
    return Visual(mesh=mesh, color=(*color, 1.0))


def shade(color: RGB, factor: float) -> RGB:
    """The colour made darker (factor < 1) or lighter (> 1)."""
    red, green, blue = np.clip(np.asarray(color) * factor, 0.0, 1.0).tolist()
    return (red, green, blue)


def mirrored_design(design: Design) -> Design:
    """The same thing for the other hand: mirrored in the plane y = 0."""
    flip = np.array([1.0, -1.0, 1.0])
    return Design(
        parts=tuple(
            [Visual(mesh=mirrored(v.mesh, 1), color=v.color) for v in part] for part in design.parts
        ),
        pivot=np.asarray(design.pivot) * flip,
        axis=-np.asarray(design.axis) * flip,  # an axial vector
        upper=design.upper,
    )


def joint_names(category: Category) -> tuple[str, ...]:
    """Names of the category's joints in a URDF: the moving part and the kind."""
    words = {"revolute": "hinge", "prismatic": "slide"}
    return tuple(
        f"{category.parts[joint.child].replace(' ', '_')}_{words[joint.kind]}"
        for joint in category.joints
    )


def _rounded(values: np.ndarray) -> np.ndarray:
    return np.round(values, DECIMALS) + 0.0  # no negative zeros


def _moved(visual: Visual, shift: np.ndarray) -> Visual:
    vertices = _rounded(np.asarray(visual.mesh.vertices) + shift)
    mesh = trimesh.Trimesh(vertices, visual.mesh.faces, process=False)
    red, green, blue, alpha = np.round(visual.color, 4).tolist()
    return Visual(mesh=mesh, color=(red, green, blue, alpha))


def _bounds(visuals: Sequence[Visual]) -> np.ndarray:
    points = np.concatenate([visual.mesh.bounds for visual in visuals])
    return np.stack([points.min(0), points.max(0)])


def digest(shape: Any) -> str:  # noqa: ANN401
    """SHA-256 of a shape's parameters and of the generators' version."""
    text = json.dumps([VERSION, type(shape).__name__, asdict(shape)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def assemble(
    name: str, instance: str, design: Design, source: str, sha256: str, trait: str = ""
) -> ArticulatedObject:
    """The object with its origin at the centre of the bounding box at rest.

    Args:
        name: Of the category.
        instance: The object's id.
        design: Parts and joints.
        source: Generator and seed, for the manifest.
        sha256: Of the parameters.
        trait: What sets the object apart from the training shapes.
    """
    category = find_category(name)
    shift = -_bounds([visual for part in design.parts for visual in part]).mean(0)
    parts = tuple(tuple(_moved(visual, shift) for visual in part) for part in design.parts)
    pivots = np.asarray(design.pivot, float) + shift
    for j, joint in enumerate(category.joints):
        if joint.kind == "prismatic":
            pivots[j] = _bounds(parts[joint.child]).mean(0)
    axes = np.asarray(design.axis, float)
    names = joint_names(category)
    return ArticulatedObject(
        category=category,
        instance=instance,
        visuals=parts,
        pivot=_rounded(pivots),
        axis=axes / np.linalg.norm(axes, axis=1, keepdims=True) + 0.0,
        upper=np.round(np.asarray(design.upper, float), DECIMALS),
        origin=Origin(
            source=source,
            sha256=sha256,
            object_T_asset=np.eye(4),
            rest=dict.fromkeys(names, 0.0),
            joint_names=names,
            sign=(1.0,) * len(names),
        ),
        trait=trait,
    )
