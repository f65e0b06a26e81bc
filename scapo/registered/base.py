# SPDX-License-Identifier: MIT
"""An articulated template, a network that says how it stands in a cloud, and the search for both.

What `method` and its bound (`labelled`) share: all but where the template comes from.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import Category, JointKind
from scapo.first_weights import initialise
from scapo.geometry.points import Similarity, farthest_points, gather, nearest, normalise
from scapo.method import NO_JOURNAL, AbstractMethod, Mode, ParameterGroup, Stage, Step, evenly
from scapo.pictures import PictureData
from scapo.records import cat, map_tensors, take, without_autograd
from scapo.registered.axis_deviation import refine_deviations
from scapo.registered.config import DISSENT, SearchConfig
from scapo.registered.decode import (
    lying_rest,
    metric_limits,
    nearest_weights,
    placed_prediction,
)
from scapo.registered.discovery import Discovery
from scapo.registered.figures import template_pictures
from scapo.registered.joint_limits import JointLimits, limits_of
from scapo.registered.learning import (
    FIRST,
    Said,
    SeenClouds,
    candidates,
    dissent,
    hinged_as,
    learned_row,
    taught,
    taught_in_principal_frames,
    taught_rows,
    undeviated,
    voted,
)
from scapo.registered.network import PointVotes, in_principal_frames, own_frame, surest
from scapo.registered.orientation import VIEWS_CHARGE, OrientationScorer
from scapo.registered.outliers import inlier_mask, replaced
from scapo.registered.pose_search import (
    BRIEF,
    CHARGED,
    OWN,
    THOROUGH,
    Effort,
    Hypotheses,
    SearchResult,
    SearchSpace,
    grid_of_states,
    most_confident,
    of_one,
    refine_states,
    successive_halving,
)
from scapo.registered.pseudo_labels import Candidates, LearnedClouds, PseudoLabels, ViewTargets
from scapo.registered.surfaces import lying
from scapo.registered.template import ArticulatedTemplate, Placement, interleave, turn_placement
from scapo.registered.upright import Upright
from scapo.registered.view_bank import ShownPoints
from scapo.registered.view_network import ViewNetwork
from scapo.registered.views import NEIGHBOURS, PartialViews, observe, surface_normals
from scapo.types import Labels, Observation, Prediction

LEAST_CLOUDS = 8  # Views that a template can be found in at all, two of which judge
LAST_RATE = 0.01  # Share of the learning rate at the end
PLACED, KEPT = 50, 250  # Clouds that are placed at a time, and after which what was found is kept
PLACING, LATE = 0.08, 0.8
"""Seconds of one core for each of them, and the share of the start that is over before."""
BETTER = 0.03
"""Loss by which a hypothesis of the banks has to explain a view better than the network's own."""
ROOM = 0.2  # Share of the inliers' range beyond which `refine` searches states


class AbstractRegistered(AbstractMethod):
    """An articulated template, the network that votes for its placement, and their training.

    Where the template comes from, and what its placements say of part frames, is left open.
    """

    networks: ClassVar[tuple[str, ...]] = ("network",)
    usual: ClassVar[Mode] = "quick"
    least_points = NEIGHBOURS
    takes_up = True

    def __init__(
        self, config: SearchConfig, category: Category, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.config, self.category = config, category
        kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        self.template = ArticulatedTemplate(kinds, config.discovery.final_points)
        self.template.mirrored = category.turns_over
        sizes = (len(category.parts), len(kinds))
        self.network = (
            ViewNetwork(*sizes, channels=config.channels)
            if config.camera == "known"
            else PointVotes(*sizes, width=config.width)
        )
        initialise(self.network, generator)
        self.pseudo, self.targets = PseudoLabels(), ViewTargets()
        self.orientation = OrientationScorer()
        self._drawn: tuple[list[tuple[int, int, torch.device]], SearchSpace] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """What a copy in another process needs: neither what was drawn nor the journal."""
        return {**self.__dict__, "_drawn": None, "journal": NO_JOURNAL}

    def stages(self) -> tuple[Stage, ...]:
        """The network's rounds; the template is found before the first."""
        rounds = self.config.rounds if self.config.camera == "known" else 1
        names = [FIRST, *(f"round-{k + 1}" for k in range(1, rounds))]
        return tuple(
            Stage(
                name=name,
                epochs=-(-self.config.epochs // (1 if name == names[-1] else 2)),
                lr=self.config.lr,
                min_lr=self.config.lr * LAST_RATE,
                batch=self.config.batch,
                clouds=self._taught(),
                parameters=(ParameterGroup(module="network"),),
            )
            for name in names
        )

    def _taught(self) -> int:
        """How many training clouds the network learns from."""
        return self.config.placed if self.config.camera == "known" else self.config.learned

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Find the template, and its placement in the clouds that the network will learn."""
        if stage != FIRST:
            self._place(observation.points, labels, generator, stage)
            return
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
        self._place(observation.points, labels, generator, stage)

    def _place(
        self,
        cloud: Float[Tensor, "B N 3"],
        labels: Labels,
        generator: torch.Generator,
        stage: str,
    ) -> None:
        """Find on the host what the network learns, as `quick` would: a few candidates of each."""
        if not isinstance(self.network, ViewNetwork):
            return
        device = self.template.points.device
        self.cpu()
        self.eval()  # it is asked, and learns nothing yet
        host = torch.Generator().manual_seed(0) if generator.device.type != "cpu" else generator
        self._revise(cloud, host)
        self.targets.clear()
        index = taught_rows(len(cloud), self._taught(), stage).to(cloud.device)
        cloud, labels = cloud[index].cpu(), map_tensors(take(labels, index), Tensor.cpu)
        makers = {kind.__name__: kind for kind in (Candidates, Placement)}
        parts, total = list[Candidates](), len(index)
        jobs = [partial(self._candidates_of_all, some) for some in cloud.split(KEPT)]
        for done, make in zip(range(0, total, KEPT), self.journal.ahead(jobs), strict=True):
            begun = LATE if stage == FIRST else 0.0
            share = begun + (1 - begun) * done / total
            self.journal.tell(f"placing clouds, {done} of {total}", share, PLACING * (total - done))
            parts.append(self.journal.once(f"placed clouds from {done} on", make, host, makers))
        self.targets.set(*self._trusted(cat(parts), cloud, labels, host))
        self._hang(cloud, labels)
        self.network.learned.fill_(1.0)
        self.to(device)

    def _revise(self, cloud: Float[Tensor, "B N 3"], generator: torch.Generator) -> None:
        """Ask something of the template anew, of training clouds; on the host."""

    def _trusted(
        self, found: Candidates, cloud: Tensor, labels: Labels, generator: torch.Generator
    ) -> tuple[Candidates, Float[Tensor, " B"]]:
        """What is learned of clouds, and the weight of each: the surest."""
        del cloud, labels, generator
        return found, found.surest(self.config.trusted)

    def _hang(self, cloud: Tensor, labels: Labels) -> None:
        """Add to the targets where hinges of objects sit, if that is known."""

    def _candidates_of_all(self, cloud: Float[Tensor, "B N 3"]) -> Candidates:
        return cat([self._candidates(some) for some in cloud.split(PLACED)])

    def _candidates(self, cloud: Float[Tensor, "B N 3"]) -> Candidates:
        seen = self._seen(Observation(points=cloud))
        left = self._settled(seen, self._said(seen), self.config.quick_hypotheses, BRIEF)
        return candidates(self.template, seen, left, self._limits().wider(CHARGED))

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

    def _rest(self, placement: Placement) -> Float[Tensor, "B J"]:
        """States at which a part's frame is the base's: nobody knows at which the parts were made.

        The template has them anywhere in their range, and stretches them as they lie there.
        """
        return lying_rest(self.template, placement)

    def _origin(self) -> Float[Tensor, " 3"]:
        """The template's point at which part frames sit: the middle of its base."""
        return self.template.part_centres()[0]

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
        self.targets.clear()

    def rows(self, stage: Stage, total: int) -> Int[Tensor, " K"]:
        """Those whose placements are trusted."""
        trust = self.targets.trust if isinstance(self.network, ViewNetwork) else self.pseudo.trust
        return taught_rows(total, self._taught(), stage.name)[(trust > 0).cpu()]

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The network's votes against the placements that were found (`learning`)."""
        del labels
        clouds, count = (observation.points, learned_row(step, self._taught())), self.config.points
        if isinstance(self.network, ViewNetwork):
            return taught(self.network, self.template, self.targets, clouds, count, step.generator)
        return taught_in_principal_frames(
            self.network, self.template, self.pseudo, clouds, count, step.generator
        )

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """The template over its states, and where the network places it."""
        del stage
        seen = self._seen(observation)
        placement = self._voted(seen).placement
        return template_pictures(self.template, self._limits(), seen.views.points, placement)

    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses and joints."""
        if mode == "whole":
            return self._of_surfaces(map_tensors(observation, lambda x: x.to(self.template.points)))
        return self._of_views(observation, mode)

    @without_autograd
    def _of_views(self, observation: Observation, mode: Mode) -> Prediction:
        seen = self._seen(observation)
        alone = mode == "fast" and self._has_learned()
        said = self._voted(seen) if alone else self._searched(seen, mode)
        said = replace(said, placement=turn_placement(said.placement, seen.frame.mT))
        return self._answer(said, seen.similarity)

    def _of_surfaces(self, observation: Observation) -> Prediction:
        """Of clouds that show all of an object, not the side that a camera sees.

        Raises:
            ValueError: A model without a network that knows cameras.
        """
        if isinstance(self.network, PointVotes) or not self._has_learned():
            raise ValueError("mode whole: expected a network that learned cameras, found none")
        clouds, similarity = normalise(observation.points)
        away = float(self.pseudo.camera[self.pseudo.trust > 0].norm(dim=1).median())
        placement, sure = lying(self.template, self._of_view, away, clouds)
        if (upright := self._upright(observation.up)) is not None:
            placement = upright.raised(self.template, placement)
        normals = torch.zeros_like(clouds)  # Which way a surface faces is not known
        weight = nearest_weights(self.template, clouds, normals, placement)
        said = Said(placement=placement, part_weight=weight, sure=sure)
        return replace(self._answer(said, similarity), misfit=None)  # shares of votes tell none

    def _of_view(
        self, observation: Observation
    ) -> tuple[Placement, Float[Tensor, " B"], Similarity]:
        """What the network alone says of a view: a placement in normalised clouds, how sure."""
        seen = self._seen(observation)
        said = self._voted(seen)
        return turn_placement(said.placement, seen.frame.mT), said.sure, seen.similarity

    def _has_learned(self) -> bool:
        """Whether the network can be asked; of a method that was never trained there is no more."""
        if isinstance(self.network, PointVotes) or not len(self.pseudo.state):
            return True
        return bool(self.network.learned)

    def _seen(self, observation: Observation) -> SeenClouds:
        """Clouds in frames of their own, so that grids of rolls and images turn with them."""
        cloud = observation.points.to(self.template.points)
        inlier = self._inlier_mask(cloud)
        clean, similarity = normalise(replaced(cloud, inlier))
        index = farthest_points(clean, min(self.config.points, clean.shape[1]))
        kept = gather(clean, index)
        camera, frame = self._camera(observation, similarity, kept), own_frame(kept)
        clean, camera = clean @ frame.mT, (frame @ camera[..., None])[..., 0]
        normals = surface_normals(clean, clean, camera)
        return SeenClouds(
            points=similarity.forward(cloud) @ frame.mT,
            clean=clean,
            views=observe(clean, camera, index=index, normals=normals),
            frame=frame,
            similarity=similarity,
            inlier=inlier,
            normals=normals,
            up=None if observation.up is None else (frame @ observation.up[..., None])[..., 0],
        )

    def _upright(self, up: Float[Tensor, "B 3"] | None) -> Upright | None:
        """The up of clouds beside the template's, if it is known."""
        if up is None:
            return None
        if self.up is None:
            raise ValueError("up: expected a model in the object's frame, whose base comes first")
        return Upright(own=torch.tensor(self.up).to(up), seen=up)

    def _voted(self, seen: SeenClouds) -> Said:
        """What the network alone says."""
        if isinstance(self.network, PointVotes):
            kept = seen.views.points
            placement, votes, sure = surest(self.network, kept)
            weight = gather(votes.part.softmax(-1), nearest(seen.points, kept))
            said = Said(placement=placement, part_weight=weight, sure=sure)
        else:
            said = voted(self.network, self.template, seen, self.config.looks)
        if (upright := self._upright(seen.up)) is None:
            return said
        level = (1 - upright.leaning(said.placement.rotation)).clamp(0, 1)
        raised = upright.raised(self.template, said.placement)
        return replace(said, placement=raised, sure=said.sure * level)

    def _answer(self, said: Said, similarity: Similarity) -> Prediction:
        """What a placement stands for, with the states that were seen in training as limits."""
        rest, origin = self._rest(said.placement), self._origin()
        plain = placed_prediction(
            self.template, said.placement, rest, origin, said.part_weight, similarity
        )
        limits = None
        if bool((self.pseudo.trust > 0).any()):  # else it is not trained yet
            limits = metric_limits(self.template, self._limits(), rest, similarity)
        misfit = 1 - said.sure if said.loss is None else said.loss
        return replace(plain, joint_limits=limits, confidence=said.sure, misfit=misfit)

    def _camera(
        self, observation: Observation, similarity: Similarity, kept: Float[Tensor, "B K 3"]
    ) -> Float[Tensor, "B 3"]:
        """The camera's centre in the normalised frame of each cloud."""
        if self.config.camera == "estimated":
            assert isinstance(self.network, PointVotes)  # noqa: S101 - as `__init__` has it
            placement, votes, _ = surest(self.network, kept)
            return (placement.rotation @ votes.camera[..., None])[..., 0] + placement.translation
        sensor = observation.sensor
        away = -similarity.centre if sensor is None else sensor - similarity.centre
        return away * similarity.scale[:, None]

    def _searched(self, seen: SeenClouds, mode: Mode) -> Said:
        """The best hypothesis after a few steps, and its margin."""
        said = self._said(seen)
        left = self._hypotheses(seen, said, mode == "refine")
        found = left.best(self._limits().wider(CHARGED))
        final = found.placement
        if self.config.settle and mode == "refine" and said is None:
            final = refine_states(self.template, seen.views, found, self._limits())
        if self.template.deviates():
            final, _ = refine_deviations(self.template, seen.views, final, rounds=1, turns=1)
        if (upright := self._upright(seen.up)) is not None:
            final = upright.raised(self.template, final)
        if said is not None:
            final = hinged_as(self.template, said.placement, final)
        weight = seen.part_weights(self.template, final, said)
        return Said(placement=final, part_weight=weight, sure=found.margin, loss=found.loss)

    def _said(self, seen: SeenClouds) -> Said | None:
        """What the network that knows cameras says; None without one."""
        if isinstance(self.network, PointVotes) or not self._has_learned():
            return None
        return self._voted(seen)

    def _hypotheses(self, seen: SeenClouds, said: Said | None, refine: bool) -> Hypotheses:
        """Those that are left in the end."""
        config, learned = self.config, self._has_learned()
        if refine:
            found = self._settled(seen, said, config.grid_hypotheses, THOROUGH)
            if said is None:
                return found
            charged = replace(found, unlike=found.unlike + BETTER)
            return charged.with_others(self._settled(seen, said, 0, OWN)).bounded()
        alone = learned and seen.up is None  # what the network had upside down is looked for
        beside = config.quick_beside if alone else config.quick_hypotheses
        return self._settled(seen, said, beside, BRIEF if beside else of_one(self.template))

    def _settled(self, seen: SeenClouds, said: Said | None, beside: int, by: Effort) -> Hypotheses:
        """What is left of the network's and `beside` more, charged where it dissents."""
        views, upright = seen.views, self._upright(seen.up)
        space = replace(self._space(), upright=upright)
        start = self._without_network(views, beside) if said is None else undeviated(said.placement)
        if said is not None and beside:
            start = interleave([start, space.propose(views, beside)], len(views.points))
        if upright is not None:
            start = upright.raised(self.template, start)
        left = successive_halving(self.template, views, start, space, by)
        if said is None:
            return left
        price = DISSENT if self.config.dissent is None else self.config.dissent
        charge = dissent(self.template, said, left.placement, price)
        return replace(left, unlike=left.unlike + charge)

    def _without_network(self, views: PartialViews, count: int) -> Placement:
        """Hypotheses of the banks alone, or of the network that needs no camera."""
        if isinstance(self.network, PointVotes) and not count:
            return in_principal_frames(self.network, views.points)[0]
        return self._space().propose(views, max(count, 1))

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
            states = grid_of_states(self._limits().wider(ROOM))
            self._drawn = key, self.pseudo.space(self.template, states, self.orientation)
        return self._drawn[1]
