# SPDX-License-Identifier: MIT
"""E2PN: convolution with the icosahedron's 12 vertices as anchors (Zhu et al., CVPR 2023).

A feature f(x, v) lives at points and directions, SO(3) / C5; turned by a rotation g of the group
it is f'(g x, g v) = f(x, v). The kernel must not change under the five turns about its anchor:
of the 13 x 12 pairs of a kernel point and a direction, those that the turns take into each other
share a matrix, which leaves 36. `to_rotations` reads the 60 rotations off the 12 directions.

Not as published: E2PN stores 5 classes of kernel points times 12 directions; 36 orbits are what
equivariance to all 60 rotations asks for.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from scapo.equivariant.anchors import ROTATIONS, TURNS, VERTICES, icosahedron
from scapo.equivariant.layers import ChannelNorm, Skip, correlate, kernel_images, leaky
from scapo.equivariant.levels import KERNEL, Neighbourhood

ORBITS = 36


def orbits() -> list[list[int]]:
    """Pairs 12 k + v of kernel point k and vertex v, by the turns about vertex 0.

    Orbits of five first, then the six pairs on the line of vertex 0, which stay.
    """
    pairs = _images()[:TURNS].mT.tolist()  # (156, 5): where the turns take each pair
    classes = {tuple(sorted(set(row))): row for row in pairs}
    return sorted((sorted(set(row)) for row in classes.values()), key=lambda row: (-len(row), row))


def _images() -> Int[Tensor, "60 156"]:
    pair = kernel_images()[:, :, None] * VERTICES + icosahedron().image[:, None]
    return pair.flatten(1)


class QuotientConv(nn.Module):
    """out(x, v) = sum_o W_o sum_(k,u) in o sum_y w(y - x, R_v p_k) f(y, R_v u), o the orbits.

    One product with the matrix of all pairs and vertices, W_o copied to where its pairs are: four
    times the multiplications of summing the pairs of each orbit first, in less time.
    """

    orbit: Tensor

    def __init__(self, inputs: int, outputs: int, *, recompute: bool = False) -> None:
        """`recompute` correlations (13 times the features) for the gradient, do not keep them."""
        super().__init__()
        self.recompute = recompute
        self.linear = nn.Linear(ORBITS * inputs, outputs, bias=False)
        orbit, images = torch.zeros(VERTICES, KERNEL * VERTICES, dtype=torch.long), _images()
        for number, members in enumerate(orbits()):
            for v in range(VERTICES):
                orbit[v, images[TURNS * v, members]] = number
        self.register_buffer("orbit", orbit.flatten(), persistent=False)

    def forward(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K 12 O"]:
        """Of 12 anchors, or of 1: plain features of points, such as ones or colours."""
        if self.recompute and torch.is_grad_enabled():
            return checkpoint(self._convolve, features, near, use_reentrant=False)
        return self._convolve(features, near)

    def _convolve(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K 12 O"]:
        channels = features.shape[3]
        found = correlate(features, near).unflatten(3, (-1, channels))  # (B, K, 13, A, C)
        pairs = found.expand(-1, -1, -1, VERTICES, -1).flatten(2)  # (B, K, 156 C)
        return (pairs @ self._matrix().to(pairs.dtype)).unflatten(2, (VERTICES, -1))

    def _matrix(self) -> Float[Tensor, "I O"]:
        """From all pairs, 156 C, to all vertices, 12 O."""
        weight = self.linear.weight.unflatten(1, (ORBITS, -1)).permute(1, 2, 0)  # (36, C, O)
        placed = weight.flatten(1).index_select(0, self.orbit).view(VERTICES, -1, *weight.shape[1:])
        return placed.permute(1, 2, 0, 3).flatten(2).flatten(0, 1)


class QuotientBlock(nn.Module):
    """The convolution with its norm, and a 1 x 1 skip from each centre's own features."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        slope: float = 0.0,
        recompute: bool = False,
        skip_norm: bool = True,
    ) -> None:
        """ReLU, leaky with this `slope`; without `skip_norm` where inputs can be constant."""
        super().__init__()
        self.slope = slope
        self.conv = QuotientConv(inputs, outputs, recompute=recompute)
        self.norm = ChannelNorm(outputs)
        self.skip = Skip(inputs, outputs, norm=skip_norm)

    def forward(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K 12 O"]:
        """Features of the centres of `near`, from those of the points that it was made of."""
        main = self.norm(self.conv(features, near))
        return leaky(main + self.skip(features, near), self.slope)


def to_rotations(features: Float[Tensor, "*B 12 C"]) -> Float[Tensor, "*B 60 12*C"]:
    """The 12 directions as each of the 60 rotations sees them: R_a v_0, R_a v_1, ...

    Turned by g, a cloud has the row of R_a at g R_a: a layer on the last axis is equivariant.
    """
    table = icosahedron().image.flatten().to(features.device)
    return features.index_select(-2, table).unflatten(-2, (ROTATIONS, VERTICES)).flatten(-2)
