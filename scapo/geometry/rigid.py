# SPDX-License-Identifier: MIT
"""Rigid motions as 4x4 matrices, joint motion, and the angles and distances that metrics need.

`a_T_b @ b_T_c = a_T_c`. Points are rows: p_a = p_b @ R.mT + t. Rotations come from roma.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.rotations import rotvec_to_rotmat, special_procrustes, unitquat_to_rotmat


def rigid(
    rotation: Float[Tensor, "*B 3 3"], translation: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 4 4"]:
    """The homogeneous matrix [R | t; 0 1]."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def invert(a_T_b: Float[Tensor, "*B 4 4"]) -> Float[Tensor, "*B 4 4"]:
    """b_T_a of a rigid a_T_b: [R^T | -R^T t]."""
    rotation = a_T_b[..., :3, :3].mT
    return rigid(rotation, -(rotation @ a_T_b[..., :3, 3:])[..., 0])


def apply(
    a_T_b: Float[Tensor, "*#B 4 4"], points: Float[Tensor, "*#B N 3"]
) -> Float[Tensor, "*B N 3"]:
    """Coordinates in a of points given in b."""
    return points @ a_T_b[..., :3, :3].mT + a_T_b[..., None, :3, 3]


def joint_motion(
    pivot: Float[Tensor, "*#B 3"],
    axis: Float[Tensor, "*#B 3"],
    state: Float[Tensor, "*#B"],
    kind: JointKind,
) -> Float[Tensor, "*B 4 4"]:
    """The motion of a child part relative to its parent, in the frame of pivot and axis.

    Revolute: x -> Exp(axis * state) (x - pivot) + pivot, so t = (I - R) pivot. The paper prints
    t = pivot (Sec. 3.2), which contradicts its own three steps. Prismatic: x -> x + axis * state.

    Args:
        pivot: A point on the axis, m.
        axis: Unit vector.
        state: rad or m.
        kind: Of the joint.
    """
    step, pivot = torch.broadcast_tensors(axis * state[..., None], pivot)
    if kind == "prismatic":
        eye = torch.eye(3, dtype=step.dtype, device=step.device).expand(*step.shape[:-1], 3, 3)
        return rigid(eye, step)
    rotation = rotvec_to_rotmat(step)
    return rigid(rotation, pivot - (rotation @ pivot[..., None])[..., 0])


def rotation_angle(a: Float[Tensor, "*B 3 3"], b: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B"]:
    """Geodesic angle between two rotations in radians.

    By atan2 of the sine (skew part of a^T b) and the cosine (trace): accurate to rounding from
    0 to pi with finite gradients everywhere, where arccos loses half the digits near 0 and the
    arcsin of half the chord near pi.
    """
    turn = a.mT @ b
    skew = torch.stack([turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
    trace = turn.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(skew.norm(dim=-1), trace - 1)


def axis_angle(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Angle between two undirected lines in radians, [0, pi/2]; axes of any length but 0.

    An axis of length 0 has no direction: NaN, not a perfect score.
    """
    sine = torch.linalg.cross(a, b).norm(dim=-1)
    cosine = (a * b).sum(-1).abs()
    undefined = (a == 0).all(-1) | (b == 0).all(-1)
    return torch.where(undefined, torch.nan, torch.atan2(sine, cosine))


def point_line_distance(
    point: Float[Tensor, "*#B 3"], pivot: Float[Tensor, "*#B 3"], axis: Float[Tensor, "*#B 3"]
) -> Float[Tensor, "*B"]:
    """Distance of a point from the line through `pivot` along `axis` (unit)."""
    return torch.linalg.cross(*torch.broadcast_tensors(point - pivot, axis)).norm(dim=-1)


def rotation_between(
    source: Float[Tensor, "*B 3"], target: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3 3"]:
    """The smallest rotation R with R source = target, for unit vectors (Sec. 3.2, R_r).

    Rodrigues in the form I + [v] + [v]^2 / (1 + c), v = source x target, c = source . target,
    which needs no angle and is exact for equal vectors. As 1 + c loses its digits towards
    opposite vectors, obtuse angles begin with half a turn about v, which takes source to
    -source, and go on from there by the acute rest. Within 1e-3 rad of opposite, v has no
    direction of its own to rely on: the half turn is about a normal that the smallest component
    of `source` fixes. R source = target holds to rounding throughout.
    """
    eye = torch.eye(3, dtype=source.dtype, device=source.device)
    obtuse = ((source * target).sum(-1) < 0)[..., None]
    turn = torch.where(obtuse[..., None], _half_turn(source, target), eye)
    start = torch.where(obtuse, -source, source)
    skew = skew_matrix(torch.linalg.cross(start, target))
    cosine = (start * target).sum(-1)[..., None, None]
    return (eye + skew + skew @ skew / (1 + cosine)) @ turn


def _half_turn(
    source: Float[Tensor, "*B 3"], target: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3 3"]:
    """Half a turn about source x target; about any normal of `source` where that is near 0."""
    cross = torch.linalg.cross(source, target)
    smallest = torch.nn.functional.one_hot(source.abs().argmin(-1), 3).to(source.dtype)
    degenerate = cross.square().sum(-1, keepdim=True) < 1e-6
    normal = torch.where(degenerate, torch.linalg.cross(source, smallest), cross)
    # Rounding tilts a short cross product; R source = target needs a normal at a right angle.
    normal = normal - (normal * source).sum(-1, keepdim=True) * source
    normal = torch.nn.functional.normalize(normal, dim=-1)
    eye = torch.eye(3, dtype=source.dtype, device=source.device)
    return 2 * normal[..., :, None] * normal[..., None, :] - eye


def skew_matrix(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """[v] with [v] x = v cross x."""
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def project_rotation(matrix: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation nearest to a matrix in the Frobenius norm (SVD, det = +1)."""
    return special_procrustes(matrix)


def gram_schmidt(
    first: Float[Tensor, "*B 3"], second: Float[Tensor, "*B 3"]
) -> Float[Tensor, "*B 3 3"]:
    """The rotation whose first column is along one vector, the second in the plane of both."""
    first = torch.nn.functional.normalize(first, dim=-1)
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)


def mean_rotation(rotations: Float[Tensor, "*B K 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """Chordal mean: the projection of the sum over K."""
    return project_rotation(rotations.sum(-3))


def random_rotations(
    count: int, generator: torch.Generator, *, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "{count} 3 3"]:
    """Uniform on SO(3), from normalised Gaussian quaternions, on the generator's device."""
    quaternion = torch.randn(count, 4, generator=generator, device=generator.device, dtype=dtype)
    return unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))
