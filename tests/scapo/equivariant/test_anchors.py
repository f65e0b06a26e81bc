# SPDX-License-Identifier: MIT
"""The anchors are the icosahedral group, and its tables say what its matrices do."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from scapo.equivariant.anchors import ROTATIONS, TURNS, VERTICES, icosahedron, turned
from tests.helpers.strategies import is_rotation

GROUP = icosahedron()


def test_they_are_sixty_different_rotations() -> None:
    assert is_rotation(GROUP.rotations, 1e-12).all()
    apart = torch.cdist(GROUP.rotations.flatten(1), GROUP.rotations.flatten(1))
    assert apart.fill_diagonal_(9).min() > 0.5
    assert_close(GROUP.rotations[0], torch.eye(3, dtype=torch.float64))


def test_they_are_scipys_icosahedral_group_in_another_frame() -> None:
    def angles(matrices: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(Rotation.from_matrix(matrices.numpy()).magnitude()).sort().values

    theirs = torch.from_numpy(Rotation.create_group("I").as_matrix())
    assert_close(angles(GROUP.rotations), angles(theirs), atol=1e-6, rtol=0)


def test_products_and_inverses_are_those_of_the_matrices() -> None:
    every = GROUP.rotations[:, None] @ GROUP.rotations[None]
    assert_close(every, GROUP.rotations[GROUP.product], atol=1e-12, rtol=0)
    assert_close(GROUP.rotations.mT, GROUP.rotations[GROUP.inverse], atol=1e-12, rtol=0)


def test_group_axioms() -> None:
    p, identity = GROUP.product, torch.arange(ROTATIONS)
    assert torch.equal(p[0], identity)
    assert torch.equal(p[:, 0], identity)
    assert torch.equal(p[identity, GROUP.inverse], torch.zeros_like(identity))
    assert torch.equal(p[p], p[identity[:, None, None], p[None]])  # (ab)c = a(bc)
    assert torch.equal(p.sort(1).values, identity.expand(ROTATIONS, -1))  # a latin square


def test_vertices_are_an_icosahedrons() -> None:
    cosine = GROUP.vertices @ GROUP.vertices.mT
    expected = torch.tensor([-1.0] + [-(5**-0.5)] * 5 + [5**-0.5] * 5 + [1.0]).double()
    assert_close(cosine.sort(1).values, expected.expand(VERTICES, -1))
    moved = GROUP.rotations[:, None] @ GROUP.vertices[None, :, :, None]
    assert_close(moved[..., 0], GROUP.vertices[GROUP.image], atol=1e-12, rtol=0)


def test_rotations_lie_in_the_coset_of_the_vertex_they_lead_to() -> None:
    assert torch.equal(GROUP.image[:, 0], torch.arange(ROTATIONS) // TURNS)
    stabiliser = set(range(TURNS))
    assert {int(GROUP.product[a, b]) for a in stabiliser for b in stabiliser} == stabiliser


def test_turns_compose() -> None:
    for anchors in (ROTATIONS, VERTICES):
        for a, b in ((3, 17), (59, 8)):
            both = turned(int(GROUP.product[a, b]), anchors)
            assert torch.equal(turned(a, anchors)[turned(b, anchors)], both)
