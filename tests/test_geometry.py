# SPDX-License-Identifier: MIT
"""Rigid motions: group axioms, independent references, gradients at the hard places."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from strategies import (
    batch_shapes,
    generator,
    joints,
    normal,
    rigid_motions,
    rotations,
    seeds,
    unit_vectors,
)
from torch import Tensor
from torch.testing import assert_close

from scapo import geometry

quick = settings(max_examples=15, deadline=None)


def about_x(angle: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rotation about x by an angle computed in double precision."""
    return torch.from_numpy(Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()).to(dtype)


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
    assert geometry.is_rotation(matrices).shape == (0,)
    assert geometry.random_rotations(0, generator(0)).shape == (0, 3, 3)


@quick
@given(seed=seeds, shape=batch_shapes)
def test_rotation_angle_matches_scipy(seed: int, shape: tuple[int, ...]) -> None:
    a, b = rotations(seed, *shape), rotations(seed + 1, *shape)
    relative = (a.mT @ b).reshape(-1, 3, 3).numpy()
    expected = torch.from_numpy(Rotation.from_matrix(relative).magnitude()).reshape(shape)
    assert_close(geometry.rotation_angle(a, b), expected)
    assert_close(geometry.rotation_angle(b, a), expected)
    assert_close(geometry.rotation_angle(a, a), torch.zeros(shape, dtype=torch.float64))


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 1.0, np.pi - 1e-3, np.pi - 1e-5, np.pi])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotation_angle_is_accurate_at_both_ends(angle: float, dtype: torch.dtype) -> None:
    start = rotations(5, 20)
    end = start @ about_x(angle)
    found = geometry.rotation_angle(start.to(dtype), end.to(dtype)).double()
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14
    assert_close(found, torch.full_like(found, angle), atol=tolerance, rtol=0)


def test_rotation_angle_gradients() -> None:
    a, b = rotations(7, 4).requires_grad_(), rotations(8, 4).requires_grad_()
    assert torch.autograd.gradcheck(geometry.rotation_angle, (a, b))
    for angle in (0.0, np.pi):
        edge = about_x(angle).requires_grad_()
        geometry.rotation_angle(edge, torch.eye(3, dtype=torch.float64)).backward()
        assert edge.grad is not None
        assert bool(torch.isfinite(edge.grad).all())


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


def _target(source: Tensor, angle: float, seed: int) -> Tensor:
    """`source` turned by `angle` about a random normal, in double precision."""
    normal_ = torch.linalg.cross(source, unit_vectors(seed, *source.shape[:-1]))
    normal_ = normal_ / normal_.norm(dim=-1, keepdim=True)
    return source * np.cos(angle) + torch.linalg.cross(normal_, source) * np.sin(angle)


ANGLES = [0.0, 1e-8, 1e-4, 0.5, np.pi / 2, 2.0, np.pi - 0.03, np.pi - 2e-3, np.pi - 1e-5, np.pi]


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotation_between_turns_source_to_target(angle: float, dtype: torch.dtype) -> None:
    source = unit_vectors(3, 200)
    target = _target(source, angle, 4)
    rotation = geometry.rotation_between(source.to(dtype), target.to(dtype))
    assert rotation.dtype == dtype
    tolerance = 2e-6 if dtype == torch.float32 else 1e-12
    eye = torch.eye(3, dtype=dtype).expand(200, 3, 3)
    assert_close(rotation @ rotation.mT, eye, atol=tolerance, rtol=0)
    assert bool((torch.linalg.det(rotation) > 0).all())
    moved = (rotation.double() @ source[..., None])[..., 0]
    assert_close(moved, target, atol=tolerance, rtol=0)
    found = geometry.rotation_angle(rotation.double(), eye.double())
    # The smallest rotation; nearly opposite vectors may go the other way round by 1e-3.
    slack = 1e-3 if np.pi - 1e-3 < angle < np.pi else tolerance
    assert_close(found, torch.full_like(found, angle), atol=slack, rtol=0)


@pytest.mark.parametrize("row", np.eye(3).tolist() + (-np.eye(3)).tolist())
def test_rotation_between_opposite_coordinate_axes(row: list[float]) -> None:
    source = torch.tensor(row)
    rotation = geometry.rotation_between(source, -source)
    assert_close(rotation @ source, -source)
    assert bool(geometry.is_rotation(rotation, 1e-6))


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.5, np.pi / 2 + 0.1, 2.5, np.pi - 0.01])
def test_rotation_between_gradients(angle: float) -> None:
    source = unit_vectors(3, 2)
    target = _target(source, angle, 4)
    inputs = (source.requires_grad_(), target.requires_grad_())
    assert torch.autograd.gradcheck(geometry.rotation_between, inputs, atol=1e-4)


@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-6])
def test_rotation_between_opposite_has_finite_gradients(angle: float) -> None:
    source = unit_vectors(3, 5)
    inputs = [x.requires_grad_() for x in (source, _target(source.detach(), angle, 4))]
    inputs = [x.detach().requires_grad_() for x in inputs]
    weight = normal(0, 5, 3, 3)
    grads = torch.autograd.grad((geometry.rotation_between(*inputs) * weight).sum(), inputs)
    assert all(bool((grad.abs() < 1e2).all()) for grad in grads)


def test_skew_matrix_is_the_cross_product() -> None:
    v, x = normal(0, 4, 3), normal(1, 4, 3)
    crossed = (geometry.skew_matrix(v) @ x[..., None])[..., 0]
    np.testing.assert_allclose(crossed.numpy(), np.cross(v.numpy(), x.numpy()))


@quick
@given(seed=seeds, shape=batch_shapes)
def test_project_rotation_is_the_nearest_rotation(seed: int, shape: tuple[int, ...]) -> None:
    matrix = normal(seed, *shape, 3, 3)
    found = geometry.project_rotation(matrix)
    u, _, vt = np.linalg.svd(matrix.numpy())
    sign = np.linalg.det(u @ vt)
    vt[..., 2, :] *= sign[..., None]
    np.testing.assert_allclose(found.numpy(), u @ vt, atol=1e-6)
    assert_close(torch.linalg.det(found), torch.ones(shape, dtype=torch.float64))
    rotation = rotations(seed, *shape)
    assert_close(geometry.project_rotation(rotation), rotation)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_project_rotation_of_reflections_has_determinant_one(dtype: torch.dtype) -> None:
    matrices = [-torch.eye(3), torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.zeros(3, 3)]
    found = geometry.project_rotation(torch.stack(matrices).to(dtype))
    assert_close(torch.linalg.det(found), torch.ones(3, dtype=dtype))
    assert bool(geometry.is_rotation(found, 1e-5).all())


@quick
@given(seed=seeds, weighted=st.booleans())
def test_mean_rotation_matches_scipy(seed: int, weighted: bool) -> None:
    centre = rotations(seed)
    turns = Rotation.from_rotvec(normal(seed + 1, 6, 3).numpy() * 0.5).as_matrix()
    near = centre @ torch.from_numpy(turns)
    weight = normal(seed + 2, 6).abs() + 0.1
    expected = Rotation.from_matrix(near.numpy()).mean(weight.numpy() if weighted else None)
    found = geometry.mean_rotation(near, weight if weighted else None)
    assert_close(found, torch.from_numpy(expected.as_matrix()), atol=1e-9, rtol=0)


def test_mean_rotation_keeps_batches_apart() -> None:
    many, weight = rotations(0, 2, 3, 6), normal(1, 2, 3, 6).abs()
    found = geometry.mean_rotation(many, weight)
    assert found.shape == (2, 3, 3, 3)
    assert_close(found[1, 2], geometry.mean_rotation(many[1, 2], weight[1, 2]))


def test_random_rotations_are_uniform() -> None:
    """The angle has density (1 - cos w) / pi, the axis and any moved vector are isotropic."""
    found = geometry.random_rotations(4000, generator(0), dtype=torch.float64)
    assert bool(geometry.is_rotation(found, 1e-12).all())
    angle = Rotation.from_matrix(found.numpy()).magnitude()
    grid = np.linspace(0, np.pi, 2001)
    cumulative = cumulative_trapezoid((1 - np.cos(grid)) / np.pi, grid, initial=0)
    assert kstest(angle, lambda x: np.interp(x, grid, cumulative)).pvalue > 0.01
    for entry in (found[:, 0, 0], found[:, 1, 2], found[:, 2, 1]):
        assert kstest(entry.numpy(), "uniform", args=(-1, 2)).pvalue > 0.01


def test_random_rotations_follow_their_generator() -> None:
    first = geometry.random_rotations(5, generator(1))
    assert first.dtype == torch.float32
    assert torch.equal(first, geometry.random_rotations(5, generator(1)))
    assert not torch.equal(first, geometry.random_rotations(5, generator(2)))


def test_is_rotation_refuses_what_is_none() -> None:
    good = rotations(0, dtype=torch.float32)
    bad = [-good, 1.01 * good, torch.zeros(3, 3), torch.full((3, 3), torch.nan)]
    assert geometry.is_rotation(torch.stack([good, *bad])).tolist() == [True] + [False] * 4
    assert bool(geometry.is_rotation(torch.eye(3, dtype=torch.float16)))
    assert bool(geometry.is_rotation(1.0004 * good))
    assert not bool(geometry.is_rotation(1.0004 * good, tolerance=1e-4))
