# SPDX-License-Identifier: MIT
"""The data that flows through the project: plain frozen records, no logic.

Shapes use `*B` for any batch shape, `N` points, `P` parts, `J` joints. Frames are named at each
field; `a_T_b` maps coordinates in frame b to frame a. Metres and radians throughout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float, Int
from torch import Tensor

Supervision = Literal["pose", "segmentation", "joint", "instance"]
"""Kinds of ground truth that a method may be given, each a field of `Labels`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Joints:
    """Joint parameters, in the frame that the owner names."""

    pivot: Float[Tensor, "*B J 3"]
    """Metres, a point on the axis."""
    axis: Float[Tensor, "*B J 3"]
    """Unit vector, right-hand rule."""
    state: Float[Tensor, "*B J"]
    """rad or m, child minus parent, 0 at rest and >= 0 towards open; NaN where a data set does
    not know it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """All that a method may see at test time."""

    points: Float[Tensor, "*B N 3"]
    """Camera frame, metres."""
    color: Float[Tensor, "*B N 3"] | None = None
    """In [0, 1]."""
    sensor: Float[Tensor, "*B 3"] | None = None
    """Centre of the camera, for clouds in another frame; None: the origin, as in its own."""
    up: Float[Tensor, "*B 3"] | None = None
    """Against gravity, unit length, in the frame of the points; None: not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Labels:
    """Ground truth; None = withheld."""

    part: Int[Tensor, "*B N"] | None = None
    """Part index, -1 = background or unlabelled (255 on disk)."""
    camera_T_part: Float[Tensor, "*B P 4 4"] | None = None
    joints: Joints | None = None
    """Camera frame."""
    instance: Int[Tensor, "*B"] | None = None
    """Which object each cloud shows, as numbered in its data set."""

    def keep(self, supervision: frozenset[Supervision]) -> Labels:
        """The labels that a method with this supervision may see; all else is None."""
        return Labels(
            part=self.part if "segmentation" in supervision else None,
            camera_T_part=self.camera_T_part if "pose" in supervision else None,
            joints=self.joints if "joint" in supervision else None,
            instance=self.instance if "instance" in supervision else None,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FullyLabelled:
    """Clouds with all of their labels, camera frame."""

    points: Float[Tensor, "*B N 3"]
    part: Int[Tensor, "*B N"]
    camera_T_part: Float[Tensor, "*B P 4 4"]
    joints: Joints
    instance: Int[Tensor, "*B"]

    @classmethod
    def of(cls, observation: Observation, labels: Labels, who: str) -> FullyLabelled:
        """Of a method or tool `who` that needs all.

        Raises:
            ValueError: Some are withheld.
        """
        part, pose = labels.part, labels.camera_T_part
        joints, instance = labels.joints, labels.instance
        if part is None or pose is None or joints is None or instance is None:
            raise ValueError(
                f"{who}: expected parts, poses, joints and objects, found some withheld"
            )
        return cls(
            points=observation.points,
            part=part,
            camera_T_part=pose,
            joints=joints,
            instance=instance,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleKey:
    """Which sample this is: unique within a data set."""

    category: str
    split: str
    index: int
    instance: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One view of one object in one state."""

    key: SampleKey
    observation: Observation
    labels: Labels
    visible: Float[Tensor, " P"]
    """Share of each part's surface seen in this view."""
    camera: Float[Tensor, " 6"]
    """fx, fy, cx, cy, width, height in pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """What a method says of a cloud.

    Part frames are the method's own, unless it saw true poses or an `Alignment` was applied.
    """

    part_weight: Float[Tensor, "*B N P"]
    """Rows on the simplex; a hard segmentation is one-hot."""
    camera_T_part: Float[Tensor, "*B P 4 4"] | None = None
    joints: Joints | None = None
    """Camera frame."""
    canonical_points: Float[Tensor, "*B M 3"] | None = None
    """The object in the method's canonical frame and state, metres."""
    canonical_normals: Float[Tensor, "*B M 3"] | None = None
    """Of `canonical_points`, unit, outwards."""
    canonical_part: Int[Tensor, "*B M"] | None = None
    """Of `canonical_points`: `camera_T_part` of its part takes a point to where it is observed."""
    joint_limits: Float[Tensor, "*B J 2"] | None = None
    """Lowest and highest state that the method knows of, as `joints.state`."""
    confidence: Float[Tensor, "*B"] | None = None
    misfit: Float[Tensor, "*B"] | None = None
    """What the answer leaves unexplained, in the method's own measure: of two to clouds that are
    each other's mirror image the lower is better."""
    record: Mapping[str, Tensor] | None = None
    """Network-side quantities that a published evaluator needs, by its names, batch first."""
