# SPDX-License-Identifier: MIT
"""Twins of objects made of boxes, whose every number is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh

from bench.twin.record import Shape, Twin
from bench.twin.surface import Samples
from scapo.categories import category

STEP = 0.08
"""Between samples, m."""
BODY = ((0.4, 0.5, 0.6), (0.0, 0.0, 0.0))
DOOR = ((0.03, 0.5, 0.6), (-0.22, 0.0, 0.0))
"""Sides and centre at state 0, object frame, m."""


@dataclass(frozen=True)
class Made:
    """A twin and what is true of it."""

    twin: Twin
    camera_T_object: np.ndarray
    boxes: tuple[trimesh.Trimesh, ...]
    """Per part at state 0, object frame."""
    pivot: np.ndarray
    axis: np.ndarray


def box_samples(size, centre=(0.0, 0.0, 0.0), step=STEP) -> Samples:
    """A lattice on the six faces of a box, from its edges on."""
    points, normals = [], []
    for k in range(3):
        u, v = (k + 1) % 3, (k + 2) % 3
        lines = [np.linspace(-size[i] / 2, size[i] / 2, max(2, round(size[i] / step) + 1))
                 for i in (u, v)]  # fmt: skip
        first, second = (grid.ravel() for grid in np.meshgrid(*lines, indexing="ij"))
        for side in (-1.0, 1.0):
            face, normal = np.zeros((len(first), 3)), np.zeros((len(first), 3))
            face[:, k], face[:, u], face[:, v] = side * size[k] / 2, first, second
            normal[:, k] = side
            points.append(face)
            normals.append(normal)
    return Samples(points=np.concatenate(points) + centre, normals=np.concatenate(normals))


def cabinet(state: float = 0.6, name: str = "safe", **changes) -> Made:
    """A safe, its door turned by `state`; or a drawer of the same boxes, pulled out by it."""
    kind = category(name)
    pivot, axis = np.array([-0.2, 0.25, 0.0]), np.array([0.0, 0.0, -1.0])
    if kind.joints[0].kind == "prismatic":
        pivot, axis = np.array(DOOR[1]), np.array([-1.0, 0.0, 0.0])
        motion = trimesh.transformations.translation_matrix(state * axis)
    else:
        motion = trimesh.transformations.rotation_matrix(state, axis, pivot)
    pose = trimesh.transformations.euler_matrix(0.4, 1.2, -0.3)
    pose[:3, 3] = 0.1, -0.05, 1.8
    poses = np.stack([pose, pose @ motion])
    rest = [box_samples(*BODY), box_samples(*DOOR)]
    points = np.concatenate(
        [trimesh.transform_points(s.points, p) for s, p in zip(rest, poses, strict=True)]
    )
    normals = np.concatenate([s.normals @ p[:3, :3].T for s, p in zip(rest, poses, strict=True)])
    part = np.repeat([0, 1], [len(s.points) for s in rest])
    seen = np.flatnonzero((points * normals).sum(-1) < 0)[::2]
    twin = Twin(
        name="trial",
        category=kind,
        points=points[seen].astype(np.float32),
        part=part[seen],
        camera_T_part=poses.astype(np.float32),
        pivot=trimesh.transform_points(pivot[None], poses[1]).astype(np.float32),
        axis=(pose[:3, :3] @ axis)[None].astype(np.float32),
        state=np.array([state], np.float32),
        limits=np.array([[0.0, max(state, 1.5 if name == "safe" else 0.3)]], np.float32),
        shape=Shape(points=points, normals=normals, part=part),
    )
    boxes = tuple(trimesh.creation.box(size).apply_translation(at) for size, at in (BODY, DOOR))
    return Made(replace(twin, **changes), pose, boxes, pivot, axis)


def glasses() -> Twin:
    """A bar with two temples that meet where both are folded; seen from the front, at state 0."""
    boxes = [
        box_samples((0.02, 0.2, 0.04), (-0.1, 0.0, 0.0), 0.04),
        box_samples((0.18, 0.02, 0.02), (0.0, 0.1, 0.0), 0.04),
        box_samples((0.18, 0.02, 0.02), (0.0, -0.1, 0.0), 0.04),
    ]
    part = np.repeat([0, 1, 2], [len(one.points) for one in boxes])
    points = np.concatenate([one.points for one in boxes])
    normals = np.concatenate([one.normals for one in boxes])
    camera_T_object = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0.6], [0, 0, 0, 1]])
    turn = camera_T_object[:3, :3]
    hinges = np.array([[-0.09, 0.1, 0.0], [-0.09, -0.1, 0.0]])
    seen = trimesh.transform_points(points, camera_T_object)
    return Twin(
        name="glasses",
        category=category("eyeglasses"),
        points=seen,
        part=part,
        camera_T_part=np.stack([camera_T_object] * 3),
        pivot=trimesh.transform_points(hinges, camera_T_object),
        axis=np.array([[0.0, 0, -1], [0, 0, 1]]) @ turn.T,
        state=np.zeros(2),
        limits=np.array([[0.0, 1.4], [0.0, 1.4]]),
        shape=Shape(points=seen, normals=normals @ turn.T, part=part),
    )
