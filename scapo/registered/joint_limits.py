# SPDX-License-Identifier: MIT
"""Joint limits: the narrowest range of joint states that explains the views.

A shape of two plates can be explained in two ways by turning one plate over and bending the joint
the other way; a template then holds a ghost of one plate, half of the views take either side, and
no loss of a single view tells. Together the two sides need twice the range of states, so the
narrower range that explains the views nearly as well is taken (a description-length argument; no
category's travel enters).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import MEAN_RADIUS, ends
from scapo.registered.template import Placement

RANGE_COST = 0.03
"""Mean loss that a radian of range may save; a sliding joint pays it per mean radius (0.25)."""
OUTSIDE_COST = 0.3  # Largest loss added to a hypothesis outside the limits
SLOPE = 2.0  # Loss added per unit (rad, or mean radius) outside the limits, up to `OUTSIDE_COST`
RADII = 1 / MEAN_RADIUS
"""Mean radii in a normalised length, the unit in which sliding joints are compared with hinges."""
WIDTHS = (0.3, 1.0, 15)
"""Narrower ranges that are tried, as shares of the whole: least, largest, how many."""
PLACES = 20  # Of such a range within the whole, for each whole width that it may move by
LEAST_SPAN = 1e-3  # Rad or normalised length: states that do not differ still have a range


@dataclass(frozen=True, slots=True, kw_only=True)
class JointLimits:
    """Lowest and highest state of each joint."""

    low: Float[Tensor, " J"]
    high: Float[Tensor, " J"]
    unit: Float[Tensor, " J"]
    """1 for a revolute joint, 4 for a sliding one: to mean radii."""

    def penalty(self, state: Float[Tensor, "*H J"]) -> Float[Tensor, "*H"]:
        """What a hypothesis outside the limits is charged."""
        outside = (self.low - state).clamp_min(0) + (state - self.high).clamp_min(0)
        return (SLOPE * outside * self.unit).clamp_max(OUTSIDE_COST).sum(-1)

    def extent(self, weight: Float[Tensor, " J"]) -> float:
        """Radians, or mean radii of a sliding joint, of all joints together, by these weights."""
        return float(((self.high - self.low) * self.unit * weight).sum())

    def wider(self, share: float) -> JointLimits:
        """With room of a share of the range on both sides."""
        room = share * (self.high - self.low)
        return JointLimits(low=self.low - room, high=self.high + room, unit=self.unit)

    def grid(self, count: int) -> Float[Tensor, "J {count}"]:
        """Evenly spaced states over the range."""
        ends = zip(self.low.tolist(), self.high.tolist(), strict=True)
        return torch.stack([torch.linspace(a, b, count) for a, b in ends]).to(self.low)


def units(kinds: tuple[JointKind, ...]) -> list[float]:
    """Of each joint's state, in radians or mean radii."""
    return [RADII if kind == "prismatic" else 1.0 for kind in kinds]


@torch.no_grad()
def limits_of(state: Float[Tensor, "B J"], kinds: tuple[JointKind, ...]) -> JointLimits:
    """The range of inliers' states, but for single outliers (`ends`)."""
    low, high = ends(state)
    return JointLimits(low=low, high=high, unit=state.new_tensor(units(kinds)))


@torch.no_grad()
def narrowest_limits(
    placement: Placement,
    loss: Float[Tensor, "B F"],
    kinds: tuple[JointKind, ...],
    cost: float = RANGE_COST,
) -> JointLimits:
    """The range of least mean loss of the best hypotheses within, plus its cost.

    Args:
        placement: F hypotheses of each of B views, those of a view one after the other.
        loss: Of the hypotheses.
        kinds: Of the joints.
        cost: Of a radian; 0 for the range of the best hypotheses as it is.
    """
    state = placement.state.unflatten(0, loss.shape)
    best = state[torch.arange(len(loss), device=loss.device), loss.argmin(1)]
    chosen = limits_of(best, kinds)
    if cost == 0:
        return chosen
    for j in list(range(len(kinds))) * (2 if len(kinds) > 1 else 1):
        span = (chosen.high[j] - chosen.low[j]).clamp_min(LEAST_SPAN)
        tried = []
        for width in torch.linspace(*WIDTHS).tolist():
            for start in torch.linspace(0, 1 - width, 1 + round(PLACES * (1 - width))).tolist():
                low, high = chosen.low.clone(), chosen.high.clone()
                low[j], high[j] = (
                    chosen.low[j] + start * span,
                    chosen.low[j] + (start + width) * span,
                )
                option = JointLimits(low=low, high=high, unit=chosen.unit)
                least = (loss + option.penalty(state)).amin(1).mean()
                tried.append((float(least + cost * width * span * chosen.unit[j]), option))
        chosen = min(tried, key=lambda pair: pair[0])[1]
    return chosen
