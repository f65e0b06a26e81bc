# SPDX-License-Identifier: MIT
"""Answers that are true, and how a method with conventions of its own would give them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from scapo.alignment import Alignment, LabelledClouds
from scapo.categories import Category
from scapo.geometry.rigid import joint_motion
from scapo.types import Joints, Prediction

CASES = [
    ("oven", (0, 1)), ("oven", (1, 0)), ("drawer", (0, 1)), ("drawer", (1, 0)),
    ("eyeglasses", (0, 2, 1)), ("basket", (0, 1, 2)),
]  # fmt: skip
"""Categories, and which part each of the method's slots is."""
CLOUDS = LabelledClouds(split="train", data_digest="d" * 64, samples=30, mode="quick")


def pose(rng: np.random.Generator) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3] = Rotation.random(rng=rng).as_matrix()
    made[:3, 3] = rng.normal(size=3)
    return made


def convention(order: tuple[int, ...], rng: np.random.Generator) -> Alignment:
    """Frames, senses and zeros drawn at random."""
    joints = len(order) - 1
    return Alignment(
        order=order,
        own_T_part=tuple(tuple(map(tuple, pose(rng).tolist())) for _ in order),
        sign=tuple(rng.choice([-1.0, 1.0], joints).tolist()),
        zero=tuple(rng.uniform(-1, 1, joints).tolist()),
        clouds=CLOUDS,
    )


def true_answers(category: Category, count: int, rng: np.random.Generator) -> Prediction:
    """Parts, poses, joints and a shape at rest, float64; children are moved by their joints."""
    parts, joints, points = len(category.parts), len(category.joints), 50
    axis = rng.normal(size=(count, joints, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    pivot, state = rng.normal(size=(count, joints, 3)), rng.uniform(0.2, 1, (count, joints))
    poses = [torch.as_tensor(np.stack([pose(rng) for _ in range(count)]))]
    for j, spec in enumerate(category.joints):
        at, along, by = (torch.as_tensor(x[:, j]) for x in (pivot, axis, state))
        poses.append(joint_motion(at, along, by, spec.kind) @ poses[0])
    part = torch.as_tensor(rng.integers(0, parts, (count, points)))
    normals = rng.normal(size=(count, points, 3))
    limits = torch.tensor([0.0, 1.2], dtype=torch.float64).expand(count, joints, 2)
    return Prediction(
        part_weight=torch.nn.functional.one_hot(part, parts).double(),
        camera_T_part=torch.stack(poses, 1),
        joints=Joints(
            pivot=torch.as_tensor(pivot), axis=torch.as_tensor(axis), state=torch.as_tensor(state)
        ),
        canonical_points=torch.as_tensor(rng.normal(size=(count, points, 3))),
        canonical_normals=torch.as_tensor(normals),
        canonical_part=part,
        joint_limits=limits,
    )


def in_own_words(truth: Prediction, own: Alignment, unit: Tensor, category: Category) -> Prediction:
    """The same answers as a method with these conventions gives them."""
    order, count = list(own.order), len(unit)
    slot = torch.argsort(torch.tensor(order))
    offset = torch.tensor(own.own_T_part, dtype=torch.float64).repeat(count, 1, 1, 1)
    offset[..., :3, 3] *= unit[:, None, None]
    assert truth.joints is not None
    assert truth.camera_T_part is not None
    assert truth.canonical_points is not None
    assert truth.canonical_normals is not None
    assert truth.canonical_part is not None
    assert truth.joint_limits is not None
    sign = torch.tensor(own.sign, dtype=torch.float64)
    zero = torch.tensor(own.zero, dtype=torch.float64)
    for j, spec in enumerate(category.joints):
        assert spec.kind in ("revolute", "prismatic")
        assert spec.child == j + 1
    slides = torch.tensor([spec.kind == "prismatic" for spec in category.joints])
    shift = torch.where(slides, zero * unit[:, None], zero)
    state = sign * (truth.joints.state - shift)
    limits = (sign[:, None] * (truth.joint_limits - shift[..., None])).sort(-1).values
    axis, pivot = sign[:, None] * truth.joints.axis, truth.joints.pivot
    if order[0] != 0:  # the door is its base: what moves is the body, the other way
        state, limits = -state, (-limits).sort(-1).values
    elif len(order) > 2:
        index = torch.tensor(order[1:]) - 1
        axis, pivot, state, limits = (x[:, index] for x in (axis, pivot, state, limits))
    move = offset[torch.arange(count)[:, None], truth.canonical_part]  # (B, M, 4, 4)
    points = (move[..., :3, :3] @ truth.canonical_points[..., None])[..., 0] + move[..., :3, 3]
    return replace(
        truth,
        part_weight=truth.part_weight[..., order],
        camera_T_part=(truth.camera_T_part @ torch.linalg.inv(offset))[:, order],
        joints=Joints(pivot=pivot, axis=axis, state=state),
        joint_limits=limits,
        canonical_points=points,
        canonical_normals=(move[..., :3, :3] @ truth.canonical_normals[..., None])[..., 0],
        canonical_part=slot[truth.canonical_part],
    )
