# SPDX-License-Identifier: MIT
"""Rigid registration to fused templates: what the classical baselines share.

Two ways, because the paper's row mixes what one cannot give (docs/protocol.md). As it stands, the
whole cloud is registered to whole templates, copies the labels of the nearest template points, and
each part settles from there: no label is used at test time. With the oracle (`predict --oracle
segmentation`) the cloud is cut into its TRUE parts, as in the published baseline, and each is
registered on its own; that row is named oracle-segmentation and its S is 100 by construction.
A joint follows from the two part poses: the template's known joint, carried along by the base; its
state is the motion of the part against the base.
Lengths are in units of the whole cloud's mean radius, so sizes of instances do not matter.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import small_gicp
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from bench.baselines.answers import states
from bench.baselines.templates import LEAST_POINTS, NAMES, FusionConfig, Templates, fuse
from scapo.categories import Category
from scapo.geometry.points import MEAN_RADIUS, Similarity, normalise
from scapo.geometry.rigid import invert
from scapo.method import Mode, OracleMethod, Stage, Step, changes
from scapo.ranges import Positive
from scapo.types import Joints, Labels, Observation, Prediction, Supervision

Points = Float[np.ndarray, "N 3"]
Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig(FusionConfig):
    """What every way to find first poses shares."""

    points: int = 128
    """Points of the cloud or part that are registered."""
    reach: Positive = 0.4
    """Correspondences farther apart than this times the mean radius do not count."""
    iterations: int = 30
    """Steps of ICP from each first pose, at most."""


class Target:
    """One template, whole at a state or a part of it, ready to be registered to."""

    def __init__(self, template: int, state: int, points: Points) -> None:
        """Build its search trees; a part has state 0."""
        self.template, self.state = template, state
        self.points = points
        self.centre = points.mean(0)
        self.cloud = small_gicp.PointCloud(points)
        self.tree = small_gicp.KdTree(self.cloud)
        self.nearest = KDTree(points)

    def squares(self, points: Float[np.ndarray, "*B 3"], reach: float) -> Float[np.ndarray, "*B"]:
        """Squared distance of each point, that of the reach at most."""
        return np.minimum(self.nearest.query(points)[0], reach) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """A registration: target_T_cloud and its residual."""

    target: Target
    pose: Pose
    residual: float
    """Root mean square distance to the target, each at most the reach."""

    def move(self, points: Points) -> Points:
        """Into the target's frame."""
        return points @ self.pose[:3, :3].T + self.pose[:3, 3]


First = tuple[Target, Pose]
"""A target, and target_T_cloud from which ICP goes on."""


class AbstractRegistration(OracleMethod):
    """No parameters, only the templates that `start` keeps; how first poses are found is open."""

    template_points: Tensor

    def __init__(
        self, config: RegistrationConfig, category: Category, generator: torch.Generator
    ) -> None:
        """Nothing is drawn before `start`."""
        super().__init__()
        del generator
        self.config, self.category = config, category
        self.supervision: frozenset[Supervision] = frozenset(
            {"segmentation", "pose", "joint", "instance"}
        )
        self.oracle: frozenset[Supervision] = frozenset({"segmentation"})
        empty = Templates.empty(len(category.parts))
        for name in NAMES:
            self.register_buffer(f"template_{name}", getattr(empty, name))
        self.register_load_state_dict_pre_hook(_take_any_size)

    @property
    def variant(self) -> str:
        """Options that differ from the default, but for sizes and counts."""
        return " ".join(changes(self.config, type(self.config)()))

    def stages(self) -> tuple[Stage, ...]:
        """Nothing to optimise."""
        return ()

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Fuse templates of random training objects.

        Raises:
            ValueError: As `fuse`.
        """
        del stage
        made = fuse(observation, labels, self.config, generator)
        for name in NAMES:
            setattr(self, f"template_{name}", getattr(made, name))

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """None: there are no stages."""
        del observation, labels, step
        return {}

    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts by the whole registration, each then settled from the whole's pose."""
        del mode
        return self._predict(observation, None)

    def predict_given(self, observation: Observation, labels: Labels) -> Prediction:
        """Part poses from the parts that `labels` cut out, which are also its segmentation.

        Raises:
            ValueError: The labels are withheld.
        """
        if labels.part is None:
            raise ValueError(f"{self.name}: expected true parts, found none")
        return self._predict(observation, labels.part.cpu().numpy())

    @abstractmethod
    def _first_poses(self, points: Points, targets: list[Target]) -> Iterable[First]:
        """From where ICP settles a cloud or part; none where it cannot be told.

        Args:
            points: Normalised by the whole cloud.
            targets: All that it may be registered to.
        """

    def _predict(
        self, observation: Observation, given: Int[np.ndarray, "B N"] | None
    ) -> Prediction:
        points, similarity = normalise(observation.points.cpu())
        templates = self._templates()
        whole, parts = _targets(templates)
        segmentation, poses, bases = [], [], []
        for number, cloud in enumerate(points.double().numpy()):
            match = self._register(cloud, whole) or _at_centre(cloud, whole[0])
            label = _copied_labels(cloud, match, len(parts))
            if given is not None:
                label = np.where(given[number] < 0, label, given[number])
            segmentation.append(label)
            start = _started(match, parts, templates)
            found = self._part_poses(cloud, label, parts, start, search=given is not None)
            poses.append(np.stack([np.linalg.inv(one.pose) for one in found]))
            bases.append(found[0].target.template)
        weight = F.one_hot(torch.from_numpy(np.stack(segmentation)), len(parts))
        pose = torch.from_numpy(np.stack(poses)).to(points.dtype)
        return Prediction(
            part_weight=weight.to(points.dtype),
            camera_T_part=similarity.inverse_pose(pose),
            joints=self._joints(pose, similarity, torch.tensor(bases), templates),
        )

    def _templates(self) -> Templates:
        """On the host."""
        return Templates(**{name: getattr(self, f"template_{name}").cpu() for name in NAMES})

    def _part_poses(
        self,
        cloud: Points,
        part: Int[np.ndarray, " N"],
        targets: list[list[Target]],
        start: list[Match],
        *,
        search: bool,
    ) -> list[Match]:
        """part_T_cloud of all parts.

        With `search` each part is registered to all templates on its own, as published; without,
        and where that finds nothing, to one from its `start`. A part that is not seen keeps it.
        """
        found = []
        for p, (candidates, first) in enumerate(zip(targets, start, strict=True)):
            points = cloud[part == p]
            best = self._register(points, candidates) if search else None
            if best is None and len(points) >= LEAST_POINTS:
                few = thin(points, self.config.points)
                best = self._settled(few, first.target, first.pose, exact=True)
            found.append(best or first)
        return found

    def _joints(
        self,
        pose: Float[Tensor, "B P 4 4"],
        similarity: Similarity,
        base: Int[Tensor, " B"],
        templates: Templates,
    ) -> Joints:
        """The joints of the base's template, where the base is; states from the part poses."""
        turn, move = pose[:, 0, :3, :3], pose[:, 0, :3, 3]
        pivot, axis = templates.pivot[base], templates.axis[base]
        return Joints(
            pivot=similarity.inverse(pivot @ turn.mT + move[:, None]),
            axis=axis @ turn.mT,
            state=states(pose, axis, self.category, similarity.scale),
        )

    def _register(self, points: Points, targets: list[Target]) -> Match | None:
        """The best of the first poses after ICP, which then goes on to the end; None without."""
        if len(points) < LEAST_POINTS:
            return None
        few = thin(points, self.config.points)
        found = [self._settled(few, *first) for first in self._first_poses(points, targets)]
        if not found:
            return None
        best = min(found, key=lambda match: match.residual)
        return self._settled(few, best.target, best.pose, exact=True)

    def _settled(
        self, points: Points, target: Target, first: Pose, *, exact: bool = False
    ) -> Match:
        """ICP from `first`, five times as many and ten times smaller steps if it is `exact`."""
        reach = self.config.reach * MEAN_RADIUS
        iterations = self.config.iterations * (5 if exact else 1)
        pose = aligned(points, target, first, reach=reach, iterations=iterations, exact=exact)
        match = Match(target=target, pose=pose, residual=math.inf)
        residual = float(np.sqrt(target.squares(match.move(points), reach).mean()))
        return replace(match, residual=residual)


def aligned(
    points: Points,
    target: Target,
    first: Pose,
    *,
    reach: float,
    iterations: int,
    exact: bool = False,
) -> Pose:
    """Point-to-point ICP.

    Args:
        points: To register.
        target: To what.
        first: target_T_cloud to begin with.
        reach: Correspondences farther apart do not count, normalised length.
        iterations: Steps, at most.
        exact: End at steps ten times smaller than otherwise.
    """
    result = small_gicp.align(
        target.cloud,
        small_gicp.PointCloud(points),
        target.tree,
        first,
        registration_type="ICP",
        max_correspondence_distance=reach,
        max_iterations=iterations,
        rotation_epsilon=math.radians(0.01 if exact else 0.1),
        translation_epsilon=1e-4 if exact else 1e-3,
    )
    return result.T_target_source


def _targets(templates: Templates) -> tuple[list[Target], list[list[Target]]]:
    """Whole templates at all states, and of each part those of all templates."""
    whole, parts = templates.whole().double().numpy(), templates.points.double().numpy()
    return (
        [Target(t, s, cloud) for t, row in enumerate(whole) for s, cloud in enumerate(row)],
        [[Target(t, 0, cloud) for t, cloud in enumerate(row)] for row in parts.swapaxes(0, 1)],
    )


def _copied_labels(cloud: Points, match: Match, parts: int) -> Int[np.ndarray, " N"]:
    """Labels of the nearest points of the whole template that fits best."""
    index = match.target.nearest.query(match.move(cloud))[1]
    return index // (len(match.target.points) // parts)


def _started(match: Match, parts: list[list[Target]], templates: Templates) -> list[Match]:
    """part_T_cloud of each part of the template that the whole cloud was registered to."""
    t, s = match.target.template, match.target.state
    part_T_base = invert(templates.base_T_part[t, s]).double().numpy()
    return [
        replace(match, target=candidates[t], pose=part_T_base[p] @ match.pose)
        for p, candidates in enumerate(parts)
    ]


def centred(rotation: Float[np.ndarray, "3 3"], points: Points, target: Target) -> Pose:
    """target_T_cloud with that rotation, which puts the one centroid on the other."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = target.centre - rotation @ points.mean(0)
    return pose


def _at_centre(points: Points, target: Target) -> Match:
    """Where nothing better is known."""
    return Match(target=target, pose=centred(np.eye(3), points, target), residual=math.inf)


def thin(points: Points, count: int) -> Float[np.ndarray, "K 3"]:
    """At least `count` of the points, evenly taken from their order; all where there are fewer."""
    return points[:: max(1, len(points) // count)]


def _take_any_size(
    module: AbstractRegistration,
    state: dict[str, Tensor],
    prefix: str,
    *rest: Any,  # noqa: ANN401
) -> None:
    """Before loading: make room for templates as many and as fine as the file has."""
    del rest
    for name in (f"template_{one}" for one in NAMES):
        if prefix + name in state:
            setattr(module, name, torch.zeros_like(state[prefix + name]))
