# SPDX-License-Identifier: MIT
"""How far two answers for the same cloud differ.

Numpy, camera frame, metres; answers are the tensors of a predictions file. No truth enters. The
place of a joint axis is its point nearest to the cloud's centroid: where along the axis a method
puts its pivot says nothing of the joint.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from bench.matching import rotation_degrees
from bench.metrics import line_degrees, unit
from bench.ordering import hard_labels
from bench.scores import Errors, Rows, label_of


def centroid_and_unit(
    points: Float[np.ndarray, "B N 3"],
) -> tuple[Float[np.ndarray, "B 3"], Float[np.ndarray, " B"]]:
    """Centroid of each cloud and the length of one `r4`, 4 x its mean radius."""
    wide = points.astype(np.float64)
    centre = wide.mean(1)
    return centre, 4 * np.linalg.norm(wide - centre[:, None], axis=-1).mean(1)


def moved(rows: Rows, motion: Float[np.ndarray, "B 4 4"]) -> Rows:
    """The answers as they are after the camera frame's points x became motion x."""
    turn, shift = motion[:, None, :3, :3], motion[:, None, :3, 3]
    out = dict(rows)
    if "camera_T_part" in rows:
        out["camera_T_part"] = motion[:, None] @ rows["camera_T_part"]
    if "joint_pivot" in rows:
        out["joint_pivot"] = (turn @ rows["joint_pivot"][..., None])[..., 0] + shift
    if "joint_axis" in rows:
        out["joint_axis"] = (turn @ rows["joint_axis"][..., None])[..., 0]
    return out


def axis_places(rows: Rows, centre: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B J 3"]:
    """The point of each joint axis nearest to `centre`."""
    pivot, axis = (
        rows["joint_pivot"].astype(np.float64),
        unit(rows["joint_axis"].astype(np.float64)),
    )
    return pivot + axis * ((centre[:, None] - pivot) * axis).sum(-1, keepdims=True)


def changes(
    first: Rows, second: Rows, points: Float[np.ndarray, "B N 3"], revolute: np.ndarray
) -> Errors:
    """Differences of two answers for the same clouds, per sample and slot.

    Args:
        first: Answers.
        second: Others, in the same frame.
        points: The clouds, for the unit `r4` and the place of the axes.
        revolute: (J,) bool.

    Returns:
        `base_rotation`, `part_rotation` (moving parts), `part_translation`, `axis` (of lines,
        at most 90 degrees), `pivot` (place of the axis), `state` and `labels` (share of the
        points); only what both answers hold.
    """
    centre, length = centroid_and_unit(points)
    label, there = hard_labels(label_of(first)), hard_labels(label_of(second))
    out: Errors = {("labels", "1"): (label != there).mean(1, keepdims=True)}
    if "camera_T_part" in first and "camera_T_part" in second:
        pose, there = (r["camera_T_part"].astype(np.float64) for r in (first, second))
        turn = rotation_degrees(pose[..., :3, :3], there[..., :3, :3])
        away = np.linalg.norm(pose[..., :3, 3] - there[..., :3, 3], axis=-1)
        out["base_rotation", "deg"], out["part_rotation", "deg"] = turn[:, :1], turn[:, 1:]
        out["part_translation", "r4"] = away / length[:, None]
    if all("joint_axis" in r and "joint_pivot" in r for r in (first, second)):
        axis, other = (unit(r["joint_axis"].astype(np.float64)) for r in (first, second))
        out["axis", "deg"] = line_degrees(axis, other)
        apart = axis_places(first, centre) - axis_places(second, centre)
        distance = np.linalg.norm(apart, axis=-1)
        out["pivot", "m"], out["pivot", "r4"] = distance, distance / length[:, None]
        if "joint_state" in first and "joint_state" in second:
            out |= _states(first, second, revolute, length)
    return out


def _states(
    first: Rows, second: Rows, revolute: np.ndarray, length: Float[np.ndarray, " B"]
) -> Errors:
    """An axis that points the other way turns the other way."""
    sign = np.where((first["joint_axis"] * second["joint_axis"]).sum(-1) < 0, -1.0, 1.0)
    change = first["joint_state"] - sign * second["joint_state"]
    around = np.degrees(np.abs((change + np.pi) % (2 * np.pi) - np.pi))
    out: Errors = {}
    if revolute.any():
        out["state", "deg"] = np.where(revolute, around, np.nan)
    if not revolute.all():
        out["state", "r4"] = np.where(revolute, np.nan, np.abs(change)) / length[:, None]
    return out
