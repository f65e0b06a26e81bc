# SPDX-License-Identifier: MIT
"""From a method's own part frames, order of parts and states to those of the category.

A self-supervised method cannot know which part is called the door, which way is up, at what state
a door is closed and which way it opens. Labelled clouds tell (`scapo-bench calibrate`): one order
of the parts, one rigid offset of the base's frame, one sense and one zero for each joint.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from scapo.categories import Category
from scapo.geometry.part_order import joint_order
from scapo.geometry.rigid import joint_motion


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parts:
    """Poses and joints of one object, camera frame, metres and radians."""

    camera_T_part: Float[np.ndarray, "P 4 4"]
    """The base's frame, carried on by each joint."""
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    state: Float[np.ndarray, " J"]
    limits: Float[np.ndarray, "J 2"] | None

    @staticmethod
    def of(
        category: Category,
        *,
        camera_T_base: Float[np.ndarray, "4 4"],
        pivot: Float[np.ndarray, "J 3"],
        axis: Float[np.ndarray, "J 3"],
        state: Float[np.ndarray, " J"],
        limits: Float[np.ndarray, "J 2"] | None,
    ) -> Parts:
        """The poses that follow from the base's and the joints."""
        poses = [camera_T_base]
        for j, spec in enumerate(category.joints):
            motion = joint_motion(
                torch.as_tensor(pivot[j]), torch.as_tensor(axis[j]), torch.as_tensor(state[j]),
                spec.kind,
            )  # fmt: skip
            poses.append(motion.numpy() @ camera_T_base)
        return Parts(
            camera_T_part=np.stack(poses), pivot=pivot, axis=axis, state=state, limits=limits
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """What turns a method's own conventions into the category's."""

    order: tuple[int, ...]
    """The part that each of the method's slots is."""
    base: tuple[tuple[float, ...], ...]
    """own_T_object of the base, 4x4 rigid; translation in units of 4 x mean radius."""
    sign: tuple[float, ...]
    """+1 or -1 for each joint: by what axis and state are multiplied."""
    zero: tuple[float, ...]
    """Added to the state after that: rad, or units of 4 x mean radius."""

    @staticmethod
    def none(category: Category) -> Alignment:
        """Everything as the method has it."""
        joints = len(category.joints)
        return Alignment(
            order=tuple(range(len(category.parts))),
            base=tuple(map(tuple, np.eye(4).tolist())),
            sign=(1.0,) * joints,
            zero=(0.0,) * joints,
        )

    def relabel(self, slot: Int[np.ndarray, " K"]) -> Int[np.ndarray, " K"]:
        """Parts from slots."""
        return np.asarray(self.order)[slot]


def reordered(parts: Parts, order: tuple[int, ...], category: Category) -> Parts:
    """Parts and joints in the category's order.

    Where the child of the only joint is the base, what was the base moves the other way.
    """
    if order == tuple(range(len(order))):
        return parts
    joints = joint_order(np.array([order]))[0]
    index = np.argsort(joints)
    turned = -1.0 if order[0] != 0 else 1.0
    limits = parts.limits
    if limits is not None:
        limits = np.sort(turned * limits[index], axis=-1)
    return Parts.of(
        category,
        camera_T_base=parts.camera_T_part[order.index(0)],
        pivot=parts.pivot[index],
        axis=parts.axis[index],
        state=turned * parts.state[index],
        limits=limits,
    )


def aligned(parts: Parts, alignment: Alignment, unit: float, category: Category) -> Parts:
    """The parts by the category's conventions.

    Args:
        parts: By the method's own.
        alignment: Of the method.
        unit: 4 x mean radius of the cloud, metres.
        category: Of the object.
    """
    own = reordered(parts, alignment.order, category)
    base = np.array(alignment.base, np.float64)
    base[:3, 3] *= unit
    slides = np.array([spec.kind == "prismatic" for spec in category.joints])
    sign, zero = np.array(alignment.sign), np.array(alignment.zero)
    zero = np.where(slides, zero * unit, zero)
    limits = own.limits
    if limits is not None:
        limits = np.sort(sign[:, None] * limits, axis=-1) + zero[:, None]
    moved = replace(own, axis=sign[:, None] * own.axis, state=sign * own.state + zero)
    return Parts.of(
        category,
        camera_T_base=own.camera_T_part[0] @ base,
        pivot=moved.pivot,
        axis=moved.axis,
        state=moved.state,
        limits=limits,
    )
