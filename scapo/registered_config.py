# SPDX-License-Identifier: MIT
"""What can be chosen of SCAPO as it works on partial views."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from scapo.starts import DiscoveryConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredConfig:
    """SCAPO by registration and joint fit."""

    discovery: DiscoveryConfig = field(default_factory=DiscoveryConfig)
    learned: int = 600
    """Training clouds whose placements the network learns, 0.25 s each on one core."""
    trusted: float = 0.85
    """Share of them that it learns from."""
    epochs: int = 60
    """Of the network."""
    lr: float = 1e-3
    batch: int = 32
    width: int = 48
    """Of the network; 48 gives 0.2 million parameters."""
    points: int = 256
    """Of each cloud."""
    grid_hypotheses: int = 64
    """Placements of a grid search that `refine` tries beside the network's four; 0 for none."""
    strays: Literal["out", "kept"] = "out"
    """Whether points that do not belong to the object are left out."""
    settle: bool = True
    """Try all states again for the placement that won."""
    camera: Literal["known", "estimated"] = "known"
    """Whether `refine` takes the camera from the cloud's frame or from the network."""


def cpu_config() -> RegisteredConfig:
    """Trains one category in at most 20 minutes on two cores."""
    return RegisteredConfig()
