# SPDX-License-Identifier: MIT
"""Shapes are checked in the test run: wrong ones are refused, in the first calls of each test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped
from torch import Tensor

from scapo.geometry.rigid import apply
from tests.helpers import typecheck
from tests.helpers.typecheck import CALLS, CURRENT, checked


@jaxtyped(typechecker=checked)
def rows(points: Float[Tensor, "N 3"], *, twice: bool = False) -> Float[Tensor, "N 3"]:
    return torch.cat([points, points]) if twice else points


def test_arguments_and_results_of_another_shape_are_refused():
    with pytest.raises(TypeCheckError, match="parameter 'points'"):
        rows(torch.zeros(5, 4))
    with pytest.raises(TypeCheckError, match="return value"):
        rows(torch.zeros(5, 3), twice=True)
    rows(torch.zeros(0, 3))


@pytest.mark.usefixtures("shapes_checked")
def test_the_functions_of_the_packages_are_checked():
    with pytest.raises(TypeCheckError):
        apply(torch.eye(3), torch.zeros(5, 3))


def test_the_first_calls_of_every_test_are_checked(monkeypatch: pytest.MonkeyPatch):
    for test in ("one", "another"):
        monkeypatch.setenv(CURRENT, test)
        with pytest.raises(TypeCheckError):
            rows(torch.zeros(5, 4))
        for _ in range(CALLS):
            rows(torch.zeros(5, 3))
        rows(torch.zeros(5, 4))


def test_a_call_in_the_middle_of_the_building_of_checks_does_not_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As that of a signal's handler, which comes while beartype holds its locks."""
    build, handled = typecheck._strict, list[bool]()

    def building(function: Callable[..., Any]) -> Callable[..., Any]:
        handled.append(checked(rows)(torch.zeros(5, 4)) is None)
        return build(function)

    monkeypatch.setattr(typecheck, "_strict", building)
    outer = checked(rows)
    with pytest.raises(TypeCheckError):
        outer(torch.zeros(5, 4))
    assert handled
    assert all(handled)
