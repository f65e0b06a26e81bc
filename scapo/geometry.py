# SPDX-License-Identifier: MIT
"""Rigid motions as 4x4 matrices, joint motion, and the angles and distances that metrics need.

`a_T_b @ b_T_c = a_T_c`. Points are rows: p_a = p_b @ R.mT + t. Rotations come from roma.
"""

from __future__ import annotations

from typing import cast

import roma
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from scapo.types import JointKind


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
    step = axis * state[..., None]
    if kind == "prismatic":
        eye = torch.eye(3, dtype=step.dtype, device=step.device).expand(*step.shape[:-1], 3, 3)
        return rigid(eye, step)
    rotation = roma.rotvec_to_rotmat(step)
    pivot = pivot.expand(step.shape)
    return rigid(rotation, pivot - (rotation @ pivot[..., None])[..., 0])


def rotation_angle(a: Float[Tensor, "*B 3 3"], b: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B"]:
    """Geodesic angle between two rotations in radians, exact near 0 and pi (roma, by atan2)."""
    return roma.rotmat_geodesic_distance(a, b)


def axis_angle(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Angle between two undirected lines in radians, [0, pi/2]; axes of any length."""
    sine = torch.linalg.cross(a, b).norm(dim=-1)
    return torch.atan2(sine, (a * b).sum(-1).abs())


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
    which needs no angle and is exact for equal vectors. For opposite vectors, where every
    half turn about a normal will do, the normal is fixed by the smallest component of `source`.
    """
    cross = torch.linalg.cross(source, target)
    cosine = (source * target).sum(-1)
    opposite = cosine < -1 + 1e-6
    skew = skew_matrix(cross)
    eye = torch.eye(3, dtype=source.dtype, device=source.device)
    safe = torch.where(opposite, torch.ones_like(cosine), 1 + cosine)
    rotation = eye + skew + skew @ skew / safe[..., None, None]
    smallest = torch.nn.functional.one_hot(source.abs().argmin(-1), 3).to(source.dtype)
    normal = torch.nn.functional.normalize(torch.linalg.cross(source, smallest), dim=-1)
    half_turn = 2 * normal[..., :, None] * normal[..., None, :] - eye
    return torch.where(opposite[..., None, None], half_turn, rotation)


def skew_matrix(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """[v] with [v] x = v cross x."""
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def project_rotation(matrix: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation nearest to a matrix in the Frobenius norm (SVD, det = +1)."""
    return cast("Tensor", roma.special_procrustes(matrix))


def mean_rotation(
    rotations: Float[Tensor, "*B K 3 3"], weight: Float[Tensor, "*B K"] | None = None
) -> Float[Tensor, "*B 3 3"]:
    """Chordal mean: the projection of the (weighted) sum over K."""
    if weight is not None:
        rotations = rotations * weight[..., None, None]
    return project_rotation(rotations.sum(-3))


def random_rotations(
    count: int, generator: torch.Generator, *, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "{count} 3 3"]:
    """Uniform on SO(3), from normalised Gaussian quaternions, on the generator's device."""
    quaternion = torch.randn(count, 4, generator=generator, device=generator.device, dtype=dtype)
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))


def is_rotation(matrix: Shaped[Tensor, "*B 3 3"], tolerance: float = 1e-3) -> Shaped[Tensor, "*B"]:
    """Whether R R^T = I within `tolerance` per entry and det > 0; False for NaN."""
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    orthogonal = ((matrix @ matrix.mT - eye).abs() < tolerance).all(-1).all(-1)
    return orthogonal & (torch.linalg.det(matrix) > 0)
