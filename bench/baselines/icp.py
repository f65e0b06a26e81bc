# SPDX-License-Identifier: MIT
"""ICP against a few labelled training shapes: the classical baseline (docs/protocol.md).

Two ways, because the paper's row mixes what one cannot give. As it stands, the whole cloud is
registered to whole templates, copies the labels of the nearest template points, and each part
settles from there: no label is used at test time. With the oracle (`predict --oracle
segmentation`) the cloud is cut into its TRUE parts, as in the published baseline, and each is
registered on its own; that row is named oracle-segmentation and its S is 100 by construction.
Lengths are in units of the whole cloud's mean radius, so sizes of instances do not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import small_gicp
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from scapo.categories import Category
from scapo.geometry.points import MEAN_RADIUS, normalise
from scapo.method import Mode, OracleMethod, Stage, Step
from scapo.types import Labels, Observation, Prediction, Supervision

Points = Float[np.ndarray, "N 3"]
Pose = Float[np.ndarray, "4 4"]

FEWEST = 8
"""Points of a part that can be registered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpConfig:
    """Defaults as EAP's appendix: 5 training shapes, 60 initial rotations."""

    templates: int = 5
    """Training shapes, drawn at random from different instances as far as there are."""
    starts: int = 12
    """Of the 5 x 60 initial poses, those with the least residual are refined."""
    points: int = 128
    """Of the cloud or part, that are registered."""
    reach: float = 0.4
    """Correspondences farther apart than this times the mean radius do not count."""
    iterations: int = 30


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """The best registration: template_T_cloud and its residual."""

    template: int
    pose: Pose
    residual: float
    """Root mean square distance to the template, each at most the reach."""

    def move(self, points: Points) -> Points:
        """Into the template's frame."""
        return points @ self.pose[:3, :3].T + self.pose[:3, 3]


class Target:
    """One template, whole or a part, ready to be registered to."""

    def __init__(self, number: int, points: Points) -> None:
        """Build its search trees; `number` is the template's."""
        self.number = number
        self.centre = points.mean(0)
        self.cloud = small_gicp.PointCloud(points)
        self.tree = small_gicp.KdTree(self.cloud)
        self.nearest = KDTree(points)

    def squares(self, points: Float[np.ndarray, "*B 3"], reach: float) -> Float[np.ndarray, "*B"]:
        """Squared distance of each point, that of the reach at most."""
        return np.minimum(self.nearest.query(points)[0], reach) ** 2


class Icp(OracleMethod):
    """ICP: no parameters, only the labelled training shapes that `start` keeps."""

    name: ClassVar[str] = "icp"
    template_points: Tensor
    template_part: Tensor
    template_pose: Tensor

    def __init__(self, config: IcpConfig, category: Category, generator: torch.Generator) -> None:
        """Nothing is drawn before `start`."""
        super().__init__()
        del generator
        self.config = config
        self.category = category
        self.supervision: frozenset[Supervision] = frozenset({"segmentation", "pose"})
        self.oracle: frozenset[Supervision] = frozenset({"segmentation"})
        count, parts = config.templates, len(category.parts)
        self.register_buffer("template_points", torch.zeros(count, 0, 3))
        self.register_buffer("template_part", torch.zeros(count, 0, dtype=torch.long))
        self.register_buffer("template_pose", torch.eye(4).repeat(count, parts, 1, 1))
        self.register_load_state_dict_pre_hook(_take_any_size)
        self.rotations = Rotation.create_group("I").as_matrix()  # the icosahedron's 60

    @property
    def variant(self) -> str:
        """There is one."""
        return ""

    def stages(self) -> tuple[Stage, ...]:
        """Nothing to optimise."""
        return ()

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Keep random training shapes with their labels and part poses, normalised.

        Raises:
            ValueError: Fewer training clouds than templates, or labels are missing.
        """
        del stage
        number, count = observation.points.shape[0], self.config.templates
        if number < count or labels.part is None or labels.camera_T_part is None:
            raise ValueError(f"icp: expected at least {count} labelled clouds, found {number}")
        chosen = torch.randperm(number, generator=generator, device=generator.device)[:count]
        points, similarity = normalise(observation.points[chosen])
        pose = labels.camera_T_part[chosen].clone()
        pose[..., :3, 3] = similarity.forward(pose[..., :3, 3])
        self.template_points, self.template_pose = points, pose
        self.template_part = labels.part[chosen]

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
            raise ValueError("icp: expected true parts, found none")
        return self._predict(observation, labels.part.cpu().numpy())

    def _predict(
        self, observation: Observation, given: Int[np.ndarray, "B N"] | None
    ) -> Prediction:
        points, similarity = normalise(observation.points.cpu())
        whole, parts = self._targets()
        segmentation, poses = [], []
        for number, cloud in enumerate(points.double().numpy()):
            match = self._register(cloud, whole)
            part = self._copy_labels(cloud, match)
            if given is not None:
                part = np.where(given[number] < 0, part, given[number])
            segmentation.append(part)
            poses.append(self._part_poses(cloud, part, parts, match, search=given is not None))
        weight = torch.nn.functional.one_hot(
            torch.from_numpy(np.stack(segmentation)), len(self.category.parts)
        )
        pose = torch.from_numpy(np.stack(poses)).to(points.dtype)
        return Prediction(
            part_weight=weight.to(points.dtype), camera_T_part=similarity.inverse_pose(pose)
        )

    def _targets(self) -> tuple[list[Target], list[list[Target]]]:
        """Whole templates, and for each part those of its templates that show it."""
        points = self.template_points.cpu().double().numpy()
        part = self.template_part.cpu().numpy()
        whole = [Target(number, cloud) for number, cloud in enumerate(points)]
        seen = [
            [
                Target(number, cloud[label == p])
                for number, (cloud, label) in enumerate(zip(points, part, strict=True))
                if (label == p).sum() >= FEWEST
            ]
            for p in range(len(self.category.parts))
        ]
        return whole, seen

    def _copy_labels(self, cloud: Points, match: Match) -> Int[np.ndarray, " N"]:
        """Labels of the nearest points of the best template, background excluded."""
        label = self.template_part[match.template].cpu().numpy()
        template = self.template_points[match.template].cpu().double().numpy()
        known = label >= 0
        index = KDTree(template[known]).query(match.move(cloud))[1]
        return label[known][index]

    def _part_poses(
        self,
        cloud: Points,
        part: Int[np.ndarray, " N"],
        targets: list[list[Target]],
        match: Match,
        *,
        search: bool,
    ) -> Float[np.ndarray, "P 4 4"]:
        """Poses of all parts in the normalised cloud.

        With `search` each part is registered from all rotations to all templates, as published;
        without, to the whole's template from the whole's pose. A part that is not seen keeps
        the whole's pose.
        """
        poses = []
        for p, candidates in enumerate(targets):
            points, best = cloud[part == p], match
            own = [target for target in candidates if target.number == match.template]
            if len(points) >= FEWEST and search and candidates:
                best = self._register(points, candidates)
            elif len(points) >= FEWEST and own:
                best = self._settle(
                    thin(points, self.config.points), own[0], match.pose, exact=True
                )
            template = self.template_pose[best.template, p].cpu().double().numpy()
            poses.append(np.linalg.inv(best.pose) @ template)
        return np.stack(poses)

    def _register(self, points: Points, targets: list[Target]) -> Match:
        """Every target from every rotation about the centroid; the most promising are refined."""
        config, reach = self.config, self.config.reach * MEAN_RADIUS
        points = thin(points, config.points)
        few = thin(points - points.mean(0), config.points // 2)
        turned = few @ self.rotations.transpose(0, 2, 1)  # (60, n, 3)
        costs = [target.squares(turned + target.centre, reach).mean(1) for target in targets]
        order = np.argsort(np.concatenate(costs), kind="stable")[: config.starts]
        found = []
        for which, k in zip(*np.divmod(order, len(turned)), strict=True):
            first = np.eye(4)
            first[:3, :3] = self.rotations[k]
            first[:3, 3] = targets[which].centre - self.rotations[k] @ points.mean(0)
            found.append(self._settle(points, targets[which], first))
        best = min(found, key=lambda match: match.residual)
        target = next(target for target in targets if target.number == best.template)
        return self._settle(points, target, best.pose, exact=True)

    def _settle(self, points: Points, target: Target, first: Pose, *, exact: bool = False) -> Match:
        """Point-to-point ICP from `first`, to steps ten times smaller where it must be `exact`."""
        reach = self.config.reach * MEAN_RADIUS
        result = small_gicp.align(
            target.cloud,
            small_gicp.PointCloud(points),
            target.tree,
            first,
            registration_type="ICP",
            max_correspondence_distance=reach,
            max_iterations=self.config.iterations * (5 if exact else 1),
            rotation_epsilon=math.radians(0.01 if exact else 0.1),
            translation_epsilon=1e-4 if exact else 1e-3,
        )
        match = Match(template=target.number, pose=result.T_target_source, residual=np.inf)
        residual = float(np.sqrt(target.squares(match.move(points), reach).mean()))
        return replace(match, residual=residual)


def thin(points: Points, count: int) -> Float[np.ndarray, "K 3"]:
    """At least `count` of the points, evenly taken from their order; all where there are fewer."""
    return points[:: max(1, len(points) // count)]


def _take_any_size(module: Icp, state: dict[str, Tensor], prefix: str, *rest: Any) -> None:  # noqa: ANN401
    """Before loading: make room for templates of as many points as the file has."""
    del rest
    for name in ("template_points", "template_part", "template_pose"):
        if prefix + name in state:
            setattr(module, name, torch.zeros_like(state[prefix + name]))
