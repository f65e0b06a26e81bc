# SPDX-License-Identifier: MIT
"""Models of a box with a flap that need no training: one that is told, one that can be stored."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from bench.infer.calibration import Calibration
from bench.infer.model import Model
from scapo.categories import CATEGORIES, Category
from scapo.geometry.points import Similarity
from scapo.geometry.rigid import joint_motion, rigid
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import AbstractMethod, Mode, Stage, Step
from scapo.predictor import Predictor
from scapo.records import take
from scapo.registered.config import DiscoveryConfig, RegisteredConfig
from scapo.registered.decode import nearest_weights, placed_prediction
from scapo.registered.method import TemplateRegistration
from scapo.registered.template import turn_placement
from scapo.registered.view_bank import ShownPoints
from scapo.registered.views import surface_normals
from scapo.store import Split
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, write_checkpoint
from scapo.store.samples import UNLABELLED
from scapo.types import Labels, Observation, Prediction
from tests.helpers.made import sample_arrays, write_split
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator

CONFIG = RegisteredConfig(points=96, width=8, discovery=DiscoveryConfig(final_points=400))


class Told(AbstractMethod):
    """Answers clouds of `sighted` with their true placements, some turned as asked.

    A cloud is known by its centre, so that other draws of its points are known too.
    """

    name: ClassVar[str] = "told"
    supervision = frozenset()
    config = None

    def __init__(self, count: int, seed: int = 61, wrong: dict[int, float] | None = None) -> None:
        """Clouds of that seed; `wrong` gives answers turned by so many radians."""
        super().__init__()
        self.category: Category = CATEGORIES["oven"]
        self.views, self.truth = sighted(count, seed=seed)
        self.template = template()
        self.wrong = wrong or {}

    def clouds(self) -> np.ndarray:
        """(B, N, 3), the camera at the origin."""
        return (self.views.points - self.views.camera[:, None]).numpy()

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        centres = -self.views.camera
        row = torch.cdist(observation.points.mean(1), centres).argmin(1)
        placement = take(self.truth, row)
        turn = torch.tensor([[0, 0, self.wrong.get(int(r), 0.0)] for r in row])
        placement = turn_placement(placement, rotvec_to_rotmat(turn))
        similarity = Similarity(scale=torch.ones(len(row)), centre=centres[row])
        points, camera = similarity.forward(observation.points), self.views.camera[row]
        normals = surface_normals(points, points, camera)
        weight = nearest_weights(self.template, points, normals, placement)
        sure = torch.tensor([0.1 if int(r) in self.wrong else 0.9 for r in row])
        rest, origin = torch.zeros_like(placement.state), self.template.part_centres()[0]
        plain = placed_prediction(self.template, placement, rest, origin, weight, similarity)
        return replace(plain, confidence=sure)

    @property
    def variant(self) -> str:
        return ""

    def stages(self) -> tuple[Stage, ...]:
        return ()

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        raise NotImplementedError

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        raise NotImplementedError


def told_model(method: Told, calibration: Calibration | None = None) -> Model:
    return Model(
        name="told",
        predictor=Predictor(method, "cpu"),
        category=method.category,
        method="told",
        digest="0" * 64,
        calibration=calibration,
    )


@cache
def placed(category: str = "oven") -> TemplateRegistration:
    """A registered model with the true template and placements, its network untaught."""
    views, truth = sighted(12, seed=60)
    cloud = views.points - views.camera[:, None]
    method = TemplateRegistration(CONFIG, CATEGORIES[category], generator(0))
    method.template.load_state_dict(template().state_dict())
    camera = (truth.rotation.mT @ (views.camera - truth.translation)[..., None])[..., 0]
    method.pseudo.set(cloud[:, 0], truth, camera, torch.ones(12))
    method.pseudo.show(ShownPoints.of(views))
    method.pseudo.belonging = torch.ones(cloud.shape[:2], dtype=torch.bool)
    return method.eval()


def placed_run(
    folder: Path, category: str = "oven", supervision: tuple[Literal["instance"], ...] = ()
) -> Path:
    """A run folder with that model."""
    config = replace(CONFIG, supervision=supervision)
    header = checkpoint_header("registered", config, category, {"seed": 1, "steps": 0})
    write_checkpoint(folder / WEIGHTS, placed(category), header)
    return folder


def told_split(told: Told, folder: Path, split: str, *, labelled: bool = True) -> Split:
    """The clouds that `told` knows with their truth, as a split of ovens."""
    count = len(told.clouds())
    arrays = sample_arrays("oven", count, told.clouds().shape[1], instances=6)
    shift = told.truth.translation - told.views.camera
    base = rigid(told.truth.rotation, shift)
    pivot = (told.truth.rotation @ told.template.pivot[0, :, None])[..., 0] + shift
    axis = (told.truth.rotation @ told.template.directions()[0, :, None])[..., 0]
    state = told.truth.state[:, 0]
    lid = joint_motion(pivot, axis, state, "revolute") @ base
    found = Told.predict(told, Observation(points=torch.as_tensor(told.clouds())))
    truth = {
        "points": told.clouds(), "camera_T_part": np.stack([base.numpy(), lid.detach().numpy()], 1),
        "joint_pivot": pivot[:, None].detach().numpy(), "joint_state": state[:, None].numpy(),
        "joint_axis": axis[:, None].detach().numpy(),
        "part": found.part_weight.argmax(-1).numpy().astype(np.uint8),
    }  # fmt: skip
    arrays |= {k: v.astype(arrays[k].dtype) for k, v in truth.items()}
    if not labelled:
        arrays["part"][:] = UNLABELLED
    return write_split(folder, "oven", split, arrays)
