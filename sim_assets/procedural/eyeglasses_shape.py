# SPDX-License-Identifier: MIT
"""Free parameters of eyeglasses and the measures that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2

from sim_assets.procedural.assembly import RGB
from sim_assets.procedural.parameters import HeldOut, chance, choice, span, tint

METAL: RGB = (0.7, 0.68, 0.62)
CLEARANCE = 0.0012
"""Between the frame's end pieces and the temples."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EyeglassesShape:
    """Free parameters; lengths in metres, ratios where named so."""

    lens_width: float = span(0.045, 0.056, 0.039, 0.063)
    lens_ratio: float = span(0.68, 0.92, 0.55, 1.0)
    """Height over width."""
    lens_power: float = span(2.0, 3.4, 1.9, 4.5)
    """Of the outline: 2 is an ellipse, 4 nearly a rectangle."""
    lens_taper: float = span(-0.02, 0.14, -0.08, 0.2)
    """How much wider the lens is at its top."""
    lens_bulge: float = span(0.001, 0.004, 0.0005, 0.006)
    bridge: float = span(0.014, 0.021, 0.011, 0.026)
    bridge_rise: float = span(0.1, 0.5, 0.0, 0.7)
    """Height of the bridge over half the lens's."""
    bridge_arch: float = span(0.001, 0.005, 0.0, 0.008)
    wrap: float = span(0.002, 0.008, 0.0005, 0.014)
    """How far the frame's sides lie behind its middle."""
    rim_width: float = span(0.0018, 0.005, 0.0014, 0.0065)
    rim_depth: float = span(0.002, 0.0042, 0.0016, 0.0055)
    overhang: float = span(0.003, 0.007, 0.002, 0.010)
    """Of the hinges beyond the lenses."""
    setback: float = span(0.005, 0.011, 0.004, 0.016)
    """Of the hinges behind the lenses' outer edges."""
    hinge_rise: float = span(0.15, 0.6, 0.0, 0.75)
    temple_length: float = span(0.9, 1.0, 0.84, 1.03)
    """Over the distance of the hinges."""
    temple_height: float = span(0.004, 0.009, 0.003, 0.013)
    """At the hinge."""
    temple_slim: float = span(0.4, 0.7, 0.35, 0.9)
    """Height further back over that at the hinge."""
    temple_thickness: float = span(0.002, 0.0035, 0.0015, 0.0045)
    bow: float = span(0.0, 0.004, 0.0, 0.006)
    """Of the temples outwards."""
    inward: float = span(0.002, 0.008, 0.0, 0.012)
    """Of the temples' ends."""
    drop: float = span(0.004, 0.009, 0.002, 0.013)
    """Of the ear bends."""
    bend: float = span(0.62, 0.76, 0.55, 0.82)
    """Where the ear bend begins, over the length."""
    travel: float = span(0.92, 1.0, 0.85, 1.0)
    rim: str = choice("full", "full", "half", "browline", "none")
    nose_pads: bool = chance(0.6)
    brow_bar: bool = chance(0.25)
    ear_tips: bool = chance(0.6)
    barrel: bool = chance(0.6)
    plates: bool = chance(0.35)
    """A small plate on the outside of either end piece."""
    left_over: bool = chance(0.5)
    """The left temple passes over the right one."""
    rim_color: tuple[float, float, float] = tint(
        (0.08, 0.08, 0.09), (0.36, 0.22, 0.12), METAL, (0.6, 0.12, 0.12), (0.15, 0.2, 0.45)
    )
    temple_color: tuple[float, float, float] = tint(
        (0.08, 0.08, 0.09), (0.36, 0.22, 0.12), METAL, (0.5, 0.5, 0.52)
    )
    lens_color: tuple[float, float, float] = tint(
        (0.75, 0.82, 0.86), (0.2, 0.2, 0.22), (0.35, 0.28, 0.2)
    )

    @property
    def lens_height(self) -> float:
        """Along z."""
        return self.lens_width * self.lens_ratio

    @property
    def centre(self) -> float:
        """The y of a lens's middle."""
        return self.bridge / 2 + self.lens_width / 2

    @property
    def pivot(self) -> tuple[float, float, float]:
        """A point on the right hinge's axis, at the temple's inner face."""
        y = self.bridge / 2 + self.lens_width + self.overhang
        return self.wrap + self.setback, y, self.hinge_rise * self.lens_height / 2

    @property
    def length(self) -> float:
        """Of a temple, from its hinge."""
        return self.temple_length * 2 * self.pivot[1]

    @property
    def lean(self) -> float:
        """Angle of the hinge axes to z: enough for one folded temple to clear the other."""
        height = self.temple_height * (1 + self.temple_slim) / 2 + self.drop + 0.0032
        return (1.0 if self.left_over else -1.0) * atan2(height, 2 * self.pivot[1])

    @property
    def barrel_radius(self) -> float:
        """Of the visible hinge."""
        return 0.55 * self.temple_thickness if self.barrel else 0.0

    @property
    def start(self) -> float:
        """Distance from the axis at which temple and end piece begin."""
        return self.barrel_radius + CLEARANCE / 2


HELD_OUT: HeldOut = (
    {"rim": "none", "nose_pads": True},
    {"rim": "browline", "ear_tips": False},
    {"barrel": False, "plates": True, "brow_bar": True},
)
SYMMETRIC = {
    "lens_taper": 0.0, "bridge_rise": 0.0, "bridge_arch": 0.0, "hinge_rise": 0.0, "drop": 0.0,
    "rim": "full", "nose_pads": False, "brow_bar": False,
}  # fmt: skip
