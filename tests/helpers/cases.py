# SPDX-License-Identifier: MIT
"""Random truth and prediction for the metrics."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.helpers import made

KEYS = ("iou", "joint_direction", "joint_pivot", "part_rotation", "part_translation")


def random_case(seed, batch=5, parts=2, points=40) -> dict[str, Any]:
    """Random truth and an unrelated random prediction."""
    generator = np.random.default_rng(seed)

    def poses():
        out = np.tile(np.eye(4), (batch, parts, 1, 1))
        flat = made.rotations(generator, batch * parts)
        out[..., :3, :3] = flat.reshape(batch, parts, 3, 3)
        out[..., :3, 3] = generator.normal(size=(batch, parts, 3))
        return out

    part = generator.integers(0, parts, size=(batch, points))
    noisy = np.where(generator.random(part.shape) < 0.2,
                     generator.integers(0, parts, size=part.shape), part)  # fmt: skip
    return {
        "part_true": part,
        "camera_T_part_true": poses(),
        "pivot_true": generator.normal(size=(batch, parts - 1, 3)),
        "axis_true": generator.normal(size=(batch, parts - 1, 3)),
        "part_pred": noisy,
        "camera_T_part_pred": poses(),
        "pivot_pred": generator.normal(size=(batch, parts - 1, 3)),
        "axis_pred": generator.normal(size=(batch, parts - 1, 3)),
    }
