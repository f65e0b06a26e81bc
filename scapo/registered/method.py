# SPDX-License-Identifier: MIT
"""SCAPO as it works on partial views: register, fit jointly, then learn to vote for the result.

Training. Views of the category are registered and fitted jointly into one articulated template
(`discovery`), which is then searched for in the training views; a small network (`point_votes`)
learns the placements of the trusted ones. Points that a mask let in (`stray_points`) are left out.
No label is used anywhere: starts, hypotheses and trust are chosen by the loss of the views alone.
Camera positions of the training clouds are known (their frame's origin).

`fast` is the network alone, which sees the points only; `refine` fits the template to the cloud
from the network's four hypotheses and the best of a grid. For that it asks where the camera was:
at the origin of the cloud's frame or at `Observation.sensor`, or (`camera="estimated"`) where the
network believes it.

What can be chosen of SCAPO as it works on partial views.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import roma
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from scapo.categories import Category, JointKind
from scapo.geometry.points import Similarity, farthest_points, gather, nearest, normalise
from scapo.method import AbstractMethod, Mode, ParameterGroup, Stage, Step, changes, evenly
from scapo.pictures import PictureData
from scapo.registered.axis_deviation import settle_leans
from scapo.registered.decode import nearest_weights, placed_prediction
from scapo.registered.discovery import discover, search_all, trust_order
from scapo.registered.figures import template_pictures
from scapo.registered.initialisation import DiscoveryConfig
from scapo.registered.joint_limits import StateRange, range_of
from scapo.registered.network import (
    PointVotes,
    Target,
    Votes,
    principal_frames,
    procrustes,
    vote_losses,
)
from scapo.registered.outliers import belongs, replaced
from scapo.registered.pairwise import rotation_grid
from scapo.registered.pose_search import (
    Found,
    SearchSpace,
    propose,
    settle_states,
    tournament,
)
from scapo.registered.pseudo_labels import PseudoPlacements
from scapo.registered.template import (
    ArticulatedTemplate,
    Placement,
    interleave,
    slides,
    turn_placement,
)
from scapo.registered.views import Views, observe
from scapo.types import Labels, Observation, Prediction, Supervision


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredConfig:
    """SCAPO by registration and joint fit."""

    discovery: DiscoveryConfig = field(default_factory=DiscoveryConfig)
    learned: int = 600
    """Training clouds whose placements the network learns, 0.25 s each on one core."""
    trusted: float = 0.85
    """Share of them that it learns from."""
    epochs: int = 60
    """Of the network."""
    lr: float = 1e-3
    batch: int = 32
    width: int = 48
    """Of the network; 48 gives 0.2 million parameters."""
    points: int = 256
    """Of each cloud."""
    grid_hypotheses: int = 64
    """Placements of a grid search that `refine` tries beside the network's four; 0 for none."""
    strays: Literal["out", "kept"] = "out"
    """Whether points that do not belong to the object are left out."""
    settle: bool = True
    """Try all states again for the placement that won."""
    camera: Literal["known", "estimated"] = "known"
    """Whether `refine` takes the camera from the cloud's frame or from the network."""


def cpu_config() -> RegisteredConfig:
    """Trains one category in at most 20 minutes on two cores."""
    return RegisteredConfig()


LEAST_CLOUDS = 8
"""Views that a template can be found in at all, two of which judge."""


class RegisteredScapo(AbstractMethod):
    """The articulated template, the network that votes for its placement, and their training."""

    name: ClassVar[str] = "registered"
    networks: ClassVar[tuple[str, ...]] = ("network",)
    least_points = 16
    supervision: frozenset[Supervision] = frozenset()

    def __init__(
        self, config: RegisteredConfig, category: Category, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.config, self.category = config, category
        kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        self.template = ArticulatedTemplate(kinds, config.discovery.final_points)
        self.network = PointVotes(len(category.parts), len(kinds), width=config.width)
        for layer in self.network.modules():
            if isinstance(layer, nn.Linear):
                bound = layer.in_features**-0.5
                for parameter in layer.parameters():
                    nn.init.uniform_(parameter, -bound, bound, generator=generator)
        self.pseudo = PseudoPlacements()

    @property
    def variant(self) -> str:
        """Options that differ from the default, but for how much is trained."""
        return " ".join(changes(self.config, RegisteredConfig(), leave=("lr",)))

    def stages(self) -> tuple[Stage, ...]:
        """The network's; the template is found before it starts."""
        stage = Stage(
            name="votes",
            epochs=self.config.epochs,
            lr=self.config.lr,
            min_lr=self.config.lr * 0.01,
            batch=self.config.batch,
            clouds=self.config.learned,
            parameters=(ParameterGroup(module="network"),),
        )
        return (stage,)

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Find the template, and its placement in the clouds that the network will learn."""
        del stage, labels
        if len(observation.points) < LEAST_CLOUDS:
            raise ValueError(
                f"training data: expected at least {LEAST_CLOUDS} clouds, "
                f"found {len(observation.points)}"
            )
        index = evenly(len(observation.points), self.config.learned)
        cloud = observation.points[index.to(observation.points.device)].cpu()
        belonging = self._belongs(cloud)
        points, similarity = normalise(replaced(cloud, belonging))
        camera = -similarity.centre * similarity.scale[:, None]  # the camera is the origin
        views = observe(points, camera, count=self.config.points)
        device = self.template.points.device
        self.template.cpu()  # many small steps, view by view: no work for a GPU
        seed = torch.randint(2**31, (1,), generator=generator, device=generator.device)
        found = self._discover(views, torch.Generator().manual_seed(int(seed)))
        self._set_pseudo(cloud[:, 0], views, found)
        self.pseudo.belonging = belonging
        self.to(device)

    def _belongs(self, cloud: Float[Tensor, "B N 3"]) -> Bool[Tensor, "B N"]:
        """Which points belong to the object, or all of them."""
        if self.config.strays == "kept":
            return torch.ones(cloud.shape[:2], dtype=torch.bool, device=cloud.device)
        return belongs(cloud)

    def _discover(self, views: Views, generator: torch.Generator) -> Found:
        template, trusted = discover(views, self.template.kinds, self.config.discovery, generator)
        self.template.load_state_dict(template.state_dict())
        finalists = search_all(self.template, views, trusted, self.config.discovery)
        states = range_of(trusted.placement.state, self.template.kinds)
        return finalists.best(states.wider(0.1))

    def _set_pseudo(self, key: Tensor, views: Views, found: Found) -> None:
        order = trust_order(found)
        trust = torch.zeros(len(order), device=order.device)
        trust[order[: max(8, round(self.config.trusted * len(order)))]] = 1.0
        placement = found.placement
        away = views.camera - placement.translation
        camera = (placement.rotation.mT @ away[..., None])[..., 0]
        self.pseudo.set(key, placement, camera, trust)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The network's votes against the placements that were found (`vote_losses`)."""
        del labels
        row = self._learned_row(step)
        points, _ = normalise(replaced(observation.points, self.pseudo.belonging[row]))
        device = points.device
        index = torch.randperm(points.shape[1], generator=step.generator, device=device)
        points = self._thinned(points[:, index[: 2 * self.config.points]])
        frame = self._random_frames(points, step.generator)
        noise = torch.randn(points.shape, generator=step.generator, device=device) * 0.003
        votes = self.network((points + noise) @ frame.mT)
        return vote_losses(votes, self._target(points, row))

    def _learned_row(self, step: Step) -> Int[Tensor, " B"]:
        """Which of the learned clouds a batch holds.

        Raises:
            ValueError: A cloud whose placement was not searched for.
        """
        learned = evenly(step.total, self.config.learned).to(step.index.device)
        row = torch.searchsorted(learned, step.index).clamp(max=len(learned) - 1)
        if bool((learned[row] != step.index).any()):
            raise ValueError("expected clouds whose placements were found, found others")
        return row

    def _thinned(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B K 3"]:
        """`config.points` of each cloud by farthest-point sampling, or all."""
        count = min(self.config.points, points.shape[1])
        return gather(points, farthest_points(points, count))

    def _random_frames(
        self, points: Float[Tensor, "B K 3"], generator: torch.Generator
    ) -> Float[Tensor, "B 3 3"]:
        """One of each cloud's four principal frames, turned a little."""
        frames = principal_frames(points)
        device, count = points.device, len(points)
        pick = torch.randint(4, (count,), generator=generator, device=device)
        turn = 0.15 * torch.randn(count, 3, generator=generator, device=device)
        return roma.rotvec_to_rotmat(turn) @ frames[torch.arange(count, device=device), pick]

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
            lean=torch.zeros_like(votes.shift),
        )
        return placement, (votes, weight.mean(1).view(count, 4))

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """The template over its states, and where the network places it."""
        del stage
        cloud = observation.points
        points, _ = normalise(replaced(cloud, self._belongs(cloud)))
        kept = self._thinned(points)
        placement, (_, sure) = self._hypotheses(kept)
        row = torch.arange(len(points), device=points.device) * 4 + sure.argmax(1)
        return template_pictures(self.template, self._states(), kept, placement.take(row))

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses and joints; part frames sit at the middle of the template's base."""
        cloud = observation.points.to(self.template.points)
        clean, similarity = normalise(replaced(cloud, self._belongs(cloud)))
        points, kept = similarity.forward(cloud), self._thinned(clean)
        placement, (votes, sure) = self._hypotheses(kept)
        best = sure.argmax(1)
        every = torch.arange(len(points), device=points.device)
        row = every * 4 + best
        confidence = sure.gather(1, best[:, None])[:, 0]
        if mode == "fast":
            near = nearest(points, kept)
            weight = gather(votes.part[row].softmax(-1), near)
            chosen = placement.take(row)
        else:
            camera = self._camera(observation, similarity, placement.take(row), votes.camera[row])
            frame = principal_frames(kept)[every, best]
            chosen, confidence = self._refined(clean, camera, frame, placement)
            weight = nearest_weights(self.template, points, chosen, camera)
        return placed_prediction(self.template, chosen, weight, similarity, confidence)

    def _camera(
        self, observation: Observation, similarity: Similarity, placement: Placement, vote: Tensor
    ) -> Float[Tensor, "B 3"]:
        """The camera's centre in the normalised frame of each cloud."""
        if self.config.camera == "estimated":
            return (placement.rotation @ vote[..., None])[..., 0] + placement.translation
        sensor = observation.sensor
        away = -similarity.centre if sensor is None else sensor - similarity.centre
        return away * similarity.scale[:, None]

    def _refined(
        self,
        points: Float[Tensor, "B N 3"],
        camera: Float[Tensor, "B 3"],
        frame: Float[Tensor, "B 3 3"],
        proposed: Placement,
    ) -> tuple[Placement, Float[Tensor, " B"]]:
        """The best hypothesis of network and grid after a few steps, and its margin.

        All happens in the principal frame in which the network is surest, so that the grids of
        rotations and of the depth image turn with the cloud.
        """
        turned = (frame @ camera[..., None])[..., 0]
        views = observe(points @ frame.mT, turned, count=self.config.points)
        start, space = [turn_placement(proposed, frame.repeat_interleave(4, 0))], self._space()
        if self.config.grid_hypotheses:
            start.append(propose(self.template, views, space))
        finalists = tournament(self.template, views, interleave(start, len(points)), space.states)
        found = finalists.best(self._states().wider(0.1))
        final = found.placement
        if self.config.settle:
            final = settle_states(self.template, views, found, self._states())
        if self.template.leans():
            final, _ = settle_leans(self.template, views, final)
        return turn_placement(final, frame.mT), found.margin

    def _states(self) -> StateRange:
        """Of the trusted training views."""
        return range_of(self.pseudo.state[self.pseudo.trust > 0], self.template.kinds)

    def _space(self) -> SearchSpace:
        """States and cameras of the trusted training views."""
        trusted = self.pseudo.trust > 0
        return SearchSpace(
            states=self._states().wider(0.2).grid(7 if len(self.template.kinds) == 1 else 4),
            rotations=rotation_grid(self.config.discovery.rotations).to(self.pseudo.camera),
            cameras=F.normalize(self.pseudo.camera[trusted], dim=-1),
            keep=self.config.grid_hypotheses,
        )
