# SPDX-License-Identifier: MIT
"""Rotations, most by roma, imported at the first call: it loads the compiler, over a second.

Vectors are axis times angle in radians; matrices act on columns; quaternions are xyzw.
"""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

FEW = 9 * 256  # Entries of matrices
ACROSS = torch.tensor([
    [0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0],
])  # fmt: skip
"""A vector times this: the matrix of the cross product with it, row by row."""
EYE = torch.eye(3)


def rotvec_to_rotmat(vector: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation by the vector's length about its direction (Rodrigues).

    In a dozen steps, where roma takes 75: models turn parts all the time.

    >>> rotvec_to_rotmat(torch.tensor([0.0, 0, torch.pi / 2]))[1, 0].round()
    tensor(1.)
    """
    across = (vector[..., None] * ACROSS.to(vector)).sum(-2).unflatten(-1, (3, 3))
    turns = torch.linalg.vector_norm(vector, dim=-1)[..., None, None] / torch.pi
    twice = (turns / 2).sinc().square() / 2
    return EYE.to(vector) + turns.sinc() * across + twice * (across @ across)


def rotmat_to_rotvec(rotation: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3"]:
    """Its inverse, of at most half a turn."""
    import roma

    return roma.rotmat_to_rotvec(rotation)


def unitquat_to_rotmat(quaternion: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation of a unit quaternion."""
    import roma

    return roma.unitquat_to_rotmat(quaternion)


def rotmat_to_unitquat(rotation: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """Its inverse."""
    import roma

    return roma.rotmat_to_unitquat(rotation)


def special_procrustes(matrix: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation nearest to a matrix.

    Few are told by their singular vectors, in a fifth of the time that roma's way takes to begin;
    roma's is the faster one for many, and its gradient stays finite.
    """
    if matrix.requires_grad or matrix.numel() > FEW or matrix.device.type != "cpu":
        import roma

        return cast("Tensor", roma.special_procrustes(matrix))
    left, _, right = torch.linalg.svd(matrix)
    turned = torch.linalg.det(left @ right).sign()[..., None, None]
    return torch.cat([left[..., :2], left[..., 2:] * turned], -1) @ right
