# SPDX-License-Identifier: MIT
"""Pseudo-labels: placements that search found for the training clouds, the network's targets."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from scapo.registered.template import Placement
from scapo.registered.view_bank import ShownPoints


class PseudoLabels(nn.Module):
    """Placements of training clouds as found, in the order of those clouds."""

    key: Tensor
    """Each cloud's first point."""
    rotation: Tensor
    translation: Tensor
    log_scale: Tensor
    state: Tensor
    shift: Tensor
    camera: Tensor
    """Centres in the template frame."""
    trust: Tensor
    """Weight of each when the network learns."""
    points: Tensor
    """(B, K, 3) some points of each, normalised; none where a checkpoint has none."""
    normals: Tensor
    belonging: Tensor
    """Which points of each cloud are inliers (bool)."""
    PLACEMENT: ClassVar = ("rotation", "translation", "log_scale", "state", "shift")
    NAMES: ClassVar = ("key", *PLACEMENT, "camera", "trust")
    SHOWN: ClassVar = ("points", "normals")

    def __init__(self) -> None:
        super().__init__()
        for name in (*self.NAMES, *self.SHOWN):
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("belonging", torch.ones(0, 0, dtype=torch.bool))

    def set(self, key: Tensor, placement: Placement, camera: Tensor, trust: Tensor) -> None:
        """Replace all."""
        values = (key, *(getattr(placement, name) for name in self.PLACEMENT), camera, trust)
        for name, value in zip(self.NAMES, values, strict=True):
            setattr(self, name, value.detach().clone())

    def show(self, shown: ShownPoints) -> None:
        """Keep what the clouds look like."""
        self.points, self.normals = shown.points.clone(), shown.normals.clone()

    def keep_trusted(self) -> None:
        """Forget the clouds that nothing is learned from, and which points are whose."""
        kept = self.trust > 0
        for name in (*self.NAMES, *self.SHOWN):
            values = getattr(self, name)
            setattr(self, name, values[kept] if len(values) == len(kept) else values)
        self.belonging = self.belonging[:0, :0]

    def placement(self) -> Placement:
        """All of them, about the category's axes."""
        values = {name: getattr(self, name) for name in self.PLACEMENT}
        return Placement(**values, deviation=torch.zeros_like(self.shift))

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        *rest: Any,  # noqa: ANN401 - as torch calls it
        **named: Any,  # noqa: ANN401
    ) -> None:
        """Take the size of what is loaded; older checkpoints have no points."""
        for name in self.SHOWN:
            state_dict.setdefault(prefix + name, torch.zeros(0))
        for name in (*self.NAMES, *self.SHOWN, "belonging"):
            if prefix + name in state_dict:
                empty = torch.zeros_like(state_dict[prefix + name], device=self.key.device)
                setattr(self, name, empty)
        super()._load_from_state_dict(state_dict, prefix, *rest, **named)
