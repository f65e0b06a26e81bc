# SPDX-License-Identifier: MIT
"""Rotations and neighbours keep float32 where the surroundings compute with fewer digits."""

from __future__ import annotations

import subprocess
import sys

import torch

from scapo.geometry.numerics import (
    at_least_float32,
    before_compiling,
    exact,
    matrix_products,
    uncompiled,
)
from scapo.geometry.points import nearest
from scapo.geometry.rigid import project_rotation
from scapo.paper.autoencoder import EncoderConfig, project
from tests.helpers.strategies import generator

A = torch.randn(64, 3, 3, generator=generator(0))


def test_products_inside_autocast_are_exact() -> None:
    with torch.autocast("cpu", torch.bfloat16):
        rough = A @ A
        with exact("cpu"):
            kept = A @ A
    assert rough.dtype == torch.bfloat16
    assert torch.equal(kept, A @ A)


def test_neighbours_and_rotations_do_not_change_under_autocast() -> None:
    a, b = torch.randn(2, 1, 200, 3, generator=generator(1))
    with torch.autocast("cpu", torch.bfloat16):
        found, rotation = nearest(a, b), project(A, EncoderConfig())
    assert torch.equal(found, nearest(a, b))
    assert torch.equal(rotation, project_rotation(A))


def test_the_setting_of_matrix_products_is_put_back() -> None:
    before = torch.get_float32_matmul_precision()
    with matrix_products("high"):
        assert torch.get_float32_matmul_precision() == "high"
    assert torch.get_float32_matmul_precision() == before


def test_double_stays_double() -> None:
    assert at_least_float32(A.double()).dtype == torch.float64
    assert at_least_float32(A.half()).dtype == torch.float32


def test_an_uncompiled_function_runs_as_it_is_inside_a_compiled_one() -> None:
    traced: list[bool] = []

    def twice(x: torch.Tensor) -> torch.Tensor:
        traced.append(torch.compiler.is_compiling())
        return torch.from_numpy(2 * x.numpy())

    held = uncompiled(twice)
    before_compiling()
    compiled = torch.compile(lambda x: held(x + 1) - 1, backend="eager")
    assert compiled(torch.ones(3)).tolist() == [3.0, 3.0, 3.0]
    assert held(torch.ones(1)).tolist() == [2.0]
    assert traced == [False, False]


def test_no_compiler_is_loaded_before_it_is_asked_for() -> None:
    code = "import sys, scapo.geometry.points; sys.exit('torch._dynamo' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
