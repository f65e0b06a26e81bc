# SPDX-License-Identifier: MIT
"""EPN: separable SE(3) convolution with the 60 rotations as anchors (Chen et al., CVPR 2021).

A feature f(x, R_a) lives at points and anchors. Turned by an anchor g of the group, a cloud has
the same features elsewhere: f'(g x, g R_a) = f(x, R_a). A convolution over SE(3) is done in two:
over space, with a kernel turned by each anchor, then over the group at each point.

Not as published: the kernel's points are the icosahedron's (`levels`), where EPN has 24 or more of
its own, so that 13 correlations serve all anchors in place of 60 x 24; the group convolution sees
the anchor and the 12 least turns, EPN 12 anchors of the anchor's own and the adjoining faces.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from scapo.equivariant.anchors import ROTATIONS, icosahedron
from scapo.equivariant.layers import ChannelNorm, Skip, Spread, correlate, kernel_images, leaky
from scapo.equivariant.levels import KERNEL, Neighbourhood


class PointConv(nn.Module):
    """Over space: out(x, a) = sum_k W_k sum_y w(y - x, R_a p_k) f(y, a), p_k of the kernel."""

    def __init__(self, inputs: int, outputs: int, *, recompute: bool = False) -> None:
        """`recompute` the correlations (13 times the features) for the gradient, not keep them."""
        super().__init__()
        self.recompute = recompute
        self.linear = nn.Linear(KERNEL * inputs, outputs, bias=False)
        image = kernel_images()
        anchor = torch.arange(ROTATIONS)[:, None]
        self.turn = Spread((image * ROTATIONS + anchor).flatten(), KERNEL * ROTATIONS)
        self.turn_scalars = Spread(image.flatten(), KERNEL)

    def forward(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K 60 O"]:
        """Of 60 anchors, or of 1: plain features of points, such as ones or colours."""
        if self.recompute and torch.is_grad_enabled():
            return checkpoint(self._convolve, features, near, use_reentrant=False)
        return self._convolve(features, near)

    def _convolve(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K 60 O"]:
        batch, _, anchors, channels = features.shape
        turn = self.turn if anchors == ROTATIONS else self.turn_scalars
        found = correlate(features, near)  # (B, K, 13, A C)
        turned = turn(found.reshape(-1, KERNEL * anchors, channels))  # (B K, 60 13, C)
        return self.linear(turned.view(batch, -1, ROTATIONS, KERNEL * channels))


class GroupConv(nn.Module):
    """Over the group: out(x, a) = sum_h W_h f(x, R_a h), h the identity and the 12 fifth turns."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        near = least_turns()
        self.linear = nn.Linear(len(near) * inputs, outputs, bias=False)
        self.spread = Spread(icosahedron().product[:, near].flatten(), ROTATIONS)

    def forward(self, features: Float[Tensor, "B K 60 C"]) -> Float[Tensor, "B K 60 O"]:
        """At each point by itself."""
        batch, count, anchors, _ = features.shape
        spread = self.spread(features.flatten(0, 1))  # (B K, 60 13, C)
        return self.linear(spread.view(batch, count, anchors, -1))


def least_turns() -> Tensor:
    """The identity and the 12 rotations by 72 degrees."""
    trace = icosahedron().rotations.diagonal(dim1=1, dim2=2).sum(-1)
    return trace.argsort(descending=True, stable=True)[:13]


class SeparableBlock(nn.Module):
    """Both convolutions with norms, and a 1 x 1 skip from each centre's own features."""

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
        self.space = PointConv(inputs, outputs, recompute=recompute)
        self.space_norm = ChannelNorm(outputs)
        self.group = GroupConv(outputs, outputs)
        self.group_norm = ChannelNorm(outputs)
        self.skip = Skip(inputs, outputs, norm=skip_norm)

    def forward(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K 60 O"]:
        """Features of the centres of `near`, from those of the points that it was made of."""
        inner = leaky(self.space_norm(self.space(features, near)), self.slope)
        main = self.group_norm(self.group(inner))
        return leaky(main + self.skip(features, near), self.slope)
