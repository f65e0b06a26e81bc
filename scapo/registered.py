# SPDX-License-Identifier: MIT
"""SCAPO as it works on partial views: register, fit jointly, then learn to vote for the result.

Training. Views of the category are registered and fitted jointly into one articulated template
(`discovery`), which is then searched for in the training views; a small network (`point_votes`)
learns the placements of the trusted ones. The network's own proposals, refined, replace those
placements that they beat by the loss, the template is fitted again, and the network goes on
learning. No label is used anywhere: starts, hypotheses and trust are chosen by the loss of the
views alone. Camera positions of the training clouds are known (their frame's origin).

Prediction knows no camera: the network estimates it. `fast` is the network alone; `refine` fits
the template to the cloud from the network's four hypotheses and the best of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import roma
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.discovery import (
    DiscoveryConfig,
    Trusted,
    discover,
    evenly,
    improve,
    search_all,
    seen_states,
    trust_order,
)
from scapo.method import AbstractMethod, Mode, ParameterGroup, Stage, Step
from scapo.placed import nearest_weights, placed_prediction, slides
from scapo.point_votes import PointVotes, Target, Votes, principal_frames, procrustes, vote_losses
from scapo.points import farthest_points, gather, nearest, normalise
from scapo.pose_search import Found, SearchSpace, best_of, propose, refine, tournament
from scapo.pseudo_placements import PseudoPlacements
from scapo.registration import rotation_grid
from scapo.sightings import Views, observe
from scapo.template import ArticulatedTemplate, Placement, interleave, turn_placement
from scapo.types import Category, JointKind, Labels, Observation, Prediction, Supervision


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredConfig:
    """SCAPO by registration and joint fit."""

    discovery: DiscoveryConfig = field(default_factory=DiscoveryConfig)
    learned: int = 600
    """Training views whose placements the network learns."""
    trusted: float = 0.85
    """Share of them that it learns from."""
    epochs: tuple[int, int] = (100, 60)
    """Of the network, before and after its proposals are taken back into the placements."""
    lr: float = 1e-3
    batch: int = 32
    width: int = 48
    """Of the network; 48 gives 0.2 million parameters."""
    points: int = 256
    """Of each cloud."""
    grid_hypotheses: int = 32
    """Placements of a grid search that `refine` tries beside the network's four; 0 for none."""
    network_rounds: bool = True
    """Whether the network's proposals are searched and the template fitted again."""


class RegisteredScapo(AbstractMethod):
    """The articulated template, the network that votes for its placement, and their training."""

    name: ClassVar[str] = "registered"
    supervision: frozenset[Supervision] = frozenset()

    def __init__(
        self, config: RegisteredConfig, category: Category, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.config, self.category = config, category
        kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        self.template = ArticulatedTemplate(kinds, config.discovery.template_points)
        self.network = PointVotes(len(category.parts), len(kinds), width=config.width)
        for parameter in self.network.parameters():
            if parameter.dim() > 1:
                bound = parameter.shape[1] ** -0.5
                nn.init.uniform_(parameter, -bound, bound, generator=generator)
        self.pseudo = PseudoPlacements()

    @property
    def variant(self) -> str:
        """Named switches that differ from the default."""
        return "" if self.config.network_rounds else "no network rounds"

    def stages(self) -> tuple[Stage, ...]:
        """The network, before and after its proposals were taken back."""
        first, second = self.config.epochs
        learned = (ParameterGroup(module="network"),)
        stages = (
            Stage(
                name="votes",
                epochs=first,
                lr=self.config.lr,
                min_lr=self.config.lr * (0.3 if second else 0.01),
                batch=self.config.batch,
                parameters=learned,
            ),
            Stage(
                name="votes-again",
                epochs=second,
                lr=self.config.lr * 0.6,
                min_lr=self.config.lr * 0.01,
                batch=self.config.batch,
                parameters=learned,
            ),
        )
        return stages if second else stages[:1]

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Find the placements (first stage), or take the network's proposals into them."""
        del labels
        index = evenly(len(observation.points), self.config.learned)
        cloud = observation.points[index]
        points, similarity = normalise(cloud)
        camera = -similarity.centre * similarity.scale[:, None]  # the camera is the origin
        views = observe(points, camera, count=self.config.points)
        if stage == "votes":
            found = self._discover(views, generator)
        elif self.config.network_rounds:
            found = self._take_back(views, generator)
        else:
            return
        self._set_pseudo(cloud[:, 0], views, found)

    def _discover(self, views: Views, generator: torch.Generator) -> Found:
        template, trusted = discover(views, self.template.kinds, self.config.discovery, generator)
        self.template.load_state_dict(template.state_dict())
        return search_all(self.template, views, trusted, self.config.discovery, generator)

    def _take_back(self, views: Views, generator: torch.Generator) -> Found:
        """Better placements from the network's proposals, and the template fitted to them."""
        for _ in range(2):
            found = self._rounds_with_network(views, generator)
            order = trust_order(found)
            kept = order[: max(8, round(self.config.trusted * len(order)))][:300]
            trusted = Trusted(views=views.take(kept), placement=found.placement.take(kept))
            self.pseudo.set(self.pseudo.key, found.placement, self.pseudo.camera, self.pseudo.trust)
            improve(self.template, trusted, generator, rounds=3)
        return self._rounds_with_network(views, generator)

    def _rounds_with_network(self, views: Views, generator: torch.Generator) -> Found:
        with torch.no_grad():
            proposals, _ = self._hypotheses(views.points)
        count = len(views.points)
        own = self.pseudo.placement()
        mixed = interleave([proposals, own], count)
        index = torch.arange(count).repeat_interleave(5)
        placement, loss = refine(self.template, views.take(index), mixed, generator=generator)
        return best_of(placement, loss, count)

    def _set_pseudo(self, key: Tensor, views: Views, found: Found) -> None:
        order = trust_order(found)
        trust = torch.zeros(len(order))
        trust[order[: max(8, round(self.config.trusted * len(order)))]] = 1.0
        placement = found.placement
        away = views.camera - placement.translation
        camera = (placement.rotation.mT @ away[..., None])[..., 0]
        self.pseudo.set(key, placement, camera, trust)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The network's votes against the placements that were found (`vote_losses`)."""
        del labels
        row, there = self.pseudo.find(observation.points[:, 0])
        row = row[there] if bool(there.any()) else row
        cloud = observation.points[there] if bool(there.any()) else observation.points
        points, _ = normalise(cloud)
        index = torch.randperm(points.shape[1], generator=step.generator)
        points = points[:, index[: 2 * self.config.points]]
        points = gather(points, farthest_points(points, self.config.points))
        frame = self._random_frames(points, step.generator)
        noise = torch.randn(points.shape, generator=step.generator) * 0.003
        votes = self.network((points + noise) @ frame.mT)
        return vote_losses(votes, self._target(points, row))

    def _random_frames(
        self, points: Float[Tensor, "B K 3"], generator: torch.Generator
    ) -> Float[Tensor, "B 3 3"]:
        """One of each cloud's four principal frames, turned a little."""
        frames = principal_frames(points)
        pick = torch.randint(4, (len(points),), generator=generator)
        turn = 0.15 * torch.randn(len(points), 3, generator=generator)
        return roma.rotvec_to_rotmat(turn) @ frames[torch.arange(len(points)), pick]

    @torch.no_grad()
    def _target(self, points: Float[Tensor, "B K 3"], row: Int[Tensor, " B"]) -> Target:
        placement = self.pseudo.placement().take(row)
        placed, _ = self.template.place(placement)
        part = self.template.logit.softmax(-1)[nearest(points, placed)]
        return Target(
            points=(points - placement.translation[:, None]) @ placement.rotation,
            part=part,
            state=placement.state,
            log_scale=placement.log_scale,
            shift=placement.shift,
            camera=self.pseudo.camera[row],
            trust=self.pseudo.trust[row],
        )

    def _hypotheses(
        self, points: Float[Tensor, "B K 3"]
    ) -> tuple[Placement, tuple[Votes, Float[Tensor, "B 4"]]]:
        """Placements from the four frames of each cloud, in a row, with the votes behind them."""
        count = len(points)
        frames = principal_frames(points).flatten(0, 1)
        turned = points.repeat_interleave(4, 0) @ frames.mT
        votes = self.network(turned)
        weight = votes.sureness.sigmoid().square()
        rotation, translation = procrustes(turned, votes.points, weight)
        placement = Placement(
            rotation=frames.mT @ rotation,
            translation=(frames.mT @ translation[..., None])[..., 0],
            log_scale=votes.log_scale,
            state=votes.state,
            shift=votes.shift * slides(self.template),
        )
        return placement, (votes, weight.mean(1).view(count, 4))

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses and joints; part frames sit at the middle of the template's base."""
        points, similarity = normalise(observation.points)
        kept = gather(points, farthest_points(points, self.config.points))
        placement, (votes, sure) = self._hypotheses(kept)
        best = sure.argmax(1)
        row = torch.arange(len(points)) * 4 + best
        confidence = sure.gather(1, best[:, None])[:, 0]
        if mode == "fast":
            near = nearest(points, kept)
            weight = gather(votes.part[row].softmax(-1), near)
            chosen = placement.take(row)
        else:
            chosen, camera, confidence = self._refined(points, placement, votes, row)
            weight = nearest_weights(self.template, points, chosen, camera)
        return placed_prediction(self.template, chosen, weight, similarity, confidence)

    @torch.enable_grad()
    def _refined(
        self, points: Tensor, placement: Placement, votes: Votes, row: Tensor
    ) -> tuple[Placement, Float[Tensor, "B 3"], Float[Tensor, " B"]]:
        """The best hypothesis of network and grid after a few steps of the fit, and its camera.

        All happens in the first principal frame of each cloud, so that the grids of rotations
        and of the depth image turn with it.
        """
        count = len(points)
        camera = (placement.rotation @ votes.camera[..., None])[..., 0] + placement.translation
        camera = camera[row]
        frame = principal_frames(points)[:, 0]
        turned = (frame @ camera[..., None])[..., 0]
        views = observe(points @ frame.mT, turned, count=self.config.points)
        start = [turn_placement(placement, frame.repeat_interleave(4, 0))]
        if self.config.grid_hypotheses:
            start.append(propose(self.template, views, self._space()))
        generator = torch.Generator().manual_seed(0)
        found = tournament(self.template, views, interleave(start, count), generator=generator)
        final, _ = refine(
            self.template, views, found.placement, generator=generator, steps=25, points=192
        )
        return turn_placement(final, frame.mT), camera, found.margin

    def _space(self) -> SearchSpace:
        """States and cameras of the trusted training views."""
        trusted = self.pseudo.trust > 0
        return SearchSpace(
            states=seen_states(
                self.pseudo.state[trusted], 5 if len(self.template.kinds) == 1 else 3
            ),
            rotations=rotation_grid(self.config.discovery.rotations),
            cameras=F.normalize(self.pseudo.camera[trusted], dim=-1),
            keep=self.config.grid_hypotheses,
        )


def cpu_config() -> RegisteredConfig:
    """Trains one category in at most 20 minutes on two cores."""
    return RegisteredConfig()
