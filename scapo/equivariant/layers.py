# SPDX-License-Identifier: MIT
"""What convolutions of both kinds are made of: rows copied, norms, pooling over points.

All heavy steps are row gathers and matrix products. Picking rows has its gradient by hand: the
same gathers the other way round, in place of scattered additions.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.equivariant.anchors import ROTATIONS, icosahedron
from scapo.equivariant.levels import KERNEL, Neighbourhood


class _Spread(torch.autograd.Function):
    """out[:, t] = x[:, index[t]]; the gradient of a row is the sum over `back[:, row]`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, index: Tensor, back: Tensor) -> Tensor:  # noqa: ANN401
        """From (R, S, C) by index (T) to (R, T, C); back (G, S) says where each row went."""
        ctx.save_for_backward(back)
        return x.index_select(1, index)

    @staticmethod
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        gradient: Tensor,
    ) -> tuple[Tensor, None, None]:
        """To x alone."""
        (back,) = ctx.saved_tensors
        total = gradient.index_select(1, back[0])
        for some in back[1:]:
            total = total + gradient.index_select(1, some)
        return total, None, None


class Spread(nn.Module):
    """Rows copied by a table, each equally often."""

    index: Tensor
    back: Tensor

    def __init__(self, index: Int[Tensor, " T"], count: int) -> None:
        """Make the table of the gradient.

        Args:
            index: Which of the rows stands at each place.
            count: How many rows there are.

        Raises:
            ValueError: Some rows are copied more often than others.
        """
        super().__init__()
        uses = index.bincount(minlength=count)
        if bool((uses != uses[0]).any()):
            raise ValueError(f"table: expected equal uses of all rows, found {uses.tolist()}")
        back = index.argsort(stable=True).view(count, -1).mT
        self.register_buffer("index", index.contiguous(), persistent=False)
        self.register_buffer("back", back.contiguous(), persistent=False)

    def forward(self, x: Float[Tensor, "R S C"]) -> Float[Tensor, "R T C"]:
        """Copy."""
        return _Spread.apply(x, self.index, self.back)


def rows(
    values: Float[Tensor, "B M D"],
    index: Int[Tensor, "B *K"],  # noqa: UP037, F821 - a shape
) -> Float[Tensor, "B *K D"]:
    """values[b, index[b]]: whole rows are copied, which `torch.gather` does number by number."""
    start = torch.arange(len(values), device=index.device) * values.shape[1]
    flat = (index.flatten(1) + start[:, None]).flatten()
    return values.flatten(0, 1).index_select(0, flat).view(*index.shape, values.shape[2])


def correlate(
    features: Float[Tensor, "B M A C"], near: Neighbourhood
) -> Float[Tensor, "B K 13 A*C"]:
    """Features of each centre's neighbours, summed with their weights at the kernel points."""
    return near.weight.to(features.dtype) @ rows(features.flatten(2), near.index)


def kernel_images() -> Int[Tensor, "60 13"]:
    """Which kernel point a rotation takes each of them to; the centre stays."""
    centre = torch.full((ROTATIONS, 1), KERNEL - 1)
    return torch.cat([icosahedron().image, centre], 1)


class ChannelNorm(nn.BatchNorm1d):
    """Batch norm of each channel over clouds, points and anchors alike."""

    def forward(self, input: Float[Tensor, "*B C"]) -> Float[Tensor, "*B C"]:  # noqa: A002
        """Over the last axis."""
        return super().forward(input.reshape(-1, input.shape[-1])).view_as(input)


class Skip(nn.Module):
    """A 1 x 1 layer from each centre's own features."""

    def __init__(self, inputs: int, outputs: int, *, norm: bool = True) -> None:
        """Without `norm` where features can be constant, such as ones.

        A batch of them has no variance: in training the norm gives its bias alone, and later it
        divides by next to nothing how far the weights have moved since its running mean.
        """
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = ChannelNorm(outputs) if norm else nn.Identity()

    def forward(
        self, features: Float[Tensor, "B M A C"], near: Neighbourhood
    ) -> Float[Tensor, "B K A O"]:
        """A = 1 stays 1: it is added to all anchors alike."""
        own = rows(features.flatten(2), near.centre).unflatten(2, features.shape[2:])
        return self.norm(self.linear(own))


class PointPool(nn.Module):
    """A pointwise layer on features and each anchor's coordinates, the greatest over points.

    Coordinates of the 60: R_a^T (x - mean). Of the 12 vertices, which leave the turn about
    themselves open: the coordinate along the vertex and the distance from its line.
    """

    frames: Tensor

    def __init__(self, inputs: int, outputs: int, anchors: int) -> None:
        super().__init__()
        group = icosahedron()
        frames = group.rotations if anchors == ROTATIONS else group.vertices[:, :, None]
        self.linear = nn.Linear(inputs + (3 if anchors == ROTATIONS else 2), outputs)
        self.register_buffer("frames", frames.float(), persistent=False)

    def forward(
        self, features: Float[Tensor, "B K A C"], points: Float[Tensor, "B K 3"]
    ) -> Float[Tensor, "B A O"]:
        """Of points in the frame that the features were made in."""
        points = points - points.mean(1, keepdim=True)
        seen = anchor_coordinates(points, self.frames)
        return self.linear(torch.cat([features, seen.to(features.dtype)], -1)).amax(1)


def anchor_coordinates(
    points: Float[Tensor, "B K 3"], frames: Float[Tensor, "A 3 F"]
) -> Float[Tensor, "B K A G"]:
    """Coordinates of points in frames; along a direction and off its line where F is 1."""
    frames = frames.to(points.dtype)
    seen = torch.einsum("aji,bnj->bnai", frames, points)
    if frames.shape[2] == 3:
        return seen
    off = torch.linalg.cross(points[:, :, None], frames[:, :, 0].expand(*points.shape[:2], -1, 3))
    return torch.cat([seen, (off.square().sum(-1, keepdim=True) + 1e-12).sqrt()], -1)


def leaky(x: Float[Tensor, "*B"], slope: float) -> Float[Tensor, "*B"]:
    """ReLU, leaky where the slope is not 0."""
    return F.leaky_relu(x, slope) if slope else F.relu(x)
