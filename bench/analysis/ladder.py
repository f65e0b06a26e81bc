# SPDX-License-Identifier: MIT
"""The oracle ladder: what a prediction would score with one of its pieces replaced by the truth.

A prediction is taken apart into the pose of its base, its joints relative to that base, its states
and its labels, and put together again: camera_T_child = motion(joint, state) @ camera_T_base. Each
rung exchanges one piece and keeps the others, so the fall of an error names what limits it:

- `predicted`: the file as it is. `recomposed`: taken apart and put together, nothing exchanged.
- `pose`: the true pose of the base; joints and children are carried along with it.
- `parts`: the true labels; the order of the parts then follows from the poses alone.
- `joint`: the true joints relative to the base, placed by the predicted base.
- `state`: the true states, about the predicted joints.
- `all`: everything, which scores 1 and 0 by construction.

Everything is in the order of the predicted slots, calibrated as in `evaluate`. At the end the
ladder as Markdown: every rung, and what each metric is limited by.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int

from bench.matching import apply_calibration, is_swapped, reorder_joints, reorder_poses
from bench.metrics import joint_errors, pose_errors, state_errors, unit
from bench.scoring.scores import Errors, Frames, Rows, Settings, agreement_of, signs
from bench.scoring.truth import Truth
from bench.statistics import Interval
from scapo.geometry import rigid as geometry
from scapo.geometry.part_order import part_orders
from scapo.text import as_markdown

Rung = Literal["predicted", "recomposed", "pose", "parts", "joint", "state", "all"]
RUNGS: tuple[Rung, ...] = get_args(Rung)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pieces:
    """A prediction, or the truth, in predicted slots. Camera frame, metres; NaN = no answer."""

    pose: Float[np.ndarray, "B P 4 4"]
    pivot: Float[np.ndarray, "B J 3"]
    axis: Float[np.ndarray, "B J 3"]
    """Unit, pointing so that `state` is positive towards open."""
    state: Float[np.ndarray, "B J"]
    iou: Float[np.ndarray, "B P"]


def climb(
    truth: Truth,
    rows: Rows,
    *,
    settings: Settings,
    frames: Frames,
    order: Int[np.ndarray, " P"] | None = None,
) -> dict[Rung, Errors]:
    """The errors of some samples on every rung."""
    agreement = agreement_of(truth, rows, settings, order)
    true = true_pieces(truth, agreement.order, frames)
    mine = predicted_pieces(truth, rows, agreement.order, frames)
    mine = replace(mine, iou=agreement.iou)
    errors: dict[Rung, Errors] = {}
    for rung in RUNGS:
        against, pieces = true, exchanged(rung, mine, true, frames)
        if rung == "parts":
            against = _by_pose(truth, mine, agreement.order, frames)
        errors[rung] = _errors(truth, pieces, against, frames, settings)
    return errors


def true_pieces(truth: Truth, order: Int[np.ndarray, "B P"], frames: Frames) -> Pieces:
    """The truth by predicted slot. Where two parts are swapped the joint turns the other way."""
    axis = unit(reorder_joints(truth.joint_axis, order))
    reversed_ = is_swapped(order) & (order.shape[1] == 2)
    return Pieces(
        pose=reorder_poses(truth.camera_T_part, order, frames.symmetry),
        pivot=reorder_joints(truth.joint_pivot, order),
        axis=np.where(reversed_[:, None, None], -axis, axis),
        state=reorder_joints(truth.joint_state, order),
        iou=np.ones(order.shape),
    )


def predicted_pieces(
    truth: Truth, rows: Rows, order: Int[np.ndarray, "B P"], frames: Frames
) -> Pieces:
    """The prediction in the true frames; what the file lacks is NaN."""
    batch, parts = order.shape
    pose = rows.get("camera_T_part", np.full((batch, parts, 4, 4), np.nan)).astype(np.float64)
    if frames.offsets is not None:
        pose = apply_calibration(pose, frames.offsets, scale=truth.scale)
    blank = np.full((batch, parts - 1, 3), np.nan)
    axis = unit(rows.get("joint_axis", blank).astype(np.float64))
    state = rows.get("joint_state", blank[..., 0]).astype(np.float64)
    sign = signs(rows, order, reorder_joints(truth.joint_axis, order))
    scale = np.where(frames.revolute, 1.0, truth.scale[:, None])
    offset = np.zeros(parts - 1) if frames.state_offset is None else frames.state_offset
    return Pieces(
        pose=pose,
        pivot=rows.get("joint_pivot", blank).astype(np.float64),
        axis=axis * sign[..., None],
        state=sign * state + offset * scale,
        iou=np.ones((batch, parts)),
    )


def exchanged(rung: Rung, mine: Pieces, true: Pieces, frames: Frames) -> Pieces:
    """The pieces of one rung, children put together again where that changes them."""
    if rung == "predicted":
        return mine
    if rung == "all":
        return true
    if rung == "parts":
        return replace(mine, iou=true.iou)
    pieces = mine
    if rung == "pose":
        carry = true.pose[:, 0] @ _inverse(mine.pose[:, 0])
        return replace(
            mine,
            pose=carry[:, None] @ mine.pose,
            pivot=_move(carry, mine.pivot),
            axis=_turn(carry, mine.axis),
        )
    if rung == "joint":
        carry = mine.pose[:, 0] @ _inverse(true.pose[:, 0])
        pieces = replace(mine, pivot=_move(carry, true.pivot), axis=_turn(carry, true.axis))
    if rung == "state":
        pieces = replace(mine, state=true.state)
    made = composed(pieces, frames.revolute)
    known = np.isfinite(made).all((2, 3), keepdims=True)
    # Without a joint or state nothing can be put together: an error must not fall out of the mean.
    return replace(pieces, pose=np.where(known, made, mine.pose))


def composed(pieces: Pieces, revolute: np.ndarray) -> Float[np.ndarray, "B P 4 4"]:
    """Base pose and, per joint, the child's pose that joint and state give."""
    base = pieces.pose[:, 0]
    poses = [base]
    for joint, turns in enumerate(revolute):
        motion = geometry.joint_motion(
            torch.from_numpy(pieces.pivot[:, joint]),
            torch.from_numpy(pieces.axis[:, joint]),
            torch.from_numpy(np.ascontiguousarray(pieces.state[:, joint])),
            "revolute" if turns else "prismatic",
        )
        poses.append(motion.numpy() @ base)
    return np.stack(poses, 1)


def _inverse(pose: Float[np.ndarray, "B 4 4"]) -> Float[np.ndarray, "B 4 4"]:
    return geometry.invert(torch.from_numpy(np.ascontiguousarray(pose))).numpy()


def _move(
    motion: Float[np.ndarray, "B 4 4"], points: Float[np.ndarray, "B J 3"]
) -> Float[np.ndarray, "B J 3"]:
    return points @ np.swapaxes(motion[:, :3, :3], 1, 2) + motion[:, None, :3, 3]


def _turn(
    motion: Float[np.ndarray, "B 4 4"], axes: Float[np.ndarray, "B J 3"]
) -> Float[np.ndarray, "B J 3"]:
    return axes @ np.swapaxes(motion[:, :3, :3], 1, 2)


def _by_pose(truth: Truth, mine: Pieces, order: Int[np.ndarray, "B P"], frames: Frames) -> Pieces:
    """The truth in the order with the smallest mean rotation error; as it was without poses."""
    candidates = part_orders(order.shape[1])
    errors = []
    for candidate in candidates:
        poses = true_pieces(truth, np.broadcast_to(candidate, order.shape), frames).pose
        errors.append(pose_errors(poses, mine.pose)[0].mean(1))
    table = np.stack(errors, 1)
    known = np.asarray(np.isfinite(table).all(1))
    best = np.where(known[:, None], candidates[np.nan_to_num(table).argmin(1)], order)
    return true_pieces(truth, best, frames)


def _errors(
    truth: Truth, pieces: Pieces, true: Pieces, frames: Frames, settings: Settings
) -> Errors:
    """The metrics of `scores.score` on pieces."""
    turn, shift = pose_errors(true.pose, pieces.pose, settings.rotation)
    direction, distance = joint_errors(
        true.pivot, true.axis, pieces.pivot, pieces.axis, settings.pivot
    )
    state = state_errors(
        state_true=true.state,
        state_pred=pieces.state,
        revolute=frames.revolute,
        offset=np.zeros((1, pieces.state.shape[1])),
        sign=np.ones_like(pieces.state),
    )
    unit_r4 = truth.scale[:, None]
    out: Errors = {
        ("iou", "1"): pieces.iou,
        ("joint_direction", "deg"): direction,
        ("joint_pivot", "r4"): distance / unit_r4,
        ("part_rotation", "deg"): turn,
        ("part_translation", "r4"): shift / unit_r4,
    }
    if frames.revolute.any():
        out["joint_state", "deg"] = np.where(frames.revolute, np.degrees(state), np.nan)
    if not frames.revolute.all():
        out["joint_state", "r4"] = np.where(frames.revolute, np.nan, state) / unit_r4
    return out


COLUMNS: dict[tuple[str, str], tuple[str, float, int]] = {
    ("iou", "1"): ("S, %", 100.0, 1),
    ("joint_direction", "deg"): ("D, deg", 1.0, 1),
    ("joint_pivot", "r4"): ("C", 1.0, 3),
    ("joint_state", "deg"): ("state, deg", 1.0, 1),
    ("joint_state", "r4"): ("state", 1.0, 3),
    ("part_rotation", "deg"): ("R, deg", 1.0, 1),
    ("part_translation", "r4"): ("t", 1.0, 3),
}
"""Metric -> heading, factor, decimals; lengths in 4 x mean radius."""
MEANINGS: dict[Rung, str] = {
    "predicted": "as predicted",
    "recomposed": "child poses from base, joint and state",
    "pose": "**true base pose**",
    "parts": "**true parts**",
    "joint": "**true joint** on the base",
    "state": "**true state**",
    "all": "all of them",
}
PIECES: tuple[Rung, ...] = ("pose", "parts", "joint", "state")
GAIN = 0.2
"""Share of a metric's error that a piece must cure to be named."""

Values = Mapping[Rung, Mapping[tuple[str, str], Interval]]
Medians = Mapping[Rung, Mapping[tuple[str, str], float]]


def ladder_markdown(ladder: Values, medians: Medians, title: str, facts: Mapping[str, str]) -> str:
    """A table `mean / median` per rung, the interval of the first, and a line per metric."""
    keys = [key for key in COLUMNS if key in ladder["predicted"]]
    lines = [
        f"### {as_markdown(title)}: one piece replaced by the truth",
        "",
        "Mean / median over samples and slots; lengths C, t in units of 4 x mean radius.",
        "",
        _row(["", *(COLUMNS[key][0] for key in keys)]),
        _row(["---", *("---:" for _ in keys)]),
    ]
    for rung, values in ladder.items():
        cells = [f"{_text(key, values[key].mean)} / {_text(key, medians[rung][key])}"
                 for key in keys]  # fmt: skip
        lines.append(_row([MEANINGS[rung], *cells]))
        if rung == "predicted":
            lines.append(_row(["95 % interval of the mean",
                               *(_interval(key, values[key]) for key in keys)]))  # fmt: skip
    lines += ["", "What limits each metric:", "", *limits(ladder), ""]
    lines += [f"{name}: {value}  " for name, value in facts.items() if value]
    return "\n".join(lines).rstrip() + "\n"


def limits(ladder: Values) -> list[str]:
    """For each metric the pieces whose truth cures at least a fifth of its error, best first."""
    out = []
    for key, (heading, _, _) in COLUMNS.items():
        if key not in ladder["predicted"] or not ladder["predicted"][key].count:
            continue
        start = _error(key, ladder["predicted"][key].mean)
        named: list[str] = []
        for rung in sorted(PIECES, key=lambda rung: _error(key, ladder[rung][key].mean)):
            after = ladder[rung][key].mean
            cured = 1 - _error(key, after) / start if start > 0 else 0.0
            if cured >= GAIN:
                named.append(f"{rung} ({_text(key, after)}, cures {100 * cured:.0f} %)")
        first = f"- {heading.partition(',')[0]} {_text(key, ladder['predicted'][key].mean)}: "
        out.append(first + (", ".join(named) or "no single piece cures a fifth of it"))
    return out


def _error(key: tuple[str, str], value: float) -> float:
    return 1 - value if key[0] == "iou" else value


def _text(key: tuple[str, str], value: float) -> str:
    _, factor, decimals = COLUMNS[key]
    return "–" if value != value else f"{factor * value:.{decimals}f}"


def _interval(key: tuple[str, str], value: Interval) -> str:
    return f"{_text(key, value.low)} to {_text(key, value.high)}" if value.count else "–"


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
