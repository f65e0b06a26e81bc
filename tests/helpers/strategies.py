# SPDX-License-Identifier: MIT
"""Hypothesis strategies shared by the tests: seeds, batch shapes, rigid motions."""

from __future__ import annotations

import numpy as np
import roma
import torch
from hypothesis import strategies as st
from torch import Tensor

from scapo.geometry.matrices import rotation_error

BATCH_SHAPES: tuple[tuple[int, ...], ...] = ((), (1,), (3, 1, 2))

batch_shapes = st.sampled_from(BATCH_SHAPES)
seeds = st.integers(min_value=0, max_value=2**31 - 1)


def generator(seed: int) -> torch.Generator:
    """A random generator of its own; nothing here touches the global one."""
    return torch.Generator().manual_seed(seed)


def normal(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Standard normal numbers of the given shape."""
    return torch.randn(shape, generator=generator(seed), dtype=dtype)


def unit_vectors(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Directions uniform on the sphere, (*shape, 3)."""
    vectors = normal(seed, *shape, 3, dtype=dtype)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def rotations(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rotation matrices uniform in SO(3), (*shape, 3, 3)."""
    quaternions = normal(seed, *shape, 4, dtype=dtype)
    return roma.unitquat_to_rotmat(quaternions / quaternions.norm(dim=-1, keepdim=True))


def rigid_motions(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Rigid motions with translations of about a metre, (*shape, 4, 4)."""
    motions = torch.eye(4, dtype=dtype).expand(*shape, 4, 4).clone()
    motions[..., :3, :3] = rotations(seed, *shape, dtype=dtype)
    motions[..., :3, 3] = normal(seed + 1, *shape, 3, dtype=dtype)
    return motions


def joints(
    seed: int, *shape: int, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, Tensor]:
    """Pivots of about a metre, unit axes and states in (-pi, pi): (*shape, 3) twice, (*shape)."""
    state = (torch.rand(shape, generator=generator(seed + 2), dtype=dtype) * 2 - 1) * torch.pi
    return normal(seed, *shape, 3, dtype=dtype), unit_vectors(seed + 1, *shape, dtype=dtype), state


def is_rotation(matrix: torch.Tensor, tolerance: float = 1e-3) -> np.ndarray:
    """Whether R R^T = I within `tolerance` per entry and det > 0; False for NaN."""
    return np.asarray(rotation_error(matrix.detach().numpy()) < tolerance)
