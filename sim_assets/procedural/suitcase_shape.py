# SPDX-License-Identifier: MIT
"""Free parameters of suitcases and the measures that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

from sim_assets.procedural.parameters import HeldOut, chance, choice, span, tint


@dataclass(frozen=True, slots=True, kw_only=True)
class SuitcaseShape:
    """Free parameters; lengths in metres, ratios where named so."""

    length: float = span(0.46, 0.74, 0.38, 0.84)
    """Along y."""
    aspect: float = span(0.62, 0.78, 0.54, 0.86)
    """Depth (x) over length."""
    thickness: float = span(0.16, 0.28, 0.12, 0.34)
    """Of the closed case."""
    split: float = span(0.42, 0.66, 0.34, 0.74)
    """Share of the base shell."""
    corner_radius: float = span(0.025, 0.075, 0.012, 0.1)
    edge: float = span(0.012, 0.045, 0.006, 0.06)
    """Rounding between the shells' faces and sides."""
    wall: float = span(0.003, 0.006, 0.0025, 0.008)
    half_gap: float = span(0.0006, 0.0012, 0.0005, 0.0015)
    """Between either shell and the plane of the hinge."""
    band: float = span(0.006, 0.014, 0.004, 0.02)
    """Height of the strip along either shell's mouth."""
    handle_length: float = span(0.16, 0.26, 0.12, 0.34)
    """Over the length."""
    handle_height: float = span(0.024, 0.04, 0.018, 0.055)
    handle_radius: float = span(0.006, 0.01, 0.0045, 0.013)
    wheel_radius: float = span(0.018, 0.03, 0.013, 0.038)
    latch_width: float = span(0.035, 0.06, 0.025, 0.08)
    latch_spread: float = span(0.24, 0.34, 0.18, 0.4)
    """Distance of the latches from the middle over the length."""
    rib_height: float = span(0.0025, 0.005, 0.0015, 0.007)
    barrel_radius: float = span(0.004, 0.007, 0.003, 0.009)
    travel: float = span(0.8, 1.0, 0.7, 1.0)
    handle: bool = chance(0.8)
    wheels: bool = chance(0.55)
    latches: bool = chance(0.6)
    ribs: bool = chance(0.6)
    guards: bool = chance(0.35)
    """Plates over the corners."""
    straps: bool = chance(0.4)
    """Two crossed straps in the base."""
    divider: bool = chance(0.5)
    """A flat panel closing the lid's inside."""
    barrels: bool = chance(0.5)
    edging: bool = chance(0.6)
    feet: bool = chance(0.3)
    rib_count: int = choice(4, 5, 6, 8)
    shell_color: tuple[float, float, float] = tint(
        (0.15, 0.2, 0.35), (0.6, 0.12, 0.12), (0.25, 0.25, 0.27), (0.55, 0.4, 0.25),
        (0.75, 0.75, 0.72), (0.2, 0.4, 0.35),
    )  # fmt: skip
    lining_color: tuple[float, float, float] = tint(
        (0.5, 0.48, 0.44), (0.3, 0.3, 0.32), (0.75, 0.7, 0.6)
    )

    @property
    def depth(self) -> float:
        """Along x."""
        return self.length * self.aspect

    @property
    def rear(self) -> float:
        """Distance of the shells' rear in front of the hinge axis."""
        return self.barrel_radius + 0.0012 if self.barrels else 0.0012

    @property
    def middle(self) -> float:
        """The x of the shells' middle."""
        return -self.rear - self.depth / 2

    @property
    def front(self) -> float:
        """The x of the shells' front."""
        return -self.rear - self.depth

    @property
    def heights(self) -> tuple[float, float]:
        """Of the base and of the lid."""
        return self.split * self.thickness, (1 - self.split) * self.thickness


HELD_OUT: HeldOut = (
    {"wheels": True, "ribs": False, "guards": True},
    {"handle": False, "latches": True},
    {"straps": True, "divider": True, "barrels": False},
)
SYMMETRIC = {
    "split": 0.5, "handle": False, "wheels": False, "latches": False, "straps": False,
    "divider": False, "feet": False, "barrels": False,
}  # fmt: skip
