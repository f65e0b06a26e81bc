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
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.categories import Category
from scapo.geometry.points import Similarity
from scapo.method import changes
from scapo.registered.base import FIRST, LATE, AbstractRegistered, LearnedClouds
from scapo.registered.config import PRESETS, UNNAMED, RegisteredConfig
from scapo.registered.course import plan_of
from scapo.registered.decode import placed_prediction
from scapo.registered.discovery import Discovery, discover
from scapo.registered.objects import ObjectViews, grouped
from scapo.registered.template import Placement
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
from scapo.types import Labels, Observation, Prediction, Supervision

logger = logging.getLogger(__name__)


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
        sizes = [(one.config.camera, one.config.channels) for one in (known, self)]
        if sizes[0] == sizes[1]:
            self.network.load_state_dict(known.network.state_dict())
        self._place(observation.points, generator, LATE)

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
