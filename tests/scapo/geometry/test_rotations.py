# SPDX-License-Identifier: MIT
"""Rotations: angles, the smallest between two directions, means, projections, random ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry import rigid as geometry
from scapo.geometry.rotations import FEW, rotvec_to_rotmat, special_procrustes
from tests.helpers.strategies import (
    batch_shapes,
    generator,
    is_rotation,
    normal,
    rotations,
    seeds,
    unit_vectors,
)

quick = settings(max_examples=15, deadline=None)


def about_x(angle: float, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rotation about x by an angle computed in double precision."""
    return torch.from_numpy(Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()).to(dtype)


@quick
@given(seed=seeds, angle=st.floats(-7.0, 7.0))
def test_rotvec_to_rotmat_matches_scipy(seed: int, angle: float) -> None:
    vector = torch.stack([angle * unit_vectors(seed), torch.zeros(3, dtype=torch.float64)])
    expected = torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())
    assert_close(rotvec_to_rotmat(vector), expected, atol=1e-12, rtol=0)
    assert_close(rotvec_to_rotmat(vector[:, None])[:, 0], expected, atol=1e-12, rtol=0)
    assert_close(rotvec_to_rotmat(vector.float()).double(), expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.5, np.pi, 5.0])
def test_gradient_of_rotvec_to_rotmat_matches_differences(length: float) -> None:
    vector, weight = length * unit_vectors(4), normal(3, 3, 3)
    free = vector.clone().requires_grad_()
    (found,) = torch.autograd.grad((weight * rotvec_to_rotmat(free)).sum(), free)
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    ends = [Rotation.from_rotvec((vector + way * step).numpy()).as_matrix() for way in (1, -1)]
    expected = (weight * torch.from_numpy(ends[0] - ends[1]) / 2e-5).sum((1, 2))
    assert_close(found, expected, atol=1e-8, rtol=0)


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
    assert bool(is_rotation(rotation, 1e-6))


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


def test_few_and_many_are_projected_alike() -> None:
    """By singular vectors, and by roma: of many, and where there are gradients."""
    matrices = normal(5, FEW, 3, 3)
    many, few = special_procrustes(matrices), matrices[:20]
    assert (torch.linalg.det(few) < 0).any()
    assert_close(special_procrustes(few), many[:20], atol=1e-8, rtol=0)
    assert_close(special_procrustes(few.clone().requires_grad_()).detach(), many[:20])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_project_rotation_of_reflections_has_determinant_one(dtype: torch.dtype) -> None:
    matrices = [-torch.eye(3), torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.zeros(3, 3)]
    found = geometry.project_rotation(torch.stack(matrices).to(dtype))
    assert_close(torch.linalg.det(found), torch.ones(3, dtype=dtype))
    assert bool(is_rotation(found, 1e-5).all())


@quick
@given(seed=seeds)
def test_mean_rotation_matches_scipy(seed: int) -> None:
    centre = rotations(seed)
    turns = Rotation.from_rotvec(normal(seed + 1, 6, 3).numpy() * 0.5).as_matrix()
    near = centre @ torch.from_numpy(turns)
    expected = Rotation.from_matrix(near.numpy()).mean()
    found = geometry.mean_rotation(near)
    assert_close(found, torch.from_numpy(expected.as_matrix()), atol=1e-9, rtol=0)


def test_mean_rotation_keeps_batches_apart() -> None:
    many = rotations(0, 2, 3, 6)
    found = geometry.mean_rotation(many)
    assert found.shape == (2, 3, 3, 3)
    assert_close(found[1, 2], geometry.mean_rotation(many[1, 2]))


def test_random_rotations_are_uniform() -> None:
    """The angle has density (1 - cos w) / pi, the axis and any moved vector are isotropic."""
    found = geometry.random_rotations(4000, generator(0), dtype=torch.float64)
    assert bool(is_rotation(found, 1e-12).all())
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
    assert is_rotation(torch.stack([good, *bad])).tolist() == [True] + [False] * 4
    assert bool(is_rotation(torch.eye(3, dtype=torch.float16)))
    assert bool(is_rotation(1.0004 * good))
    assert not bool(is_rotation(1.0004 * good, tolerance=1e-4))
