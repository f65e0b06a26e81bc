# SPDX-License-Identifier: MIT
"""What ovens, safes, washers and drawers share: a body in three numbers, things on its front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from sim_assets.procedural.shapes import FRONT, placed

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Turns a grip that was built along a front to one that stands upright on it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cabinet:
    """A body by its volume and two ratios; each recipe gives them its own ranges."""

    size: float
    """Cube root of the body's volume, metres."""
    aspect: float
    """Depth over width."""
    tall: float
    """Height over width."""

    @property
    def width(self) -> float:
        """Along y, of the body without what stands out."""
        return self.size / (self.aspect * self.tall) ** (1 / 3)

    @property
    def depth(self) -> float:
        """Along x, without doors and fronts."""
        return self.aspect * self.width

    @property
    def height(self) -> float:
        """Along z, without feet, legs and what stands on top."""
        return self.tall * self.width


def facing(mesh: trimesh.Trimesh, x: float, y: float = 0.0, z: float = 0.0) -> trimesh.Trimesh:
    """A thing built as seen from the front, put with its z = 0 at (x, y, z)."""
    return placed(mesh, (x, y, z), FRONT)
