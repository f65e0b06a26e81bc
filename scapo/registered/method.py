# SPDX-License-Identifier: MIT
"""Template registration: partial views are registered, fitted together and then learned.

A method of this project's. It shares SCAPO's idea, one articulated template per category, found
without labels, and none of its networks (docs/registration.md).

Training. Views of the category are registered and fitted together into one articulated template,
which is then searched for in the training views (`discovery`); a network (`view_network`) learns
how it stands in many of them. Outliers of the clouds are left out (`outliers`). No label is used
anywhere: templates, hypotheses and confidence come from the loss of the views alone. Camera
positions of the training clouds are known (their frame's origin).

The network proposes how the template stands in a cloud, two banks of images (`view_bank`) propose
more, which a scorer sorts that learned what standing objects look like (`orientation`). `fast` is
the network's word. `quick` and `refine` fit the template to the cloud: `quick` from that word in a
few steps, `refine` from it and the banks' proposals to the end. All ask where the camera was: at
the origin of the cloud's frame or at `Observation.sensor`. Where that is not known
(`camera="estimated"`) another network (`network`) is asked in four frames that the points alone
tell, and where it believes the camera is there `quick` and `refine` take it to be.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.categories import Category
from scapo.geometry.points import normalise
from scapo.method import ParameterGroup, Stage, Step, changes, evenly
from scapo.records import cat, take
from scapo.registered.axis_deviation import square_axes, with_axis_deviation
from scapo.registered.base import PLACED, PLACING, AbstractRegistered
from scapo.registered.bundle_adjustment import Candidate, Inliers
from scapo.registered.config import PRESETS, UNNAMED, RegisteredConfig, decided
from scapo.registered.course import DEVIATION, VIEW, Course, are_alike, plan_of
from scapo.registered.discovery import Discovery, discover, held_out
from scapo.registered.gauge import settle_hinges
from scapo.registered.halves import cut_by_mirror
from scapo.registered.learning import FIRST, candidates
from scapo.registered.objects import LEAST_OBJECTS, grouped, rows_by_object
from scapo.registered.outliers import replaced
from scapo.registered.pose_search import (
    BRIEF,
    CHARGED,
    SearchResult,
    most_confident,
    search_views,
    successive_halving,
)
from scapo.registered.pseudo_labels import Candidates, LearnedClouds
from scapo.registered.standing import (
    ObjectFrame,
    against,
    agreeing,
    exchanged,
    frame_of,
    how_objects_stand,
)
from scapo.registered.template import Placement, turn_placement
from scapo.registered.view_network import ViewNetwork
from scapo.registered.views import PartialViews
from scapo.released import find
from scapo.store.checkpoint import (
    check_header,
    config_from,
    header_category,
    load_arrays,
    read_checkpoint,
)
from scapo.store.files import StoreError
from scapo.types import Labels, Observation, Supervision

logger = logging.getLogger(__name__)

FRAME = 4.0  # Seconds of one core for an object's views that are registered with one another
TURNED = 50  # Clouds that are placed at a time as their objects stand
LEANING = 160  # Clouds that are asked again whether hinges deviate
SURE = 0.6  # Share of those that do not judge to which a template is fitted then


class TemplateRegistration(AbstractRegistered):
    """Template registration: the template is discovered, without labels of poses or parts."""

    name: ClassVar[str] = "registered"
    config: RegisteredConfig

    def __init__(
        self, config: RegisteredConfig, category: Category, generator: torch.Generator
    ) -> None:
        """A method whose template is still empty."""
        super().__init__(decided(config, category), category, generator)
        self._frames: list[ObjectFrame] | None = None
        self.supervision: frozenset[Supervision] = frozenset(config.supervision)

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """As another run found it, where one is named; else found here.

        Raises:
            ValueError: A run that was told more, or whose template has another size.
            StoreError: No such run (`load_run`).
        """
        if self.config.start is None or stage != FIRST:
            super().start(stage, observation, labels, generator)
            return
        known = load_run(self.config.start, self.category)
        if left := known.supervision - self.supervision:
            raise ValueError(
                f"start: {self.config.start} was told {', '.join(left)}; "
                f"add --supervision {' '.join(left)}"
            )
        if len(known.template.points) != len(self.template.points):
            raise ValueError(
                f"start: expected a template of {len(self.template.points)} points, found one of "
                f"{len(known.template.points)} in {self.config.start}; "
                f"add --discovery.final-points {len(known.template.points)}"
            )
        for name in ("template", "pseudo", "orientation"):
            getattr(self, name).load_state_dict(getattr(known, name).state_dict())
        if self.config.teach == "all":  # the network learns how parts lie then
            self._improve_template()
        sizes = [(one.config.camera, one.config.channels) for one in (known, self)]
        if self.config.teach == "hinges" and (sizes[0] != sizes[1] or not known._has_learned()):
            raise ValueError(
                f"start: expected a run whose network is one as here, found {self.config.start}; "
                "without it there is more to teach than hinges"
            )
        if sizes[0] == sizes[1]:
            self.network.load_state_dict(known.network.state_dict())
        self._place(observation.points, labels, generator, stage)

    def _revise(self, cloud: Float[Tensor, "B N 3"], generator: torch.Generator) -> None:
        """Whether two alike hinges deviate, asked again of clouds that the network helps to place.

        Without it views are placed so much worse that the same objects are found to deviate by one
        draw and not by the next.
        """
        if len(cloud) >= 2 * self._taught():
            self._frames = None  # of other clouds: those of the round before (`taught_rows`)
        asked = self.config.discovery.leans and self.config.teach == "all"
        alike = are_alike(self.template.kinds) and "revolute" in self.template.kinds
        if asked and alike and self._has_learned() and not self.template.deviates():
            self._ask_deviation(cloud, generator)

    def _ask_deviation(self, cloud: Float[Tensor, "B N 3"], generator: torch.Generator) -> None:
        """Take a template whose hinges deviate, if it explains clouds far better."""
        learned = self.config.learned
        axes, search = "deviating axes again", "search of all views again"
        plan = {axes: DEVIATION + VIEW * LEANING, search: VIEW * learned}
        course = Course(self.template, generator, plan, self.journal)
        asked = cloud[evenly(len(cloud), LEANING).to(cloud.device)].cpu()
        made = course.step(axes, partial(self._deviating, asked, generator))
        if not made.template.deviates():
            return
        cloud = cloud[evenly(len(cloud), learned).to(cloud.device)].cpu()
        _, views, self.pseudo.belonging = self._observed(cloud)
        searching = partial(search_views, made, views, self.orientation, self.journal)
        found = course.step(search, searching)
        self.template.load_state_dict(made.template.state_dict())
        self._set_pseudo_labels(cloud[:, 0], views, found)

    def _deviating(self, cloud: Float[Tensor, "B N 3"], generator: torch.Generator) -> Candidate:
        """The template, fitted to clouds as `quick` places them if its hinges deviate."""
        config = self.config.discovery
        jobs = [partial(self._placed, some) for some in cloud.split(PLACED)]
        found = cat([job() for job in self.journal.ahead(jobs)])
        views, (judges, others) = self._observed(cloud)[1], held_out(len(cloud), config.judged)
        sure = others[most_confident(take(found, others), SURE)]
        inliers = Inliers(views=take(views, sure), placement=take(found.placement, sure))
        start = Candidate(template=self.template, inliers=inliers)
        return with_axis_deviation(start, take(views, judges), config, generator, self.journal)

    def _placed(self, cloud: Float[Tensor, "B N 3"]) -> SearchResult:
        """As `quick` has them."""
        seen = self._seen(Observation(points=cloud))
        left = self._hypotheses(seen, self._said(seen), refine=False)
        found = left.best(self._limits().wider(CHARGED))
        return replace(found, placement=turn_placement(found.placement, seen.frame.mT))

    def _improve_template(self) -> None:
        """What a discovery does to its template at last and an earlier one may have left."""
        square_axes(self.template)
        placement = self.pseudo.placement()
        if self.template.deviates():
            placement = settle_hinges(self.template, placement, touching=True)
        self.pseudo.shift = cut_by_mirror(self.template, placement).shift

    def stages(self) -> tuple[Stage, ...]:
        """The network's rounds, of all of it or of what it says of hinges."""
        share = super()._taught() / self._taught()
        made = tuple(
            replace(stage, epochs=max(1, round(share * stage.epochs))) for stage in super().stages()
        )
        if self.config.teach == "all":
            return made
        hinges = (ParameterGroup(module="network.hinge"),)
        return tuple(replace(stage, parameters=hinges) for stage in made)

    def _taught(self) -> int:
        """More views of each object where objects say how they stand."""
        asked = self.config.stand == "objects" and self.config.camera == "known"
        return self.config.of_objects if asked else super()._taught()

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """As `AbstractRegistered`; what is not taught does not take on means of batches either."""
        if self.config.teach == "hinges":
            self.network.eval()
        return super().losses(observation, labels, step)

    def _hang(self, cloud: Float[Tensor, "B N 3"], labels: Labels) -> None:
        """By the views of each object (`hinges`), where the network knows cameras.

        Views of a laptop take its base for its screen or not, and on each the hinge lies elsewhere.

        Raises:
            ValueError: Hinges alone are to be taught, and of no object they are told.
        """
        if labels.instance is None or not isinstance(self.network, ViewNetwork):
            return
        exchanged = self.category.symmetry is not None and len(self.template.kinds) == 1
        mixed = exchanged and not bool(self.template.alike)
        size = normalise(replaced(cloud, self.targets.inlier))[1].scale
        objects = [] if mixed else rows_by_object(labels.instance)
        if self.targets.hang(self.template, size, objects):
            self.network.hinged.fill_(1.0)
        elif self.config.teach == "hinges":
            raise ValueError("teach: expected objects with a hinge and several views, found none")

    def axes(self) -> Float[Tensor, "J 3"]:
        """Of the template's joints."""
        return self.template.directions().detach()

    @property
    def variant(self) -> str:
        """The preset, whether objects were known, and options that differ from the preset's."""
        config = self.config
        words = [] if config.preset == "cpu" else [config.preset]
        words += ["objects known"] if self.supervision else []
        default = replace(PRESETS[config.preset](), supervision=config.supervision)
        default = decided(default, self.category)
        return " ".join([*words, *changes(config, default, leave=UNNAMED)])

    def _seconds(self, clouds: int) -> float:
        """Of all steps of a discovery."""
        config = self.config.discovery
        objects = config.objects if self.supervision else 0
        return sum(plan_of(config, self.template.kinds, clouds, objects).values())

    def _found(
        self,
        learned: LearnedClouds,
        observation: Observation,
        labels: Labels,
        generator: torch.Generator,
    ) -> Discovery:
        """By registration and bundle adjustment of the views."""
        config, like = self.config.discovery, self.template
        objects = list[PartialViews]()
        if labels.instance is not None:
            rows = grouped(labels.instance.cpu(), config)
            objects = [self._of_one_size(observation.points[own].cpu()) for own in rows]
            if not objects:
                logger.warning("too few clouds of any one object: which show the same is not used")
        return discover(learned.views, like, config, generator, objects, self.journal)

    def _learn_orientation(self, views: PartialViews, made: Discovery, seed: Tensor) -> None:
        """Where the network learns what stands as its object does."""
        if self.config.discovery.standing:
            super()._learn_orientation(views, made, seed)

    def _trusted(
        self, found: Candidates, cloud: Tensor, labels: Labels, generator: torch.Generator
    ) -> tuple[Candidates, Float[Tensor, " B"]]:
        """The clouds that stand as their objects do, if these are asked (`standing`)."""
        if self.config.stand != "objects":
            return super()._trusted(found, cloud, labels, generator)
        known = [] if labels.instance is None else rows_by_object(labels.instance)
        if why := self._not_asked(known):
            logger.warning("how objects stand is not asked: %s", why)
            return super()._trusted(found, cloud, labels, generator)
        if self._frames is None:
            self._frames = self._frames_of(cloud, known, generator)
        said = self._turns_of(cloud, self._frames)
        frames, ways = how_objects_stand(self._frames, self.orientation, said)
        if not frames:
            logger.warning("how objects stand is not known: of none one way leads the others")
            return super()._trusted(found, cloud, labels, generator)
        agrees = agreeing(found, frames, ways)[1]
        row, wanted = against(agrees, frames, ways)
        logger.info(
            "%d of %d objects are told; %.0f %% of the clouds stand as they do; "
            "%d more are asked whether they may",
            len(frames), len(known), 100 * agrees.float().mean(), len(row),
        )  # fmt: skip
        if len(row):
            other = self._turned(cloud[row], wanted, generator)
            found = exchanged(found, row, other)
        found, agrees = agreeing(found, frames, ways)
        return found, agrees.to(found.gap)

    def _not_asked(self, known: list[Int[Tensor, " V"]]) -> str:
        """Why the objects of these clouds are not asked how they stand; empty: they are."""
        if self.category.symmetry is not None:
            return "its parts look alike"
        if not bool(self.orientation.learned):
            return "nothing tells how views stand"
        return "" if len(known) >= LEAST_OBJECTS else "which clouds show the same is not known"

    def _frames_of(
        self, cloud: Tensor, known: list[Int[Tensor, " V"]], generator: torch.Generator
    ) -> list[ObjectFrame]:
        """Of each object, from registrations of its views with one another."""
        rotations = self.config.discovery.rotations
        jobs = [partial(frame_of, row, self._of_one_size(cloud[row]), rotations) for row in known]
        frames, makers = list[ObjectFrame](), {x.__name__: x for x in (ObjectFrame, PartialViews)}
        for k, make in enumerate(self.journal.ahead(jobs)):
            left = FRAME * (len(jobs) - k)
            self.journal.tell(f"object {k} of {len(jobs)}", k / len(jobs), left)
            frames.append(self.journal.once(f"frame of object {k}", make, generator, makers))
        return frames

    def _turns_of(
        self, cloud: Tensor, frames: list[ObjectFrame]
    ) -> list[Float[Tensor, "V 3 3"]] | None:
        """view_R_template of the views of each frame, by the network; None: it has not learned."""
        if not (isinstance(self.network, ViewNetwork) and bool(self.network.learned)):
            return None
        jobs = [partial(self._of_view, Observation(points=cloud[one.row])) for one in frames]
        return [make()[0].rotation for make in self.journal.ahead(jobs)]

    def _turned(
        self, cloud: Tensor, wanted: Float[Tensor, "B 3 3"], generator: torch.Generator
    ) -> Candidates:
        """Candidates of clouds in which the template is turned as wanted."""
        pairs = zip(cloud.split(TURNED), wanted.split(TURNED), strict=True)
        jobs = [partial(self._some_turned, *pair) for pair in pairs]
        found, makers = list[Candidates](), {x.__name__: x for x in (Candidates, Placement)}
        for k, make in enumerate(self.journal.ahead(jobs)):
            left = PLACING * TURNED * (len(jobs) - k)
            self.journal.tell("placing clouds as objects stand", k / len(jobs), left)
            found.append(self.journal.once(f"turned clouds, {k}", make, generator, makers))
        return cat(found)

    def _some_turned(
        self, cloud: Float[Tensor, "B N 3"], wanted: Float[Tensor, "B 3 3"]
    ) -> Candidates:
        seen, space = self._seen(Observation(points=cloud)), self._space()
        number = self.config.quick_hypotheses
        start = space.rendered.turned(seen.views, seen.frame @ wanted, number)
        left = successive_halving(self.template, seen.views, start, space, BRIEF)
        return candidates(self.template, seen, left, self._limits().wider(CHARGED))

    def _of_one_size(self, cloud: Float[Tensor, "B N 3"]) -> PartialViews:
        """Clouds of one object, normalised all alike: it is as large in all of them."""
        similarity, views, _ = self._observed(cloud)
        return views.scaled(similarity.scale.median() / similarity.scale)


def load_run(name: str | Path, category: Category) -> TemplateRegistration:
    """The trained model of a `registered` run folder or checkpoint file, or a released one's.

    Raises:
        StoreError: None there, of another method, or of another category.
    """
    path = find(name)
    arrays, header = read_checkpoint(path)
    kind = header_category(check_header(header, str(path)), str(path))
    if header["method"] != TemplateRegistration.name or kind != category:
        raise StoreError(
            f"{path}: expected a run of {TemplateRegistration.name} on {category.name}, "
            f"found one of {header['method']} on {kind.name}"
        )
    config = config_from(RegisteredConfig, header["config"], f"{path}: config")
    method = TemplateRegistration(config, kind, torch.Generator())
    load_arrays(method, arrays, path)
    return method.eval()
