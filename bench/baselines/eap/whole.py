# SPDX-License-Identifier: MIT
"""Stage 0 of EAP: one rotation of the whole object per anchor, chosen by reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from bench.baselines.eap.layers import Encoder, EncoderConfig, PerAnchor, Readout, ShapeDecoder
from bench.baselines.eap.losses import shape_distances
from scapo.geometry.points import chamfer
from scapo.geometry.rotations import unitquat_to_rotmat
from scapo.paper.heads import thin


@dataclass(frozen=True, slots=True, kw_only=True)
class WholeConfig:
    """Sizes of stage 0."""

    width: int = 256
    """Channels of the code and of the layers after the encoder."""
    points: int = 512
    """Points of the reconstructed shape."""
    chosen_by: int | None = None
    """Points of the cloud that choose the anchor; None = all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Whole:
    """What stage 0 says; clouds are centred already, so that there is no translation."""

    rotation: Float[Tensor, "B 3 3"]
    """Of the chosen anchor, input_R_aligned."""
    anchor: Int[Tensor, " B"]
    aligned: Float[Tensor, "B N 3"]
    shape: Float[Tensor, "B M 3"]
    """The reconstruction, aligned frame."""

    def loss(self) -> Float[Tensor, ""]:
        """Two-way Chamfer distance under the chosen anchor."""
        return chamfer(self.aligned, self.shape).mean()


class WholeStage(nn.Module):
    """EPN -> a residual rotation of every anchor and a shape; the anchor that fits best."""

    def __init__(self, config: WholeConfig, encoder: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(encoder, group=True)
        self.readout = Readout(encoder.channels[-1], config.width)
        self.residual = PerAnchor(config.width, 4)
        self.decoder = ShapeDecoder(config.width, config.width, config.points)

    def forward(self, looked_at: Float[Tensor, "B K 3"], points: Float[Tensor, "B N 3"]) -> Whole:
        """R_k = anchor_k Q_k, Q_k a unit quaternion; the least two-way distance chooses.

        Args:
            looked_at: Points for the encoder.
            points: All of the cloud, which is aligned.
        """
        summary = self.readout(looked_at, self.encoder(looked_at))
        numbers = self.residual(summary.anchors)
        identity = numbers.new_tensor([0.0, 0.0, 0.0, 1.0])
        residual = unitquat_to_rotmat(F.normalize(numbers + identity, dim=-1))
        rotations = self.readout.rotations @ residual  # (B, 60, 3, 3)
        shape = self.decoder(summary.code)
        few = thin(points, self.config.chosen_by or points.shape[1])
        anchor = shape_distances(few[:, None] @ rotations.detach(), shape.detach()).argmin(-1)
        rotation = rotations[torch.arange(len(anchor), device=anchor.device), anchor]
        return Whole(rotation=rotation, anchor=anchor, aligned=points @ rotation, shape=shape)
