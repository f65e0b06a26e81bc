# SPDX-License-Identifier: MIT
"""From a method's own part frames, order of parts and states to those of the category.

A self-supervised method cannot know which part is called the door, which way is up, at what state
a door is closed and which way it opens. Labelled clouds tell, after training: one order of the
parts, one rigid offset for each part's frame, one sense and one zero for each joint. A checkpoint
keeps them in its header; no weight depends on them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from scapo.categories import Category
from scapo.geometry.matrices import rotation_error
from scapo.geometry.part_order import joint_order
from scapo.geometry.points import ends
from scapo.types import Joints, Prediction

RIGID = 1e-3
"""Largest deviation of an offset from a rigid motion."""
STANDS = 0.98
"""Cosine with up from which an axis stands: 11 degrees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledClouds:
    """What an alignment was fitted on."""

    split: str
    data_digest: str
    """Of the split's manifest."""
    samples: int
    mode: str = ""
    """Of prediction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """What turns a method's own conventions into the category's; lengths in 4 x mean radius."""

    order: tuple[int, ...]
    """The part that each of the method's slots is."""
    own_T_part: tuple[tuple[tuple[float, ...], ...], ...]
    """Of each part in the category's order, 4x4 rigid: own pose @ own_T_part = camera_T_part."""
    sign: tuple[float, ...]
    """+1 or -1 for each joint of the category: by what axis and state are multiplied."""
    zero: tuple[float, ...]
    """Added to the state after that: rad, or units."""
    origin: tuple[float, float, float] | None = None
    """Of the object's frame, from the middle of the box of each answer's own shape at rest; None:
    where the offsets alone have it, which do not know an object's shape."""
    clouds: LabelledClouds

    def __post_init__(self) -> None:
        """Refuse what is no alignment.

        Raises:
            ValueError: Naming the field.
        """
        parts, offsets = len(self.order), np.array(self.own_T_part, np.float64)
        if sorted(self.order) != list(range(parts)):
            raise ValueError(f"order: expected every part once, found {self.order}")
        if offsets.shape != (parts, 4, 4) or not np.isfinite(offsets).all():
            raise ValueError(f"own_T_part: expected {parts} finite 4x4 matrices, found others")
        last = np.abs(offsets[:, 3] - [0, 0, 0, 1]).max()
        if max(rotation_error(offsets[:, :3, :3]).max(), last) > RIGID:
            raise ValueError("own_T_part: expected rigid motions, found others")
        numbers = (len(self.sign), len(self.zero))
        if numbers != (parts - 1, parts - 1) or {abs(s) for s in self.sign} - {1.0}:
            raise ValueError(
                f"sign, zero: expected {parts - 1} of each, signs 1 or -1, found {numbers}"
            )
        if self.origin is not None and not np.isfinite(self.origin).all():
            raise ValueError(f"origin: expected finite numbers, found {self.origin}")

    @staticmethod
    def of_order(order: tuple[int, ...], clouds: LabelledClouds) -> Alignment:
        """Parts and joints in another order, everything else as the method has it."""
        joints = len(order) - 1
        eye = tuple(map(tuple, np.eye(4).tolist()))
        return Alignment(
            order=order,
            own_T_part=(eye,) * len(order),
            sign=(1.0,) * joints,
            zero=(0.0,) * joints,
            clouds=clouds,
        )

    @property
    def numbers(self) -> int:
        """How many were fitted; signs and the order are none."""
        return 6 * len(self.order) + len(self.zero) + len(self.origin or ())

    def up(self, axes: Float[Tensor, "J 3"] | None = None) -> tuple[float, ...] | None:
        """Which way is up (z) in the method's own frame of its first part, if no state tilts that.

        Args:
            axes: Of its joints, in that frame. Where the first part is not the base but what the
                only joint moves, that joint has to stand.
        """
        first = self.order[0]
        up = tuple(row[2] for row in self.own_T_part[first][:3])
        if first == 0:
            return up
        if axes is None or len(axes) > 1:
            return None
        return up if abs(float(axes[0] @ axes.new_tensor(up))) > STANDS else None

    def apply(self, found: Prediction, unit: Float[Tensor, "*B"], category: Category) -> Prediction:
        """The prediction by the category's conventions.

        `record` stays: it is for evaluators that know the method's own conventions. A canonical
        shape moves part by part to the object at rest; one whose parts nobody knows is left out.

        Args:
            found: By the method's own.
            unit: `unit_length` of each cloud, metres.
            category: Of the objects.
        """
        slot = np.argsort(self.order)  # of each part
        pose = found.camera_T_part
        if pose is not None:
            pose = pose[..., slot, :, :] @ self._offsets(unit, pose)
        moved = replace(
            found,
            part_weight=found.part_weight[..., slot],
            camera_T_part=pose,
            **self._shape(found, unit),
        )
        moved = self._centred(moved, unit)
        if found.joints is None:
            return moved
        return self._with_joints(moved, found.joints, unit, category)

    def _with_joints(
        self, moved: Prediction, joints: Joints, unit: Float[Tensor, "*B"], category: Category
    ) -> Prediction:
        """With the joints and their limits by the category's conventions.

        Where the child of the only joint is the category's base, the joint moves the other way.
        """
        index = np.argsort(joint_order(np.array([self.order]))[0])
        like = {"dtype": joints.axis.dtype, "device": joints.axis.device}
        sign, zero = torch.tensor(self.sign, **like), torch.tensor(self.zero, **like)
        turned = -sign if self.order[0] != 0 else sign
        slides = torch.tensor([spec.kind == "prismatic" for spec in category.joints])
        zero = torch.where(slides.to(zero.device), zero * unit[..., None].to(zero), zero)
        limits = moved.joint_limits
        if limits is not None:
            ends = turned[:, None] * limits[..., index, :] + zero[..., None]
            limits = torch.sort(ends, dim=-1).values
        own = Joints(
            pivot=joints.pivot[..., index, :],
            axis=sign[:, None] * joints.axis[..., index, :],
            state=turned * joints.state[..., index] + zero,
        )
        return replace(moved, joints=own, joint_limits=limits)

    def _centred(self, moved: Prediction, unit: Float[Tensor, "*B"]) -> Prediction:
        """With frames about the middle of the shape's box, if that is where the origin is."""
        pose, shape = moved.camera_T_part, moved.canonical_points
        if self.origin is None or pose is None or shape is None:
            return moved
        aside = torch.tensor(self.origin).to(shape) * unit.to(shape)[..., None]
        origin = middle_of_box(shape) + aside
        pose = pose.clone()  # of parts, whose frames are one at rest
        pose[..., :3, 3] += (pose[..., :3, :3] @ origin[..., None, :, None].to(pose))[..., 0]
        shape = shape - origin[..., None, :]
        return replace(moved, camera_T_part=pose, canonical_points=shape)

    def _offsets(self, unit: Float[Tensor, "*B"], like: Tensor) -> Float[Tensor, "*B P 4 4"]:
        """`own_T_part` in metres."""
        offset = torch.tensor(self.own_T_part, dtype=like.dtype, device=like.device)
        offset = offset.repeat(*unit.shape, 1, 1, 1)
        offset[..., :3, 3] *= unit.to(like)[..., None, None]
        return offset

    def _shape(self, found: Prediction, unit: Float[Tensor, "*B"]) -> dict[str, Tensor | None]:
        """The fields of the canonical shape, at rest in the object's frame."""
        points, normals, slot = (
            found.canonical_points,
            found.canonical_normals,
            found.canonical_part,
        )
        if points is None or slot is None:
            return dict.fromkeys(("canonical_points", "canonical_normals", "canonical_part"))
        part = torch.tensor(self.order, device=slot.device)[slot]
        inverse = torch.linalg.inv(self._offsets(unit, points))
        own = torch.take_along_dim(inverse, part[..., None, None], dim=-3)  # (*B, M, 4, 4)
        turn = own[..., :3, :3]
        return {
            "canonical_points": (turn @ points[..., None])[..., 0] + own[..., :3, 3],
            "canonical_normals": None if normals is None else (turn @ normals[..., None])[..., 0],
            "canonical_part": part,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectFrame(LabelledClouds):
    """The labelled clouds by which answers without pose labels came into the object's frame."""

    order: tuple[int, ...] = ()
    """The part that each of the method's slots became, for `record_*`; empty: as they were."""

    @staticmethod
    def of(alignment: Alignment | None) -> ObjectFrame | None:
        """Of predictions to which an alignment was applied, if any."""
        if alignment is None:
            return None
        return ObjectFrame(**asdict(alignment.clouds), order=alignment.order)


def middle_of_box(points: Float[Tensor, "*B M 3"]) -> Float[Tensor, "*B 3"]:
    """Of the box of a shape, single points left out."""
    return ends(points, -2).mean(0)


def unit_length(points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B"]:
    """4 x the mean distance of a cloud's points from their centroid, metres."""
    return 4 * (points - points.mean(-2, keepdim=True)).norm(dim=-1).mean(-1)
