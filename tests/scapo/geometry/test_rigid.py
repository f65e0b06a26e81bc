# SPDX-License-Identifier: MIT
"""Rigid motions: group axioms, independent references, gradients at the hard places."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from scapo.geometry import rigid as geometry
from tests.helpers.strategies import (
    batch_shapes,
    generator,
    is_rotation,
    joints,
    normal,
    rigid_motions,
    rotations,
    seeds,
    unit_vectors,
)

quick = settings(max_examples=15, deadline=None)


@quick
@given(seed=seeds, shape=batch_shapes)
def test_rigid_motions_form_a_group(seed: int, shape: tuple[int, ...]) -> None:
    a, b, c = (rigid_motions(seed + 10 * i, *shape) for i in range(3))
    eye = torch.eye(4, dtype=torch.float64).expand(*shape, 4, 4)
    assert_close((a @ b) @ c, a @ (b @ c))
    assert_close(a @ geometry.invert(a), eye, atol=1e-12, rtol=0)
    assert_close(geometry.invert(a) @ a, eye, atol=1e-12, rtol=0)
    assert_close(geometry.invert(geometry.invert(a)), a)
    assert_close(geometry.invert(a @ b), geometry.invert(b) @ geometry.invert(a))
    assert_close(geometry.invert(a), torch.linalg.inv(a))


@quick
@given(seed=seeds, shape=batch_shapes)
def test_apply_is_an_action_and_matches_trimesh(seed: int, shape: tuple[int, ...]) -> None:
    a_T_b, b_T_c = rigid_motions(seed, *shape), rigid_motions(seed + 10, *shape)
    points = normal(seed + 20, *shape, 7, 3)
    moved = geometry.apply(a_T_b @ b_T_c, points)
    assert_close(moved, geometry.apply(a_T_b, geometry.apply(b_T_c, points)))
    flat = zip((a_T_b @ b_T_c).reshape(-1, 4, 4), points.reshape(-1, 7, 3), strict=True)
    expected = [trimesh.transform_points(p.numpy(), m.numpy()) for m, p in flat]
    assert_close(moved.reshape(-1, 7, 3), torch.from_numpy(np.stack(expected)))


def test_apply_broadcasts_one_cloud_over_many_poses() -> None:
    poses, points = rigid_motions(0, 5), normal(1, 7, 3)
    moved = geometry.apply(poses, points[None])
    for i in range(5):
        assert_close(moved[i], geometry.apply(poses[i], points))


@quick
@given(seed=seeds, shape=batch_shapes)
def test_revolute_motion_matches_trimesh(seed: int, shape: tuple[int, ...]) -> None:
    pivot, axis, state = joints(seed, *shape)
    motion = geometry.joint_motion(pivot, axis, state, "revolute")
    assert motion.shape == (*shape, 4, 4)
    flat = zip(
        motion.reshape(-1, 4, 4),
        *(x.reshape(-1, 3) for x in (pivot, axis)),
        state.reshape(-1),
        strict=True,
    )
    for m, p, a, s in flat:
        expected = trimesh.transformations.rotation_matrix(float(s), a.numpy(), p.numpy())
        assert_close(m, torch.from_numpy(expected), atol=1e-12, rtol=0)
        rotation = Rotation.from_rotvec((a * s).numpy()).as_matrix()
        assert_close(m[:3, :3], torch.from_numpy(rotation), atol=1e-12, rtol=0)


@quick
@given(seed=seeds, shape=batch_shapes)
def test_revolute_motion_keeps_its_axis_and_adds_up(seed: int, shape: tuple[int, ...]) -> None:
    pivot, axis, state = joints(seed, *shape)
    motion = geometry.joint_motion(pivot, axis, state, "revolute")
    on_axis = torch.stack([pivot, pivot + axis, pivot - 2 * axis], -2)
    assert_close(geometry.apply(motion, on_axis), on_axis)
    twice = geometry.joint_motion(pivot, axis, 2 * state, "revolute")
    assert_close(motion @ motion, twice)
    back = geometry.joint_motion(pivot, axis, -state, "revolute")
    assert_close(geometry.invert(motion), back)
    slid = geometry.joint_motion(pivot + 3 * axis, axis, state, "revolute")
    assert_close(slid, motion)


@quick
@given(seed=seeds, shape=batch_shapes)
def test_prismatic_motion_slides_along_the_axis(seed: int, shape: tuple[int, ...]) -> None:
    pivot, axis, state = joints(seed, *shape)
    motion = geometry.joint_motion(pivot, axis, state, "prismatic")
    points = normal(seed, *shape, 4, 3)
    expected = points + (axis * state[..., None])[..., None, :]
    assert_close(geometry.apply(motion, points), expected)
    assert_close(motion[..., :3, :3], torch.eye(3, dtype=torch.float64).expand(*shape, 3, 3))


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("many", ["pivot", "axis", "state"])
def test_joint_motion_broadcasts_each_argument(kind: str, many: str) -> None:
    assert kind in ("revolute", "prismatic")
    pivot, axis, state = joints(3, 5)
    one = {"pivot": pivot[0], "axis": axis[0], "state": state[0]}
    all_ = {"pivot": pivot, "axis": axis, "state": state}
    given_ = {**one, many: all_[many]}
    motion = geometry.joint_motion(**given_, kind=kind)
    assert motion.shape == (5, 4, 4)
    for i in range(5):
        alone = {**one, many: all_[many][i]}
        assert_close(motion[i], geometry.joint_motion(**alone, kind=kind))


@pytest.mark.parametrize("state", [0.0, 1e-9, 1e-4, 0.7, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_joint_motion_gradients(kind: str, state: float) -> None:
    assert kind in ("revolute", "prismatic")
    pivot, axis, _ = joints(1, 2)
    inputs = (
        pivot.requires_grad_(),
        axis.requires_grad_(),
        torch.full((2,), state, dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(lambda p, a, s: geometry.joint_motion(p, a, s, kind), inputs)


def test_empty_batches_pass_through() -> None:
    none = torch.zeros(0, 3)
    assert geometry.joint_motion(none, none, none[:, 0], "revolute").shape == (0, 4, 4)
    assert geometry.rotation_between(none, none).shape == (0, 3, 3)
    assert geometry.axis_angle(none, none).shape == (0,)
    matrices = torch.zeros(0, 3, 3)
    assert geometry.rotation_angle(matrices, matrices).shape == (0,)
    assert geometry.project_rotation(matrices).shape == (0, 3, 3)
    assert is_rotation(matrices).shape == (0,)
    assert geometry.random_rotations(0, generator(0)).shape == (0, 3, 3)


@quick
@given(seed=seeds, shape=batch_shapes, length=st.floats(1e-3, 1e3))
def test_axis_angle_matches_numpy(seed: int, shape: tuple[int, ...], length: float) -> None:
    a, b = unit_vectors(seed, *shape), unit_vectors(seed + 1, *shape)
    expected = np.arccos(np.abs(np.sum(a.numpy() * b.numpy(), -1)))
    found = geometry.axis_angle(a * length, b / length)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-7)
    assert_close(geometry.axis_angle(-a, b), geometry.axis_angle(a, b))
    assert bool((found <= torch.pi / 2).all())


def test_axis_angle_is_accurate_for_parallel_axes_and_undefined_for_none() -> None:
    x = torch.tensor([1.0, 0.0, 0.0])
    tilted = torch.tensor([1.0, 1e-5, 0.0])
    assert geometry.axis_angle(x, tilted).item() == pytest.approx(1e-5, rel=1e-5)
    assert geometry.axis_angle(x, -x).item() == 0
    assert bool(geometry.axis_angle(x, torch.zeros(3)).isnan())
    assert bool(geometry.axis_angle(torch.zeros(3), x).isnan())
    assert bool(geometry.axis_angle(torch.full((3,), torch.nan), x).isnan())


def test_axis_angle_gradients() -> None:
    a, b = unit_vectors(1, 3).requires_grad_(), unit_vectors(2, 3).requires_grad_()
    assert torch.autograd.gradcheck(geometry.axis_angle, (a, b))
    same = unit_vectors(1).requires_grad_()
    geometry.axis_angle(same, same.detach()).backward()
    assert same.grad is not None
    assert bool(torch.isfinite(same.grad).all())


@quick
@given(seed=seeds, shape=batch_shapes)
def test_point_line_distance_matches_numpy(seed: int, shape: tuple[int, ...]) -> None:
    pivot, axis, along = joints(seed, *shape)
    point = normal(seed + 5, *shape, 3)
    offset = (point - pivot).numpy()
    rejected = offset - (offset * axis.numpy()).sum(-1, keepdims=True) * axis.numpy()
    found = geometry.point_line_distance(point, pivot, axis)
    np.testing.assert_allclose(found.numpy(), np.linalg.norm(rejected, axis=-1), atol=1e-12)
    on_line = pivot + axis * along[..., None]
    distance = geometry.point_line_distance(on_line, pivot, axis)
    assert_close(distance, torch.zeros(shape, dtype=torch.float64), atol=1e-12, rtol=0)


def test_point_line_distance_broadcasts() -> None:
    points = normal(0, 6, 3)
    pivot, axis = normal(1, 3), unit_vectors(2)
    found = geometry.point_line_distance(points, pivot, axis)
    expected = [geometry.point_line_distance(point, pivot, axis) for point in points]
    assert_close(found, torch.stack(expected))


def test_skew_matrix_is_the_cross_product() -> None:
    v, x = normal(0, 4, 3), normal(1, 4, 3)
    crossed = (geometry.skew_matrix(v) @ x[..., None])[..., 0]
    np.testing.assert_allclose(crossed.numpy(), np.cross(v.numpy(), x.numpy()))


def test_gram_schmidt_gives_rotations_that_keep_the_first_axis() -> None:
    a, b = normal(0, 5, 3), normal(1, 5, 3)
    rotation = geometry.gram_schmidt(a, b)
    assert is_rotation(rotation, 1e-9).all()
    assert_close(rotation[..., 0], torch.nn.functional.normalize(a, dim=-1))
    exact = rotations(3, 4)
    assert_close(geometry.gram_schmidt(exact[..., 0], exact[..., 1]), exact)
