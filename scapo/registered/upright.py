# SPDX-License-Identifier: MIT
"""Which way is up, for those who know it: a robot knows gravity where a cloud alone does not.

Objects stand as their category stands: the template's up, which labels told after training, lies
along the up that the cloud came with. Hypotheses are turned upright before they are settled and
charged for what they lean afterwards; the answer is upright.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from scapo.geometry.rigid import rotation_between
from scapo.registered.template import ArticulatedTemplate, Placement

LEANING = 1.0
"""Loss that a hypothesis costs, times 1 - cos of what it leans: 0.06 for 20 degrees."""
OVER = 20.0  # Nats by which a proposal stands worse, times the same


@dataclass(frozen=True, slots=True, kw_only=True)
class Upright:
    """The template's up, and the up of B clouds; unit vectors."""

    own: Float[Tensor, " 3"]
    """Template frame."""
    seen: Float[Tensor, "B 3"]
    """In the frames of the clouds."""

    def leaning(self, rotation: Float[Tensor, "*H 3 3"]) -> Float[Tensor, "*H"]:
        """1 - cos of the angle between up and where hypotheses have it; H begins with B."""
        shape = (len(self.seen), *(1,) * (rotation.ndim - 3), 3)
        return 1 - ((rotation @ self.own) * self.seen.view(shape)).sum(-1)

    def raised(self, template: ArticulatedTemplate, placement: Placement) -> Placement:
        """Placements, as many of each cloud, turned upright about their bases by the least turn."""
        count = len(placement.rotation) // len(self.seen)
        seen = self.seen.repeat_interleave(count, 0)
        turn = rotation_between(placement.rotation @ self.own, seen)
        centre = template.part_centres()[0] * placement.log_scale.exp()
        arm = (placement.rotation @ centre[..., None])[..., 0]
        held = placement.translation + arm - (turn @ arm[..., None])[..., 0]
        return replace(placement, rotation=turn @ placement.rotation, translation=held)
