# SPDX-License-Identifier: MIT
"""Stage 1: the equivariant encoder Theta_E and the decoder Theta_D (Sec. 3.1).

The encoder is VNT (Katzir et al. 2022), the decoder AtlasNet (Groueix et al. 2018) as VNT uses
it; sizes are docs/method.md's. All lengths are in normalised units (mean radius 0.25).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.geometry.numerics import exact
from scapo.geometry.points import chamfer, gather
from scapo.geometry.rigid import gram_schmidt, project_rotation, rotation_angle
from scapo.paper.vector_neurons import (
    TINY,
    EdgeForm,
    NormForm,
    VNBlock,
    VNLinear,
    edge_vectors,
    spread_centres,
    uniform,
)
from scapo.ranges import Neighbours

Projection = Literal["svd", "gram-schmidt"]
PoseForm = Literal["pooled", "votes"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderConfig:
    """Sizes of Theta_E; defaults as VNT."""

    neighbours: Neighbours = 40
    """Edges per point."""
    centres: int | None = None
    """Points that carry features; None = all of them."""
    pool: int = 256
    """Farthest-point sampling chooses the centres among this many points."""
    width: int = 21
    """Vector channels of the first layers."""
    branch: tuple[int, int, int, int] = (42, 341, 170, 85)
    """Channels of the global branch: two layers per point, two after pooling."""
    features: int = 170
    """Vector channels per point; the invariants number 6 times that."""
    edge: EdgeForm = "point"
    norm: NormForm = "scale"
    projection: Projection = "svd"
    pose: PoseForm = "pooled"
    """R_g from pooled vectors, or from where every centre says that it lies in the aligned frame
    (not in the paper)."""
    hypotheses: int = 1
    """Rotations of a cloud, of which the one counts that brings it nearest to S_dec (as OP-Align
    chooses among 60; the paper has one)."""

    def __post_init__(self) -> None:
        """Raise ValueError for no hypothesis at all."""
        if self.hypotheses < 1:
            raise ValueError(f"encoder: expected at least 1 hypothesis, found {self.hypotheses}")

    @property
    def code(self) -> int:
        """Length of Z_x: 2 * features vectors times 3 frame vectors."""
        return 6 * self.features


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding:
    """What the encoder says of a cloud."""

    frame: Float[Tensor, "B 3 3"]
    """Raw prediction; columns are the aligned axes in the input frame, not yet orthonormal."""
    rotation: Float[Tensor, "B 3 3"]
    """input_R_aligned, the transpose of the paper's R_g."""
    translation: Float[Tensor, "B 3"]
    """t_g, the aligned origin in the input frame."""
    code: Float[Tensor, "B Z"]
    """Z_x, invariant to rigid motions."""
    frames: Float[Tensor, "B H 3 3"] | None = None
    """Of all hypotheses, raw; None where there is one."""
    chosen: Int[Tensor, " B"] | None = None
    """Which of them `frame` and `rotation` are."""

    def nearest(
        self, points: Float[Tensor, "B N 3"], shape: Float[Tensor, "B M 3"], config: EncoderConfig
    ) -> Encoding:
        """By the hypothesis that brings the points nearest to a shape in the aligned frame."""
        if self.frames is None:
            return self
        with torch.no_grad():
            turns = project(self.frames, config).unbind(1)
            off = [chamfer(replace(self, rotation=turn).align(points), shape) for turn in turns]
        return self.by(torch.stack(off, 1).argmin(1), config)

    def facing(self, rotation: Float[Tensor, "B 3 3"], config: EncoderConfig) -> Encoding:
        """By the hypothesis that is nearest to a rotation."""
        if self.frames is None:
            return self
        with torch.no_grad():
            near = (project(self.frames, config) * rotation[:, None]).sum((-1, -2))
        return self.by(near.argmax(1), config)

    def by(self, chosen: Int[Tensor, " B"] | None, config: EncoderConfig) -> Encoding:
        """By the hypotheses of those numbers."""
        if self.frames is None or chosen is None:
            return self
        frame = self.frames[torch.arange(len(chosen), device=chosen.device), chosen]
        return replace(self, frame=frame, rotation=project(frame, config), chosen=chosen)

    def align(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
        """S_obj = (X - 1 t_g^T) R_g^T in the paper's letters: input to aligned frame."""
        return (points - self.translation[:, None]) @ self.rotation

    def place(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
        """X = S R_g + 1 t_g^T in the paper's letters: aligned to input frame."""
        return points @ self.rotation.mT + self.translation[:, None]


ALIKE = 1.0
"""Frames of one cloud that are this near to each other, in radians, are one answer."""


def mean_encoding(looks: Sequence[Encoding]) -> Encoding:
    """Of the same clouds, seen several times: the mean of those that agree with most others."""
    rotation = torch.stack([look.rotation for look in looks], 1)  # (B, L, 3, 3)
    pair = torch.broadcast_tensors(rotation[:, :, None], rotation[:, None])
    alike = rotation_angle(*pair) < ALIKE  # (B, L, L)
    row = torch.arange(len(alike), device=alike.device)
    chosen = alike[row, alike.sum(-1).argmax(-1)].to(rotation)  # (B, L)
    share = (chosen / chosen.sum(-1, keepdim=True))[..., None]
    frame = (share[..., None] * rotation).sum(1)
    with exact(frame.device.type):
        nearest = project_rotation(frame)
    return Encoding(
        frame=frame,
        rotation=nearest,
        translation=(share * torch.stack([look.translation for look in looks], 1)).sum(1),
        code=(share * torch.stack([look.code for look in looks], 1)).sum(1),
    )


def project(frame: Float[Tensor, "*B 3 3"], config: EncoderConfig) -> Float[Tensor, "*B 3 3"]:
    """The rotation that is used wherever one is needed; `frame` itself feeds L_ortho alone."""
    with exact(frame.device.type):
        if config.projection == "svd":
            return project_rotation(frame)
        return gram_schmidt(frame[..., 0], frame[..., 1])


class Encoder(nn.Module):
    """Theta_E: cloud -> pose (R_g, t_g) that moves along and code Z_x that does not change."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        width, (local, wide, half, quarter) = config.width, config.branch
        block = partial(VNBlock, norm=config.norm)
        self.edge = block(3, width, affine=True)
        self.centre = nn.Sequential(
            block(width, width, affine=True), VNLinear(width, 1, affine=True)
        )
        self.point = block(width, width)
        self.before = nn.Sequential(block(width, width), block(width, local), block(local, wide))
        self.after = nn.Sequential(
            block(wide, half), block(half, quarter), VNLinear(quarter, width)
        )
        self.mix = block(2 * width, 2 * width)
        self.widen = block(2 * width, config.features)
        self.pose = (
            VNLinear(config.features, 3 * config.hypotheses)
            if config.pose == "pooled"
            else nn.Linear(config.code, 3 * config.hypotheses)
        )
        self.frame = nn.Sequential(
            block(2 * config.features, config.features),
            block(config.features, config.features // 2),
            VNLinear(config.features // 2, 3),
        )

    def forward(self, points: Float[Tensor, "B N 3"]) -> Encoding:
        """Encode clouds of any number of points, at least as many as neighbours."""
        # VNT layers carry the centroid b along; taking it out first and adding it to t_g is the
        # same map, and spares float32 the cancellation.
        middle = points.mean(1, keepdim=True)
        points = points - middle
        centres = self.centres(points)
        point = self.local_features(points, centres)  # (B, M, 3, width)
        origin = self.centre(point)  # (B, M, 3, 1)
        translation = origin.mean(1)[..., 0] + middle[:, 0]
        feature = self.shape_features(point - origin)  # (B, M, 3, features)
        pooled = feature.mean(1)  # (B, 3, features)
        invariants = self.invariants(feature, pooled)
        frames = self.frames(pooled, invariants, centres)
        return Encoding(
            frame=frames[:, 0],
            rotation=project(frames[:, 0], self.config),
            translation=translation,
            code=invariants.amax(1),
            frames=frames if self.config.hypotheses > 1 else None,
        )

    def centres(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B M 3"]:
        """Points that carry features."""
        config = self.config
        if config.centres is None or config.centres >= points.shape[1]:
            return points
        return gather(points, spread_centres(points, config.centres, config.pool))

    def frames(
        self,
        pooled: Float[Tensor, "B 3 C"],
        invariants: Float[Tensor, "B M Z"],
        centres: Float[Tensor, "B M 3"],
    ) -> Float[Tensor, "B H 3 3"]:
        """Raw frames: vectors of the whole cloud, or what the votes of its centres agree on.

        A centre votes where it lies; the covariance of places and votes is the frame, over the root
        of their mean squares, so that a rotation of unit length is what agreement gives.
        """
        if self.config.pose == "pooled":
            return self.pose(pooled).unflatten(-1, (-1, 3)).transpose(1, 2)
        votes = self.pose(invariants).unflatten(-1, (-1, 3)).transpose(1, 2)  # (B, H, M, 3)
        votes = votes - votes.mean(2, keepdim=True)
        places = (centres - centres.mean(1, keepdim=True))[:, None]
        size = votes.square().mean((2, 3), keepdim=True) * places.square().mean(
            (2, 3), keepdim=True
        )
        return places.mT @ votes / (places.shape[2] * (size + TINY).sqrt())

    def local_features(
        self, points: Float[Tensor, "B N 3"], centres: Float[Tensor, "B M 3"]
    ) -> Float[Tensor, "B M 3 C"]:
        """Mean over the edges of each centre; translations pass through (VNT)."""
        edges = edge_vectors(points, centres, self.config.neighbours, self.config.edge)
        return self.edge(edges).mean(2)

    def shape_features(self, point: Float[Tensor, "B M 3 W"]) -> Float[Tensor, "B M 3 C"]:
        """Orientation-aware features per centre, with the global branch mixed in (VN)."""
        point = self.point(point)
        whole = self.after(self.before(point).mean(1))  # (B, 3, width)
        whole = whole[:, None].expand_as(point)
        return self.widen(self.mix(torch.cat([point, whole], -1)))

    def invariants(
        self, feature: Float[Tensor, "B M 3 C"], pooled: Float[Tensor, "B 3 C"]
    ) -> Float[Tensor, "B M Z"]:
        """Inner products of the features with three learned equivariant vectors per centre."""
        both = torch.cat([feature, pooled[:, None].expand_as(feature)], -1)  # (B, M, 3, 2C)
        frame = self.frame(both)  # (B, M, 3, 3)
        return (both.mT @ frame).flatten(-2)


@dataclass(frozen=True, slots=True, kw_only=True)
class DecoderConfig:
    """Sizes of Theta_D; defaults as VNT, 8 patches so that N = 1024 divides evenly."""

    patches: int = 8
    points: int = 1024
    """In all patches together, the N of the paper."""
    widths: tuple[int, int, int] = (1022, 511, 255)

    def __post_init__(self) -> None:
        """Refuse sizes that do not divide.

        Raises:
            ValueError: `points` is no multiple of `patches`.
        """
        if self.points % self.patches:
            raise ValueError(
                f"decoder: expected points a multiple of {self.patches} patches, "
                f"found {self.points}"
            )


class PatchLinear(nn.Module):
    """One linear layer per patch: (patches, inputs, L) -> (patches, outputs, L)."""

    def __init__(self, patches: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(patches, outputs, inputs))
        self.bias = nn.Parameter(torch.zeros(patches, outputs, 1))

    def reset(self, generator: torch.Generator) -> None:
        """Uniform in +-1/sqrt(inputs)."""
        bound = self.weight.shape[-1] ** -0.5
        uniform(self.weight, bound, generator)
        uniform(self.bias, bound, generator)

    def forward(self, x: Float[Tensor, "P I L"]) -> Float[Tensor, "P O L"]:
        """Apply each patch's own matrix."""
        return torch.baddbmm(self.bias, self.weight, x)


class PatchNorm(nn.Module):
    """Batch norm of each channel of each patch over (P, C, L)."""

    def __init__(self, patches: int, channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(patches * channels)

    def forward(self, x: Float[Tensor, "P C L"]) -> Float[Tensor, "P C L"]:
        """Same shape."""
        return self.norm(x.flatten(0, 1)[None]).view_as(x)


class Decoder(nn.Module):
    """Theta_D: code Z_x -> canonical shape S_dec (B, N, 3) and features F_x (B, N, C).

    The order of the points is fixed by the patches, so Y_base can share it.
    """

    def __init__(self, config: DecoderConfig, code: int) -> None:
        super().__init__()
        self.config = config
        patches, (first, second, third) = config.patches, config.widths
        self.grid = nn.Parameter(torch.zeros(patches, 2, config.points // patches))
        # The first layer's two inputs apart: the code's share is the same for all points.
        self.from_code = nn.Linear(code, patches * first, bias=False)
        self.from_grid = PatchLinear(patches, 2, first)
        self.hidden = nn.ModuleList(
            [PatchLinear(patches, first, second), PatchLinear(patches, second, third)]
        )
        self.norms = nn.ModuleList([PatchNorm(patches, width) for width in config.widths])
        self.out = PatchLinear(patches, third, 3)

    def reset(self, generator: torch.Generator) -> None:
        """The grids, uniform in the square of side 2."""
        uniform(self.grid, 1.0, generator)

    def forward(
        self, code: Float[Tensor, "B Z"]
    ) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B N C"]]:
        """S_dec, coordinates within +-1 by tanh, and F_x, the activation before the last layer."""
        batch, patches = code.shape[0], self.config.patches
        by_code = self.from_code(code).unflatten(1, (patches, -1)).permute(1, 2, 0)  # (p, C, B)
        by_grid = self.from_grid(self.grid)  # (p, C, n)
        x = (by_code[..., None] + by_grid[:, :, None]).flatten(2)  # (p, C, B n)
        x = F.relu(self.norms[0](x))
        for layer, norm in zip(self.hidden, self.norms[1:], strict=True):
            x = F.relu(norm(layer(x)))
        shape = torch.tanh(self.out(x))
        return self._rows(shape, batch), self._rows(x, batch)

    @staticmethod
    def _rows(x: Float[Tensor, "P C L"], batch: int) -> Float[Tensor, "B N C"]:
        """(patches, C, B n) -> (B, patches n, C)."""
        return x.unflatten(2, (batch, -1)).permute(2, 0, 3, 1).flatten(1, 2)
