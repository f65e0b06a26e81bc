# SPDX-License-Identifier: MIT
"""What a method believes the category to be: its template with parts and joints, opening.

First the template of a trained method and how its joints move it, then the picture of that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from safetensors import safe_open

from bench.analysis.answered import Answered
from bench.figures.drawing import (
    PALETTE,
    draw_line,
    draw_points,
    look,
    part_legend,
    plain,
    save,
    window,
)
from scapo.alignment import Alignment
from scapo.categories import Category
from scapo.geometry import rigid as geometry
from scapo.geometry.matrices import moved
from scapo.method import AbstractMethod
from scapo.types import Joints, Prediction

if TYPE_CHECKING:
    from scapo.paper.method import Scapo
    from scapo.registered.method import AbstractRegistered


@dataclass(frozen=True, slots=True, kw_only=True)
class TemplateShape:
    """In the frame of the predicted base pose; lengths in 4 x mean radius."""

    points: Float[np.ndarray, "M 3"]
    weight: Float[np.ndarray, "M P"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    normals: Float[np.ndarray, "M 3"] | None = None
    """Unit, where the method has them."""


def template_shape(method: AbstractMethod) -> TemplateShape | None:
    """The template at the states that the method calls 0; None for a method without one."""
    from scapo.paper.method import Scapo
    from scapo.registered.method import AbstractRegistered

    with torch.no_grad():
        if isinstance(method, AbstractRegistered):
            return _registered(method)
        if isinstance(method, Scapo):
            return _scapo(method)
    return None


def _registered(method: AbstractRegistered) -> TemplateShape:
    from scapo.registered.template import Placement

    template = method.template
    origin, none = template.part_centres()[0], torch.zeros_like(template.points[:1])
    at_rest = Placement.at(torch.eye(3).to(none)[None], none, template.rest[None])
    points, normals = template.place(at_rest)
    return TemplateShape(
        points=_plain(points[0] - origin),
        weight=_plain(template.logit.softmax(-1)),
        pivot=_plain(template.pivot - origin),
        axis=_plain(template.directions()),
        normals=_plain(normals[0]),
    )


def _scapo(method: Scapo) -> TemplateShape:
    """Y_base without residual; its joints as the joint network sees them."""
    points, keypoints = method.template.points[None], method.template.keypoints[None]
    _, joints = method.joint_network.pair(points, points)
    return TemplateShape(
        points=_plain(points[0]),
        weight=_plain(method.bones.weights(points, keypoints)[0]),
        pivot=_plain(joints.pivot[0]),
        axis=_plain(torch.nn.functional.normalize(joints.axis[0], dim=-1)),
    )


def _plain(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().numpy().astype(np.float64)


def carried(shape: TemplateShape, pose: Float[np.ndarray, "4 4"]) -> TemplateShape:
    """The shape in another frame, `pose` mapping its own there."""
    turn, shift = pose[:3, :3], pose[:3, 3]
    return replace(
        shape,
        points=shape.points @ turn.T + shift,
        pivot=shape.pivot @ turn.T + shift,
        axis=shape.axis @ turn.T,
        normals=None if shape.normals is None else shape.normals @ turn.T,
    )


def aligned_shape(shape: TemplateShape, alignment: Alignment, category: Category) -> TemplateShape:
    """The shape by the category's conventions: at rest, in the object's frame, parts in order."""
    place = torch.eye(4, dtype=torch.float64).expand(shape.weight.shape[1], 4, 4)
    joints = Joints(
        pivot=torch.from_numpy(shape.pivot),
        axis=torch.from_numpy(shape.axis),
        state=torch.zeros(len(shape.pivot), dtype=torch.float64),
    )
    said = Prediction(
        part_weight=torch.from_numpy(shape.weight),
        camera_T_part=place,
        joints=joints,
        canonical_points=torch.from_numpy(shape.points),
        canonical_normals=None if shape.normals is None else torch.from_numpy(shape.normals),
        canonical_part=torch.from_numpy(shape.weight.argmax(-1)),
    )
    found = alignment.apply(said, torch.ones((), dtype=torch.float64), category)
    pose, own = cast("Any", found.camera_T_part)[0], cast("Any", found.joints)
    turn, normals = pose[:3, :3], found.canonical_normals
    return TemplateShape(
        points=_plain(cast("Any", found.canonical_points)),
        weight=_plain(found.part_weight),
        pivot=_plain((own.pivot - pose[:3, 3]) @ turn),
        axis=_plain(own.axis @ turn),
        normals=None if normals is None else _plain(normals),
    )


def at_states(
    shape: TemplateShape, state: Float[np.ndarray, " J"], revolute: np.ndarray
) -> TemplateShape:
    """The shape with its joints moved: rad, or 4 x mean radius; parts blended by weight."""
    points, normals = shape.weight[:, :1] * shape.points, None
    if shape.normals is not None:
        normals = shape.weight[:, :1] * shape.normals
    for joint, turns in enumerate(revolute):
        motion = geometry.joint_motion(
            torch.from_numpy(shape.pivot[joint].copy()),
            torch.from_numpy(shape.axis[joint].copy()),
            torch.tensor(float(state[joint]), dtype=torch.float64),
            "revolute" if turns else "prismatic",
        ).numpy()
        share = shape.weight[:, joint + 1 : joint + 2]
        points = points + share * moved(shape.points, motion)
        if normals is not None and shape.normals is not None:
            normals = normals + share * (shape.normals @ motion[:3, :3].T)
    return replace(shape, points=points, normals=normals)


VIEWS = ((35.0, 28.0), (90.0, 0.0))
STATES = {"nearly closed": 0.05, "half open": 0.5, "wide open": 0.95}
"""Quantiles of the predicted states."""
LIGHT = np.array([0.35, -0.75, -0.56])
"""Towards the light, camera frame: from above right, behind the viewer."""


def template_picture(
    answered: Answered, shape: TemplateShape, predictions: Path, out: Path
) -> None:
    """Columns: three states; rows: from the front above and from the side.

    The frame is the true one where the predictions were calibrated, else the method's own.

    Args:
        answered: Predictions beside the truth.
        shape: By the conventions of the predictions.
        predictions: Their file.
        out: PNG.
    """
    offsets = answered.fitted.frames.offsets
    if offsets is not None and np.isfinite(offsets[0]).all():
        shape = carried(shape, np.linalg.inv(offsets[0]))
    states, shown = state_steps(answered, predictions)
    turns = answered.fitted.frames.revolute
    posed = [at_states(shape, state, turns) for state in states]
    every = np.concatenate([item.points for item in posed])
    low, high = np.quantile(every, [0.003, 0.997], axis=0)
    middle, half = (low + high) / 2, 0.68 * float((high - low).max())
    figure = Figure(figsize=(2.9 * len(posed), 6.0), dpi=200)
    grid = figure.subplots(len(VIEWS), len(posed), squeeze=False)
    for line, angles in zip(grid, VIEWS, strict=True):
        camera = look(*angles)
        camera[:3, 3] -= camera[:3, :3] @ middle
        for axes, item in zip(line, posed, strict=True):
            _panel(axes, item, camera, half)
    for axes, name, value in zip(grid[0], STATES, shown, strict=True):
        axes.set_title(f"{name}: {_state_text(value, turns)}", fontsize=9, pad=2)
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.05, top=0.9, wspace=0, hspace=0)
    words = f"{answered.header.method} {answered.header.variant}".strip()
    title = f"{words}: the template of {answered.header.category}"
    figure.suptitle(plain(title), fontsize=10, y=0.985)
    part_legend(figure, answered.split.manifest.parts, 0.025)
    save(figure, out)


def state_steps(
    answered: Answered, predictions: Path
) -> tuple[list[Float[np.ndarray, " J"]], list[Float[np.ndarray, " J"]]]:
    """The method's own states at three quantiles, from closed to open, and as the truth counts.

    Own lengths are in 4 x mean radius, shown ones in metres for a cloud of median size. A joint
    that most samples see open towards negative states is reversed.
    """
    with safe_open(predictions, "numpy") as file:
        own = file.get_tensor("joint_state").astype(np.float64)
    frames, size = answered.fitted.frames, float(np.median(answered.scale))
    turns = frames.revolute
    unit = np.where(turns, 1.0, answered.scale[:, None])
    own, true = own / unit, answered.mine.state / unit
    steps = np.zeros((len(STATES), own.shape[1]))
    shown = np.zeros_like(steps)
    for joint in range(own.shape[1]):
        known = np.isfinite(own[:, joint]) & np.isfinite(true[:, joint])
        offset = 0.0 if frames.state_offset is None else frames.state_offset[joint]
        agree = np.abs(own[known, joint] + offset - true[known, joint]) < 1e-6
        sign = 1.0 if agree.mean() >= 0.5 else -1.0
        values = np.quantile(sign * own[known, joint], list(STATES.values()))
        steps[:, joint] = sign * values
        shown[:, joint] = (values + offset) * (1.0 if turns[joint] else size)
    return list(steps), list(shown)


def _state_text(value: Float[np.ndarray, " J"], revolute: np.ndarray) -> str:
    texts = [
        f"{np.degrees(v):.0f}°" if turns else f"{100 * v:.0f} cm"
        for v, turns in zip(value, revolute, strict=True)
    ]
    return ", ".join(texts)


def _panel(axes: Axes, shape: TemplateShape, camera: np.ndarray, half: float) -> None:
    points, turn = moved(shape.points, camera), camera[:3, :3]
    color = shape.weight @ PALETTE[: shape.weight.shape[1]]
    if shape.normals is not None:
        length = np.maximum(np.linalg.norm(shape.normals, axis=1, keepdims=True), 1e-9)
        lit = np.abs((shape.normals / length) @ turn.T @ (LIGHT / np.linalg.norm(LIGHT)))
        color = color * (0.62 + 0.38 * lit[:, None])
    draw_points(axes, points, color, size=9)
    reach = 0.55 * half
    for pivot, axis in zip(shape.pivot, shape.axis, strict=True):
        place = pivot + axis * ((shape.points.mean(0) - pivot) @ axis)
        draw_line(axes, moved(place, camera), axis @ turn.T, reach=reach)
    window(axes, half)
