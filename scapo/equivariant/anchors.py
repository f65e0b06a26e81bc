# SPDX-License-Identifier: MIT
"""The 60 rotations of the icosahedron as a finite group, and its 12 vertices as the quotient.

Rotation 5 v + t takes vertex 0 to vertex v; 0 is the identity and 0 to 4 are the turns C5 about
vertex 0, so that a // 5 is the coset of rotation a in SO(3) / C5.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

ROTATIONS, VERTICES, TURNS = 60, 12, 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Icosahedron:
    """The group and what it does to itself and to the vertices, in float64 on the CPU."""

    rotations: Float[Tensor, "60 3 3"]
    vertices: Float[Tensor, "12 3"]
    """Unit vectors."""
    product: Int[Tensor, "60 60"]
    """`rotations[a] @ rotations[b]` is `rotations[product[a, b]]`."""
    inverse: Int[Tensor, " 60"]
    image: Int[Tensor, "60 12"]
    """`rotations[a] @ vertices[v]` is `vertices[image[a, v]]`."""


@cache
def icosahedron() -> Icosahedron:
    """The group, made once.

    A rotation is fixed by the images of two adjacent vertices, which may be any two adjacent
    vertices in order: 12 x 5. Vertices are the cyclic permutations of (0, +-1, +-golden ratio).
    """
    golden = (1 + 5**0.5) / 2
    ring = [(0.0, s, t * golden) for s in (1, -1) for t in (1, -1)]
    corners = [[p[(i - shift) % 3] for i in range(3)] for shift in range(3) for p in ring]
    vertices = torch.nn.functional.normalize(torch.tensor(corners, dtype=torch.float64), dim=-1)
    cosine = vertices @ vertices.mT  # 1, 5^-0.5 of neighbours, and their negatives
    near = [torch.nonzero((row - 5**-0.5).abs() < 1e-9)[:, 0].tolist() for row in cosine]
    frames = torch.stack(
        [_frame(vertices[v], vertices[u]) for v in range(VERTICES) for u in near[v]]
    )
    rotations = frames @ frames[0].mT
    product = _lookup((rotations[:, None] @ rotations).flatten(2), rotations.flatten(1))
    return Icosahedron(
        rotations=rotations,
        vertices=vertices,
        product=product,
        inverse=(product == 0).long().argmax(1),
        image=_lookup(vertices @ rotations.mT, vertices),
    )


def _frame(first: Float[Tensor, " 3"], second: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The right-handed frame with its first column along `first`, its second towards `second`."""
    across = second - (first @ second) * first
    across = across / across.norm()
    return torch.stack([first, across, torch.linalg.cross(first, across)], -1)


def _lookup(found: Float[Tensor, "K L D"], among: Float[Tensor, "S D"]) -> Int[Tensor, "K L"]:
    """Which of the rows of `among` each row of `found` is."""
    return torch.cdist(found, among).argmin(2)


def turned(rotation: int, anchors: int) -> Int[Tensor, " A"]:
    """Where features go when the cloud is turned by an anchor: new[..., turned, :] = old.

    Args:
        rotation: Index of the rotation that the cloud is turned by.
        anchors: 60 for the rotations themselves, 12 for the vertices.

    >>> turned(0, 12).tolist() == list(range(12))
    True
    """
    group = icosahedron()
    return (group.product if anchors == ROTATIONS else group.image)[rotation]
