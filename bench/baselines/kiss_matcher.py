# SPDX-License-Identifier: MIT
"""Global registration by correspondences, then ICP: a classical row beside ICP from a grid.

KISS-Matcher (Lim et al., ICRA 2025, arXiv 2409.15615; github.com/MIT-SPARK/KISS-Matcher, package
`kiss-matcher`, MIT licence): Faster-PFH features matched both ways, outliers pruned by the graph of
distances that agree, the pose solved by graduated non-convexity. It is asked once for every
template and its answers are first poses; what is made of them is in `registration`. A part for
which it has no answer is settled from the whole's pose; a whole cloud stays centroid on centroid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
import small_gicp
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from bench.baselines.registration import (
    AbstractRegistration,
    First,
    Points,
    RegistrationConfig,
    Target,
)
from scapo.categories import Category
from scapo.ranges import Positive

MISSING = "kiss-matcher: expected the package kiss_matcher (pip install kiss-matcher), found none"
NORMAL_RADIUS, FEATURE_RADIUS = 3.0, 5.0
"""Voxels about a point that tell its normal and its feature: the package's defaults."""
AROUND = 3  # Points that a radius must hold, itself included, for a normal or a feature
LEAST_KEYPOINTS = 10
"""Points with features without which nothing is matched; without any the package crashes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KissMatcherConfig(RegistrationConfig):
    """KISS-Matcher to ICP's templates; all of its radii and bounds follow from the voxel."""

    voxel: Positive = 0.03
    """Normalised length (the mean radius is 0.25) that points are thinned to."""


class KissMatcher(AbstractRegistration):
    """First poses from matched features."""

    name: ClassVar[str] = "kiss-matcher"

    def __init__(
        self, config: KissMatcherConfig, category: Category, generator: torch.Generator
    ) -> None:
        """Nothing is drawn before `start`.

        Raises:
            RuntimeError: The package is not installed.
        """
        super().__init__(config, category, generator)
        self.package = _package()

    def _first_poses(self, points: Points, targets: list[Target]) -> Iterator[First]:
        """The pose that matched features tell, for each target that has enough of them."""
        voxel = self.config.voxel
        source = voxels(points, voxel)
        if keypoints(source, voxel) < LEAST_KEYPOINTS:
            return
        for target in targets:
            goal = voxels(target.points, voxel)
            if keypoints(goal, voxel) < LEAST_KEYPOINTS:
                continue
            matcher = self.package.KISSMatcher(
                self.package.KISSMatcherConfig(
                    voxel_size=voxel,
                    use_voxel_sampling=False,
                    normal_r_gain=NORMAL_RADIUS,
                    fpfh_r_gain=FEATURE_RADIUS,
                )
            )
            found = matcher.estimate(list(source), list(goal))
            if found.valid:
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = found.rotation, np.ravel(found.translation)
                yield target, pose


def _package() -> Any:  # noqa: ANN401 - of a package that may not be there
    try:
        return import_module("kiss_matcher")
    except ImportError as error:
        raise RuntimeError(MISSING) from error


def voxels(points: Points, size: float) -> Float[np.ndarray, "K 3"]:
    """The mean of the points in every voxel."""
    return small_gicp.voxelgrid_sampling(points, size).points()[:, :3].astype(np.float32)


def keypoints(points: Float[np.ndarray, "K 3"], voxel: float) -> int:
    """How many points get a feature: those with neighbours enough that have normals."""
    tree = KDTree(points)
    near = tree.query_ball_point(points, NORMAL_RADIUS * voxel, return_length=True)
    told = points[near >= AROUND]
    if not len(told):
        return 0
    around = KDTree(told).query_ball_point(told, FEATURE_RADIUS * voxel, return_length=True)
    return int((around >= AROUND).sum())
