# SPDX-License-Identifier: MIT
"""Where objects come from: an asset is a small picklable description that a worker can load."""

from __future__ import annotations

from dataclasses import dataclass

from sim_assets import procedural
from sim_assets.articulated import ArticulatedObject


@dataclass(frozen=True, slots=True, kw_only=True)
class ProceduralAsset:
    """An instance that a generator makes."""

    category: str
    split: str
    seed: int
    index: int

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.category}-{self.split}-{self.seed}-{self.index:05d}"

    def load(self) -> ArticulatedObject:
        """Make it."""
        return procedural.generate(self.category, self.split, self.seed, self.index)


Asset = ProceduralAsset
