# SPDX-License-Identifier: MIT
"""What is known of one observed object: a plain frozen record, from which files are written.

Camera frame (x right, y down, z forward), or that of the input (`Twin.frame`); metres and radians
throughout. `N` observed points, `M` points of the model's shape, `P` parts, `J` joints; joint j
moves part `category.joints[j].child`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8

from scapo.categories import Category

BACKGROUND = 255
"""Part of observed points that belong to none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """The model's surface of the object, placed as observed: also what the camera did not see."""

    points: Float[np.ndarray, "M 3"]
    normals: Float[np.ndarray, "M 3"]
    """Unit, outwards."""
    part: Int[np.ndarray, " M"]
    """Never `BACKGROUND`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """One observed object: its points by part, how its parts lie, and how its joints move them."""

    name: str
    """Of the input, without folder and suffix."""
    category: Category
    points: Float[np.ndarray, "N 3"]
    """As observed, finite."""
    frame: Literal["camera", "input"] = "camera"
    """input: all is in another frame than the camera's, in which the points came."""
    part: Int[np.ndarray, " N"]
    """Index into `category.parts`, or `BACKGROUND`."""
    color: UInt8[np.ndarray, "N 3"] | None = None
    camera_T_part: Float[np.ndarray, "P 4 4"]
    """Rigid. All parts share the base's frame at state 0, so that moving joint j by d moves its
    part on from here by a turn of d about the axis through the pivot, or by a slide of d along."""
    pivot: Float[np.ndarray, "J 3"]
    """A point on the axis, near the part."""
    axis: Float[np.ndarray, "J 3"]
    """Unit; right-hand rule."""
    state: Float[np.ndarray, " J"]
    """rad or m, as observed; the zero and the sense are the model's own unless it was given true
    ones, so only differences mean anything."""
    limits: Float[np.ndarray, "J 2"]
    """Lower, upper in the state's units and from its zero; lower <= state <= upper, lower < upper.
    """
    shape: Shape | None = None
    """None: the method has no template."""
    part_confidence: Float[np.ndarray, " P"] | None = None
    """Probability in [0, 1] that the part's rotation is within 10 degrees; None: not calibrated."""
    joint_confidence: Float[np.ndarray, " J"] | None = None
    """Probability in [0, 1] that the axis' direction is within 5 degrees; None: not calibrated."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """What the confidences were made of, by name: residual, margin, agreement."""
    model: Mapping[str, str] = field(default_factory=dict)
    """Method, name and digest of the model, by name."""
    warnings: tuple[str, ...] = ()
    """One line each."""
