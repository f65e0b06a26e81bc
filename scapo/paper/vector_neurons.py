# SPDX-License-Identifier: MIT
"""Layers on lists of 3-D vectors that commute with rotations, and with translations where asked.

Vector neurons (VN): Deng et al., ICCV 2021. With translations (VNT): Katzir et al., ECCV 2022.
A feature is `C` vectors, stored (..., 3, C): the coordinate axis before the channels, so that a
linear layer is one matrix product over the last axis. f(Q x) = Q f(x) for every rotation Q;
layers made with `affine=True` also give f(x + t) = f(x) + t for every vector t added to all C.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.first_weights import uniform
from scapo.geometry.numerics import at_least_float32, exact
from scapo.geometry.points import farthest_points, gather, k_nearest

EdgeForm = Literal["point", "mean"]
NormForm = Literal["scale", "length"]

TINY = 1e-12
"""Added under square roots of squared lengths, which are of the order of 1e-2 or more."""


class Rectify(torch.autograd.Function):
    """x - min(x.d, 0) / |d|^2 d over the coordinate axis, its gradient by hand in half the time."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, d: Tensor) -> Tensor:  # noqa: ANN401
        """Inputs (..., 3, C): vectors and their directions."""
        inverse = ((d * d).sum(-2, keepdim=True) + 1e-6).reciprocal_()
        share = (x * d).sum(-2, keepdim=True).clamp_(max=0).mul_(inverse)
        ctx.save_for_backward(x, d, share, inverse)
        return torch.addcmul(x, share, d, value=-1)

    @staticmethod
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        gradient: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """To x and d."""
        x, d, share, inverse = ctx.saved_tensors
        along = (gradient * d).sum(-2, keepdim=True) * inverse * (share < 0)
        to_x = torch.addcmul(gradient, along, d, value=-1)
        to_d = (gradient * -share).addcmul_(x, along, value=-1).addcmul_(d, 2 * along * share)
        return to_x, to_d


def product(x: Float[Tensor, "*B 3 I"], rows: Float[Tensor, "O I"]) -> Float[Tensor, "*B 3 O"]:
    """Linear map over the channels, in float32 where autocast multiplies in half precision."""
    return at_least_float32(F.linear(x, rows))


class VNLinear(nn.Module):
    """Linear map over the channels, without bias.

    `affine`: every row of the weight is shifted to sum to 1 (VNT), so that a translation of all
    inputs passes through. The reference divides by the row sum instead, which spans the same maps
    but has a pole where the sum is 0.
    """

    def __init__(self, inputs: int, outputs: int, *, affine: bool = False) -> None:
        super().__init__()
        self.affine = affine
        self.weight = nn.Parameter(torch.zeros(outputs, inputs))

    def reset(self, generator: torch.Generator) -> None:
        """Uniform in +-1/sqrt(inputs)."""
        uniform(self.weight, self.weight.shape[1] ** -0.5, generator)

    def rows(self) -> Float[Tensor, "O I"]:
        """The matrix that is applied."""
        if not self.affine:
            return self.weight
        return self.weight + (1 - self.weight.sum(1, keepdim=True)) / self.weight.shape[1]

    def forward(self, x: Float[Tensor, "*B 3 I"]) -> Float[Tensor, "*B 3 O"]:
        """(..., 3, inputs) -> (..., 3, outputs)."""
        return product(x, self.rows())


class VectorScale(nn.Module):
    """Learned gain over the root mean square length of each channel, running mean for eval.

    Lengths are read off the second moments of what comes in, so nothing is multiplied that is as
    large as the features are.
    """

    mean_square: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(channels))
        self.register_buffer("mean_square", torch.ones(channels))

    def forward(
        self, x: Float[Tensor, "*B 3 I"], rows: Float[Tensor, "O I"]
    ) -> Float[Tensor, "O I"]:
        """The rows, so that what they make of x has root mean square lengths of the gain."""
        mean_square = self.mean_square
        if self.training:
            flat = x.flatten(0, -2)
            with exact(x.device.type):
                moments = flat.mT @ flat * (3 / len(flat))
                mean_square = ((rows @ moments) * rows).sum(1).clamp_min(0)
            with torch.no_grad():
                self.mean_square.lerp_(mean_square, 0.1)
        return rows * (self.gain * (mean_square + TINY).rsqrt())[:, None]


class VNBatchNorm(nn.Module):
    """Batch norm of the lengths of a linear map's vectors; directions stay.

    `length` is Deng et al.'s: (length - mean) / deviation as the new length. It amplifies relative
    errors about twofold, so a dozen layers leave three digits of float32, and it tears vectors
    apart at length 0. `scale` divides by the root mean square length instead and has neither
    fault. `affine`: lengths are measured from the mean of the channels (VNT), which moves along
    with a translation.
    """

    def __init__(self, channels: int, *, affine: bool = False, form: NormForm = "scale") -> None:
        super().__init__()
        self.affine = affine
        self.norm = nn.BatchNorm1d(channels) if form == "length" else VectorScale(channels)

    def forward(
        self, x: Float[Tensor, "*B 3 I"], rows: Float[Tensor, "O I"], origin: Tensor | float = 0.0
    ) -> Float[Tensor, "*B 3 O"]:
        """Equivariant in eval mode, in training mode up to the batch's statistics.

        Args:
            x: What the linear map is of.
            rows: Its matrix.
            origin: Rows of another map, which is subtracted after the norm.
        """
        centre = rows.mean(0, keepdim=True) if self.affine else rows.new_zeros(1)
        if isinstance(self.norm, VectorScale):
            return product(x, self.norm(x, rows - centre) + centre - origin)
        about = product(x, rows - centre)
        length = (about.square().sum(-2) + TINY).sqrt()  # (..., O)
        gain = (self.norm(length.flatten(0, -2)).view_as(length) / length)[..., None, :]
        return about * gain + (product(x, centre - origin) if self.affine else 0.0)


def rectify(
    x: Float[Tensor, "*B 3 C"], direction: Float[Tensor, "*B 3 C"]
) -> Float[Tensor, "*B 3 C"]:
    """ReLU of vectors: where x points against its direction, that component is removed."""
    return Rectify.apply(x, direction)


class VNBlock(nn.Module):
    """Linear map, batch norm of lengths, ReLU along a learned direction.

    `affine`: batch norm about the channel mean and ReLU relative to a learned origin (VNT).
    """

    def __init__(
        self, inputs: int, outputs: int, *, affine: bool = False, norm: NormForm = "scale"
    ) -> None:
        super().__init__()
        self.feature = VNLinear(inputs, outputs, affine=affine)
        self.direction = VNLinear(inputs, outputs, affine=affine)
        self.origin = VNLinear(inputs, 1, affine=True) if affine else None
        self.norm = VNBatchNorm(outputs, affine=affine, form=norm)

    def forward(self, x: Float[Tensor, "*B 3 I"]) -> Float[Tensor, "*B 3 O"]:
        """(..., 3, inputs) -> (..., 3, outputs)."""
        rows, direction = self.feature.rows(), self.direction.rows()
        if self.origin is None:
            return rectify(self.norm(x, rows), product(x, direction))
        origin = self.origin.rows()
        relative = rectify(self.norm(x, rows, origin), product(x, direction - origin))
        return relative + product(x, origin)


@torch.no_grad()
def spread_centres(
    points: Float[Tensor, "B N 3"], count: int, pool: int
) -> Int[Tensor, "B {count}"]:
    """Indices of well-spread points: farthest-point sampling among `pool` of the cloud's points.

    The pool is evenly taken from the order of the points. Starts from the point farthest from the
    centroid, so the choice does not depend on the order of the pool and turns with the cloud.
    """
    number = points.shape[1]
    pool = max(count, min(pool, number))
    candidate = torch.arange(pool, device=points.device) * number // pool
    centroid = points.mean(1, keepdim=True)
    chosen = farthest_points(torch.cat([centroid, points[:, candidate]], 1), count + 1)[:, 1:]
    return candidate[(chosen - 1).clamp(min=0)]  # fewer different points: the first again


def edge_vectors(
    points: Float[Tensor, "B N 3"],
    centres: Float[Tensor, "B M 3"],
    neighbours: int,
    form: EdgeForm = "point",
) -> Float[Tensor, "B M {neighbours} 3 3"]:
    """Three vectors per edge to a near point x_j: x_j - o, o and x_j cross o, channels last.

    The local origin o is the centre point x_i (VNT's standard form) or the mean of its
    neighbours (its improved form). The cross product is what lets the features tell a shape
    from its mirror image.
    """
    index = k_nearest(centres, points, neighbours)  # (B, M, k)
    near = gather(points, index.flatten(1)).unflatten(1, index.shape[1:])  # (B, M, k, 3)
    origin = near.mean(2, keepdim=True) if form == "mean" else centres[:, :, None]
    origin = origin.expand_as(near)
    return torch.stack([near - origin, origin, torch.linalg.cross(near, origin)], -1)
