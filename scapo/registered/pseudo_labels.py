# SPDX-License-Identifier: MIT
"""Pseudo-labels: placements that search found for the training clouds, the network's targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int8, UInt8
from torch import Tensor, nn

from scapo.geometry.points import Similarity
from scapo.records import take
from scapo.registered.hinges import as_placed_by, hinges_of_objects
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import SearchSpace, light, modes_of
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_bank import ShownPoints, ViewBank
from scapo.registered.views import PartialViews


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedClouds:
    """The training clouds whose placements the network learns."""

    index: Int[Tensor, " K"]
    """Rows of all training clouds."""
    similarity: Similarity
    """Their normalisation."""
    views: PartialViews


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """A few placements of each of B clouds between which the search found little to choose."""

    placement: Placement
    """B * C of them, those of a cloud in a row."""
    part: UInt8[Tensor, "B C N"]
    """Which part each point is of, by each."""
    gap: Float[Tensor, "B C"]
    """By how much each costs the search more than the best."""
    margin: Float[Tensor, " B"]
    """How far to trust the best, the more the surer."""
    inlier: Bool[Tensor, "B N"]
    normals: Int8[Tensor, "B N 3"]
    """In the frame of the placements, times 127."""

    def surest(self, share: float) -> Float[Tensor, " B"]:
        """1 for that share of the clouds that are to be trusted most, 0 for others."""
        count = max(1, round(share * len(self.margin)))
        kept = self.margin.topk(count).indices
        return torch.zeros_like(self.margin).index_fill(0, kept, 1.0)


class _Tensors(nn.Module):
    """Named tensors whose size is that of what was stored."""

    NAMES: ClassVar[tuple[str, ...]]

    def __init__(self) -> None:
        super().__init__()
        for name in self.NAMES:
            self.register_buffer(name, torch.zeros(0))

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        *rest: Any,  # noqa: ANN401 - as torch calls it
        **named: Any,  # noqa: ANN401
    ) -> None:
        """Take the size of what is loaded."""
        for name, own in self.named_buffers():
            if prefix + name in state_dict:
                empty = torch.zeros_like(state_dict[prefix + name], device=own.device)
                setattr(self, name, empty)
        super()._load_from_state_dict(state_dict, prefix, *rest, **named)


class PseudoLabels(_Tensors):
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
    SET: ClassVar = ("key", *PLACEMENT, "camera", "trust")
    NAMES: ClassVar[tuple[str, ...]] = (*SET, "points", "normals")

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("belonging", torch.ones(0, 0, dtype=torch.bool))

    def set(self, key: Tensor, placement: Placement, camera: Tensor, trust: Tensor) -> None:
        """Replace all."""
        values = (key, *(getattr(placement, name) for name in self.PLACEMENT), camera, trust)
        for name, value in zip(self.SET, values, strict=True):
            setattr(self, name, value.detach().clone())

    def show(self, shown: ShownPoints) -> None:
        """Keep what the clouds look like."""
        self.points, self.normals = shown.points.clone(), shown.normals.clone()

    def keep_trusted(self) -> None:
        """Forget the clouds that nothing is learned from, and which points are whose."""
        kept = self.trust > 0
        for name in self.NAMES:
            values = getattr(self, name)
            setattr(self, name, values[kept] if len(values) == len(kept) else values)
        self.belonging = self.belonging[:0, :0]

    def placement(self) -> Placement:
        """All of them, about the category's axes."""
        values = {name: getattr(self, name) for name in self.PLACEMENT}
        return Placement(**values, deviation=torch.zeros_like(self.shift))

    def space(
        self, template: ArticulatedTemplate, states: Tensor, scorer: OrientationScorer
    ) -> SearchSpace:
        """States, shifts, sizes, cameras and looks of the clouds that are learned."""
        learned = self.trust > 0
        placement = take(self.placement(), learned)
        camera = F.normalize(self.camera[learned], dim=-1)
        placed = None
        if len(self.points):
            shown = ShownPoints(points=self.points[learned], normals=self.normals[learned])
            placed = ViewBank.placed(template, shown, placement, camera)
        modes = modes_of(placement, states)
        rendered = ViewBank.rendered(light(template), modes, camera)
        return SearchSpace(rendered=rendered, placed=placed, states=states, scorer=scorer)


class ViewTargets(_Tensors):
    """Candidates as a part of the method's state, which training alone needs."""

    PLACEMENT: ClassVar = (*PseudoLabels.PLACEMENT, "deviation")
    NAMES: ClassVar[tuple[str, ...]] = (
        *PLACEMENT, "part", "gap", "trust", "inlier", "normals", "hinge", "hung",
    )  # fmt: skip
    log_scale: Tensor
    shift: Tensor
    deviation: Tensor
    part: Tensor
    gap: Tensor
    trust: Tensor
    """Weight of each cloud when the network learns."""
    inlier: Tensor
    normals: Tensor
    hinge: Tensor
    """(B, C, J, 3) hinges of the object that each shows, on the base as each candidate places it;
    empty where they are not known."""
    hung: Tensor
    """(B, J) trust in each."""

    def set(self, found: Candidates, trust: Float[Tensor, " B"]) -> None:
        """Replace all; hinges are not known."""
        self.clear()
        count = found.gap.shape[1]
        for name in self.PLACEMENT:
            setattr(self, name, getattr(found.placement, name).unflatten(0, (-1, count)))
        self.part, self.gap, self.inlier = found.part, found.gap, found.inlier
        self.normals = found.normals
        self.trust = trust

    def hang(
        self,
        template: ArticulatedTemplate,
        size: Float[Tensor, " B"],
        objects: Sequence[Int[Tensor, " V"]],
    ) -> bool:
        """Add the hinges of the objects (`hinges_of_objects`), by the best candidate of each.

        Returns: Whether there are any.
        """
        count, best = self.gap.shape[1], self.gap.argmin(1)
        every = self.placement(torch.arange(len(best)))
        row = torch.arange(len(best)) * count + best
        hinges = hinges_of_objects(template, take(every, row), size, objects)
        if not bool(hinges.trust.any()):
            return False
        self.hinge = as_placed_by(every, best, hinges, template)
        self.hung = hinges.trust
        return True

    def placement(self, row: Tensor) -> Placement:
        """All candidates of some clouds, those of a cloud in a row."""
        values = {name: getattr(self, name)[row].flatten(0, 1) for name in self.PLACEMENT}
        return Placement(**values)

    def clear(self) -> None:
        """Forget all."""
        for name in self.NAMES:
            setattr(self, name, torch.zeros(0, device=self.trust.device))
