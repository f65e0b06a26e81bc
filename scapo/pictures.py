# SPDX-License-Identifier: MIT
"""What a method shows of its training: clouds with parts and joints, side by side, in one frame.

Data alone; `draw` makes images of them where matplotlib is installed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """One cloud of a picture; lengths in the units of the picture's other panels."""

    points: Float[Tensor, "N 3"]
    part: Int[Tensor, " N"] | None = None
    """Colours the points; None: all alike."""
    pivot: Float[Tensor, "J 3"] | None = None
    """Of the joints whose axes are drawn."""
    axis: Float[Tensor, "J 3"] | None = None
    beneath: Float[Tensor, "M 3"] | None = None
    """A second cloud drawn in grey, such as the observed one beneath its reconstruction."""
    title: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureData:
    """Panels in a row."""

    panels: tuple[Panel, ...]
    caption: str = ""
    view: Literal["oblique", "camera"] = "oblique"
    """oblique: parallel projection of an arbitrary frame, the same direction and scale for all
    panels; camera: as the camera sees it (x right, y down), without perspective."""
