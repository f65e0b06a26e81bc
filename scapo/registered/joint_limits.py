# SPDX-License-Identifier: MIT
"""The narrowest range of joint states that explains the views.

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
from scapo.registered.template import Placement

RANGE_COST = 0.03
"""Mean loss that a radian of range may save; a sliding joint pays it per mean radius (0.25)."""
OUTSIDE_COST = 0.3
"""Largest loss added to a hypothesis outside the range."""
SLOPE = 2.0
"""Loss added per unit (rad, or mean radius) outside the range, up to `OUTSIDE_COST`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StateRange:
    """Lowest and highest state of each joint."""

    low: Float[Tensor, " J"]
    high: Float[Tensor, " J"]
    unit: Float[Tensor, " J"]
    """1 for a revolute joint, 4 for a sliding one: to mean radii."""

    def penalty(self, state: Float[Tensor, "*H J"]) -> Float[Tensor, "*H"]:
        """What a hypothesis outside the range is charged."""
        outside = (self.low - state).clamp_min(0) + (state - self.high).clamp_min(0)
        return (SLOPE * outside * self.unit).clamp_max(OUTSIDE_COST).sum(-1)

    def extent(self) -> float:
        """Radians, or mean radii of a sliding joint, of all joints together."""
        return float(((self.high - self.low) * self.unit).sum())

    def wider(self, share: float) -> StateRange:
        """With room of a share of the range on both sides."""
        room = share * (self.high - self.low)
        return StateRange(low=self.low - room, high=self.high + room, unit=self.unit)

    def grid(self, count: int) -> Float[Tensor, "J {count}"]:
        """Evenly spaced states over the range."""
        ends = zip(self.low.tolist(), self.high.tolist(), strict=True)
        return torch.stack([torch.linspace(a, b, count) for a, b in ends]).to(self.low)


def units(kinds: tuple[JointKind, ...]) -> list[float]:
    """Of each joint's state, in radians or mean radii."""
    return [4.0 if kind == "prismatic" else 1.0 for kind in kinds]


@torch.no_grad()
def range_of(state: Float[Tensor, "B J"], kinds: tuple[JointKind, ...]) -> StateRange:
    """The range of placements that are trusted, but for single strays."""
    return StateRange(
        low=state.quantile(0.02, 0),
        high=state.quantile(0.98, 0),
        unit=state.new_tensor(units(kinds)),
    )


@torch.no_grad()
def narrowest(
    placement: Placement,
    loss: Float[Tensor, "B F"],
    kinds: tuple[JointKind, ...],
    cost: float = RANGE_COST,
) -> StateRange:
    """The range of least mean loss of the best hypotheses within, plus its cost.

    Args:
        placement: F hypotheses of each of B views, those of a view one after the other.
        loss: Of the hypotheses.
        kinds: Of the joints.
        cost: Of a radian; 0 for the range of the best hypotheses as it is.
    """
    state = placement.state.unflatten(0, loss.shape)
    best = state[torch.arange(len(loss), device=loss.device), loss.argmin(1)]
    chosen = range_of(best, kinds)
    if cost == 0:
        return chosen
    for j in list(range(len(kinds))) * (2 if len(kinds) > 1 else 1):
        span = (chosen.high[j] - chosen.low[j]).clamp_min(1e-3)
        tried = []
        for width in torch.linspace(0.3, 1.0, 15).tolist():
            for start in torch.linspace(0, 1 - width, 1 + round(20 * (1 - width))).tolist():
                low, high = chosen.low.clone(), chosen.high.clone()
                low[j], high[j] = (
                    chosen.low[j] + start * span,
                    chosen.low[j] + (start + width) * span,
                )
                option = StateRange(low=low, high=high, unit=chosen.unit)
                least = (loss + option.penalty(state)).amin(1).mean()
                tried.append((float(least + cost * width * span * chosen.unit[j]), option))
        chosen = min(tried, key=lambda pair: pair[0])[1]
    return chosen
