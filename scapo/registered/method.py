# SPDX-License-Identifier: MIT
"""Template registration: partial views are registered, fitted together and then learned.

A method of this project's. It shares SCAPO's idea, one articulated template per category, found
without labels, and none of its networks (docs/registration.md).

Training. Views of the category are registered and fitted together into one articulated template,
which is then searched for in the training views (`discovery`); a small network (`network`) learns
its placements in the most confident ones. Outliers of the clouds are left out (`outliers`). No
label is used anywhere: templates, hypotheses and confidence come from the loss of the views alone.
Camera positions of the training clouds are known (their frame's origin).

Two banks of images propose how the template may stand in a cloud (`view_bank`), and a scorer that
learned what standing objects look like sorts the proposals (`orientation`). `fast` asks the network
in the likeliest frame. `quick` and `refine` fit the template to the cloud: `quick` from a few
proposals in a few steps, `refine` from more of them to the end. All ask where the camera was: at
the origin of the cloud's frame or at `Observation.sensor`. Where that is not known
(`camera="estimated"`) the network is asked in four frames that the points alone tell, and where
it believes the camera is there `quick` and `refine` take it to be.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import Category, JointKind
from scapo.first_weights import initialise
from scapo.geometry.points import Similarity, farthest_points, gather, nearest, normalise
from scapo.method import AbstractMethod, Mode, ParameterGroup, Stage, Step, changes, evenly
from scapo.pictures import PictureData
from scapo.records import take
from scapo.registered.axis_deviation import refine_deviations
from scapo.registered.config import PRESETS, UNNAMED, RegisteredConfig, SearchConfig
from scapo.registered.course import plan_of
from scapo.registered.decode import metric_limits, nearest_weights, placed_prediction
from scapo.registered.discovery import Discovery, discover
from scapo.registered.figures import template_pictures
from scapo.registered.joint_limits import JointLimits, limits_of
from scapo.registered.network import (
    FRAMES,
    PointVotes,
    Target,
    Votes,
    own_frame,
    principal_frames,
    procrustes,
    random_frames,
    vote_losses,
)
from scapo.registered.objects import ObjectViews, grouped
from scapo.registered.orientation import VIEWS_CHARGE, OrientationScorer
from scapo.registered.outliers import inlier_mask, replaced
from scapo.registered.pose_search import (
    BRIEF,
    CHARGED,
    THOROUGH,
    SearchResult,
    SearchSpace,
    grid_of_states,
    light,
    modes_of,
    most_confident,
    refine_states,
    successive_halving,
)
from scapo.registered.pseudo_labels import PseudoLabels
from scapo.registered.template import (
    ArticulatedTemplate,
    Placement,
    turn_placement,
)
from scapo.registered.view_bank import ShownPoints, ViewBank
from scapo.registered.views import NEIGHBOURS, PartialViews, observe
from scapo.types import Labels, Observation, Prediction, Supervision

logger = logging.getLogger(__name__)

LEAST_CLOUDS = 8  # Views that a template can be found in at all, two of which judge
SAMPLED = 2  # Times `points` that are drawn from a cloud, of which the farthest are learned from
NOISE = 0.003  # Normalised length: standard deviation of the points' noise while the network learns
LAST_RATE = 0.01  # Share of the learning rate at the end
ROOM = 0.2  # Share of the inliers' range beyond which `refine` searches states


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedClouds:
    """The training clouds whose placements the network learns."""

    index: Int[Tensor, " K"]
    """Rows of all training clouds."""
    similarity: Similarity
    """Their normalisation."""
    views: PartialViews


class AbstractRegistered(AbstractMethod):
    """An articulated template, the network that votes for its placement, and their training.

    Where the template comes from, and what its placements say of part frames, is left open.
    """

    networks: ClassVar[tuple[str, ...]] = ("network",)
    usual: ClassVar[Mode] = "quick"
    least_points = NEIGHBOURS

    def __init__(
        self, config: SearchConfig, category: Category, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.config, self.category = config, category
        kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        self.template = ArticulatedTemplate(kinds, config.discovery.final_points)
        self.network = PointVotes(len(category.parts), len(kinds), width=config.width)
        initialise(self.network, generator)
        self.pseudo = PseudoLabels()
        self.orientation = OrientationScorer()
        self._drawn: tuple[list[tuple[int, int, torch.device]], SearchSpace] | None = None

    def stages(self) -> tuple[Stage, ...]:
        """The network's; the template is found before it starts."""
        stage = Stage(
            name="votes",
            epochs=self.config.epochs,
            lr=self.config.lr,
            min_lr=self.config.lr * LAST_RATE,
            batch=self.config.batch,
            clouds=self.config.learned,
            parameters=(ParameterGroup(module="network"),),
        )
        return (stage,)

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Find the template, and its placement in the clouds that the network will learn."""
        del stage
        if len(observation.points) < LEAST_CLOUDS:
            raise ValueError(
                f"training data: expected at least {LEAST_CLOUDS} clouds, "
                f"found {len(observation.points)}"
            )
        index = evenly(len(observation.points), self.config.learned)
        self.journal.tell("first look at the clouds", 0.0, self._seconds(len(index)))
        cloud = observation.points[index.to(observation.points.device)].cpu()
        similarity, views, inlier = self._observed(cloud)
        device = self.template.points.device
        self.template.cpu()  # many small steps, view by view: no work for a GPU
        seed = torch.randint(2**31, (1,), generator=generator, device=generator.device)
        learned = LearnedClouds(index=index, similarity=similarity, views=views)
        made = self._found(learned, observation, labels, torch.Generator().manual_seed(int(seed)))
        self.template.load_state_dict(made.template.state_dict())
        self._set_pseudo_labels(cloud[:, 0], views, made.found)
        self.pseudo.belonging = inlier
        self._learn_orientation(views, made, seed)
        self.to(device)

    def _observed(
        self, cloud: Float[Tensor, "B N 3"]
    ) -> tuple[Similarity, PartialViews, Bool[Tensor, "B N"]]:
        """Clouds of the training data as views, their normalisation and their inliers."""
        inlier = self._inlier_mask(cloud)
        points, similarity = normalise(replaced(cloud, inlier))
        camera = -similarity.centre * similarity.scale[:, None]  # the camera is the origin
        return similarity, observe(points, camera, count=self.config.points), inlier

    @abstractmethod
    def _seconds(self, clouds: int) -> float:
        """How long finding the template usually takes, with so many learned clouds, on one core."""

    @abstractmethod
    def _found(
        self,
        learned: LearnedClouds,
        observation: Observation,
        labels: Labels,
        generator: torch.Generator,
    ) -> Discovery:
        """The template, and its placement in the learned clouds; on the host.

        Args:
            learned: Those clouds.
            observation: All training clouds.
            labels: Of all, as allowed by `supervision`.
            generator: On the host.
        """

    @abstractmethod
    def _prediction(
        self,
        placement: Placement,
        part_weight: Float[Tensor, "B N P"],
        similarity: Similarity,
        confidence: Float[Tensor, " B"],
    ) -> Prediction:
        """What a placement in normalised frames stands for."""

    def _inlier_mask(self, cloud: Float[Tensor, "B N 3"]) -> Bool[Tensor, "B N"]:
        """Which points belong to the object; all where outliers are kept."""
        if self.config.strays == "kept":
            return torch.ones(cloud.shape[:2], dtype=torch.bool, device=cloud.device)
        return inlier_mask(cloud)

    def _set_pseudo_labels(self, key: Tensor, views: PartialViews, found: SearchResult) -> None:
        trust = torch.zeros_like(found.loss)
        trust[most_confident(found, self.config.trusted)] = 1.0
        placement = found.placement
        away = views.camera - placement.translation
        camera = (placement.rotation.mT @ away[..., None])[..., 0]
        self.pseudo.set(key, placement, camera, trust)
        self.pseudo.show(ShownPoints.of(views))

    def _learn_orientation(self, views: PartialViews, made: Discovery, seed: Tensor) -> None:
        """From objects that know better, or else from the views that are placed most surely."""
        scorer, sure = made.scorer, (self.pseudo.trust > 0).cpu()
        if scorer is None:
            generator = torch.Generator().manual_seed(int(seed))
            rotation = made.found.placement.rotation[sure]
            scorer = OrientationScorer()
            scorer.learn(take(views, sure), rotation, generator, price=VIEWS_CHARGE)
        self.orientation.load_state_dict(scorer.state_dict())

    def strip(self) -> None:
        """Keep of the training clouds what `quick` and `refine` look at: those placed surely."""
        self.pseudo.keep_trusted()

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The network's votes against the placements that were found (`vote_losses`)."""
        del labels
        row = self._learned_row(step)
        points, _ = normalise(replaced(observation.points, self.pseudo.belonging[row]))
        device = points.device
        index = torch.randperm(points.shape[1], generator=step.generator, device=device)
        points = self._thinned(points[:, index[: SAMPLED * self.config.points]])
        frame = random_frames(points, self.pseudo.rotation[row].mT, step.generator)
        noise = torch.randn(points.shape, generator=step.generator, device=device) * NOISE
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

    @torch.no_grad()
    def _target(self, points: Float[Tensor, "B K 3"], row: Int[Tensor, " B"]) -> Target:
        placement = take(self.pseudo.placement(), row)
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
        frames = principal_frames(points).flatten(0, 1)
        placement, votes, sure = self._votes(points.repeat_interleave(FRAMES, 0), frames)
        return placement, (votes, sure.view(len(points), FRAMES))

    def _votes(
        self, points: Float[Tensor, "B K 3"], frames: Float[Tensor, "B 3 3"]
    ) -> tuple[Placement, Votes, Float[Tensor, " B"]]:
        """What the network says of each cloud in a frame, and how sure it is."""
        turned = points @ frames.mT
        votes = self.network(turned)
        weight = votes.sureness.sigmoid().square()
        rotation, translation = procrustes(turned, votes.points, weight)
        placement = Placement(
            rotation=frames.mT @ rotation,
            translation=(frames.mT @ translation[..., None])[..., 0],
            log_scale=votes.log_scale,
            state=votes.state,
            shift=votes.shift,
            deviation=torch.zeros_like(votes.shift),
        )
        return placement, votes, weight.mean(1)

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """The template over its states, and where the network places it."""
        del stage
        cloud = observation.points
        points, _ = normalise(replaced(cloud, self._inlier_mask(cloud)))
        kept = self._thinned(points)
        placement, (_, sure) = self._hypotheses(kept)
        row = torch.arange(len(points), device=points.device) * FRAMES + sure.argmax(1)
        return template_pictures(self.template, self._limits(), kept, take(placement, row))

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses and joints."""
        cloud = observation.points.to(self.template.points)
        clean, similarity = normalise(replaced(cloud, self._inlier_mask(cloud)))
        points = similarity.forward(cloud)
        index = farthest_points(clean, min(self.config.points, clean.shape[1]))
        kept = gather(clean, index)
        standing = self.config.camera == "known" and bool(self.orientation.learned)
        if mode == "fast" and not standing:
            chosen, votes, confidence = self._surest(kept)
            weight = gather(votes.part.softmax(-1), nearest(points, kept))
            return self._answer(chosen, weight, similarity, confidence)
        camera, frame = self._camera(observation, similarity, kept), own_frame(kept)
        turned = (frame @ camera[..., None])[..., 0]
        views = observe(clean @ frame.mT, turned, index=index)
        if mode == "fast":
            frames = self._space().propose(views, 1).rotation.mT
            chosen, votes, confidence = self._votes(views.points, frames)
            weight = gather(votes.part.softmax(-1), nearest(points @ frame.mT, views.points))
        else:
            chosen, confidence = self._searched(views, mode)
            weight = nearest_weights(self.template, points @ frame.mT, chosen, turned)
        chosen = turn_placement(chosen, frame.mT)
        return self._answer(chosen, weight, similarity, confidence)

    def _answer(
        self,
        placement: Placement,
        part_weight: Float[Tensor, "B N P"],
        similarity: Similarity,
        confidence: Float[Tensor, " B"],
    ) -> Prediction:
        """`_prediction`, with the states that were seen in training as limits."""
        plain = self._prediction(placement, part_weight, similarity, confidence)
        if not bool((self.pseudo.trust > 0).any()):  # not trained yet
            return plain
        return replace(plain, joint_limits=metric_limits(self.template, self._limits(), similarity))

    def _surest(self, kept: Float[Tensor, "B K 3"]) -> tuple[Placement, Votes, Float[Tensor, " B"]]:
        """The network's placement in the frame in which it is surest, its votes, how sure it is."""
        placement, (votes, sure) = self._hypotheses(kept)
        best = sure.argmax(1)
        row = torch.arange(len(kept), device=kept.device) * FRAMES + best
        return take(placement, row), take(votes, row), sure.gather(1, best[:, None])[:, 0]

    def _camera(
        self, observation: Observation, similarity: Similarity, kept: Float[Tensor, "B K 3"]
    ) -> Float[Tensor, "B 3"]:
        """The camera's centre in the normalised frame of each cloud."""
        if self.config.camera == "estimated":
            placement, votes, _ = self._surest(kept)
            return (placement.rotation @ votes.camera[..., None])[..., 0] + placement.translation
        sensor = observation.sensor
        away = -similarity.centre if sensor is None else sensor - similarity.centre
        return away * similarity.scale[:, None]

    def _searched(self, views: PartialViews, mode: Mode) -> tuple[Placement, Float[Tensor, " B"]]:
        """The best hypothesis after a few steps, and its margin.

        All happens in a frame of the cloud's own, so that grids of rolls and of the depth image
        turn with it.
        """
        space, quick = self._space(), mode == "quick"
        effort = BRIEF if quick else THOROUGH
        count = self.config.quick_hypotheses if quick else self.config.grid_hypotheses
        start = space.propose(views, count) if count else self._hypotheses(views.points)[0]
        left = successive_halving(self.template, views, start, space, effort)
        found = left.best(self._limits().wider(CHARGED))
        final = found.placement
        if self.config.settle and not quick:
            final = refine_states(self.template, views, found, self._limits())
        if self.template.deviates():
            final, _ = refine_deviations(self.template, views, final)
        return final, found.margin

    def _limits(self) -> JointLimits:
        """Of the training views that the network learned."""
        return limits_of(self.pseudo.state[self.pseudo.trust > 0], self.template.kinds)

    def _space(self) -> SearchSpace:
        """States, shifts, sizes and cameras of the training views that the network learned.

        What is seen of the template from there is drawn once.
        """
        shape = [*self.template.state_dict(keep_vars=True).values(), *self.pseudo.buffers()]
        key = [(id(tensor), tensor._version, tensor.device) for tensor in shape]
        if self._drawn is None or self._drawn[0] != key:
            self._drawn = key, self._draw()
        return self._drawn[1]

    def _draw(self) -> SearchSpace:
        learned = self.pseudo.trust > 0
        states = grid_of_states(self._limits().wider(ROOM))
        placement = take(self.pseudo.placement(), learned)
        camera = F.normalize(self.pseudo.camera[learned], dim=-1)
        placed = None
        if len(self.pseudo.points):
            shown = ShownPoints(
                points=self.pseudo.points[learned], normals=self.pseudo.normals[learned]
            )
            placed = ViewBank.placed(self.template, shown, placement, camera)
        modes = modes_of(placement, states)
        return SearchSpace(
            rendered=ViewBank.rendered(light(self.template), modes, camera),
            placed=placed,
            states=states,
            scorer=self.orientation,
        )


class TemplateRegistration(AbstractRegistered):
    """Template registration: the template is discovered, without labels of poses or parts."""

    name: ClassVar[str] = "registered"
    config: RegisteredConfig

    def __init__(
        self, config: RegisteredConfig, category: Category, generator: torch.Generator
    ) -> None:
        """A method whose template is still empty."""
        super().__init__(config, category, generator)
        self.supervision: frozenset[Supervision] = frozenset(config.supervision)

    @property
    def variant(self) -> str:
        """The preset, whether objects were known, and options that differ from the preset's."""
        config = self.config
        words = [] if config.preset == "cpu" else [config.preset]
        words += ["objects known"] if self.supervision else []
        return " ".join([*words, *changes(config, PRESETS[config.preset](), leave=UNNAMED)])

    def _seconds(self, clouds: int) -> float:
        """Of all steps of a discovery."""
        config = self.config.discovery
        objects = config.objects if self.supervision else 0
        further = config.further_objects if self.supervision else 0
        return sum(plan_of(config, self.template.kinds, clouds, objects, further).values())

    def _found(
        self,
        learned: LearnedClouds,
        observation: Observation,
        labels: Labels,
        generator: torch.Generator,
    ) -> Discovery:
        """By registration and bundle adjustment of the views."""
        kinds, config = self.template.kinds, self.config.discovery
        objects = ObjectViews()
        if labels.instance is not None:
            known, further = (
                [self._of_one_size(observation.points[rows].cpu()) for rows in some]
                for some in grouped(labels.instance.cpu(), config)
            )
            objects = ObjectViews(known=known, further=further)
            if not known:
                logger.warning("too few clouds of any one object: which show the same is not used")
        return discover(learned.views, kinds, config, generator, objects, self.journal)

    def _of_one_size(self, cloud: Float[Tensor, "B N 3"]) -> PartialViews:
        """Clouds of one object, normalised all alike: it is as large in all of them."""
        similarity, views, _ = self._observed(cloud)
        return views.scaled(similarity.scale.median() / similarity.scale)

    def _prediction(
        self,
        placement: Placement,
        part_weight: Float[Tensor, "B N P"],
        similarity: Similarity,
        confidence: Float[Tensor, " B"],
    ) -> Prediction:
        """Part frames sit at the middle of the template's base."""
        return placed_prediction(self.template, placement, part_weight, similarity, confidence)
