# SPDX-License-Identifier: MIT
"""Poses and joints of an object that hang together: children are the base moved by its joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from scapo.categories import Category
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
