# SPDX-License-Identifier: MIT
"""ICP against a few labelled training shapes: the classical baseline (docs/protocol.md).

Every template is tried from 60 rotations, the icosahedron's, about the centroid, and the pose of
the smallest residual is kept: the root mean square distance of the points, those beyond the reach
counted at the reach (that of the inliers alone would favour poses with few). See `registration` for
what is made of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bench.baselines.registration import (
    AbstractRegistration,
    First,
    Points,
    RegistrationConfig,
    Target,
    aligned,
    centred,
    thin,
)
from scapo.categories import Category
from scapo.geometry.points import MEAN_RADIUS
from scapo.ranges import Positive


@dataclass(frozen=True, slots=True, kw_only=True)
class IcpConfig(RegistrationConfig):
    """ICP to labelled templates, as EAP's appendix: 5 training shapes, 60 rotations."""

    starts: int = 30
    """Of the 60 initial poses at each template, after a few steps on half of the points, those with
    the least residual go on, so many in all."""
    first_iterations: int = 10
    """Those first steps, at most."""
    first_reach: Positive = 0.8
    """The reach of the first steps: the centroid of a partial view is off the template's."""


class Icp(AbstractRegistration):
    """ICP from a grid of rotations."""

    name: ClassVar[str] = "icp"

    def __init__(self, config: IcpConfig, category: Category, generator: torch.Generator) -> None:
        """Nothing is drawn before `start`."""
        super().__init__(config, category, generator)
        self.rotations = Rotation.create_group("I").as_matrix()  # the icosahedron's 60

    def _first_poses(self, points: Points, targets: list[Target]) -> Iterator[First]:
        """Every target from every rotation about the centroid, the most promising of them."""
        config = self.config
        few = thin(points, config.points // 2)
        tried: list[tuple[float, First]] = []
        for target in targets:
            poses = [
                aligned(
                    few,
                    target,
                    centred(rotation, points, target),
                    reach=config.first_reach * MEAN_RADIUS,
                    iterations=config.first_iterations,
                )
                for rotation in self.rotations
            ]
            moved = np.stack([few @ pose[:3, :3].T + pose[:3, 3] for pose in poses])
            costs = target.squares(moved, config.reach * MEAN_RADIUS).mean(1)
            tried += [(float(c), (target, p)) for c, p in zip(costs, poses, strict=True)]
        for _, first in sorted(tried, key=lambda one: one[0])[: config.starts]:
            yield first
