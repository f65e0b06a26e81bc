# SPDX-License-Identifier: MIT
"""The presets of `--preset`: camera, joint states and views of our benchmark and of published data.

`sim-art` and those named after it are the parts of the benchmark (docs/benchmark.md).
`op-align` and `eap` have the articulation windows and view grids of the published data generators
(docs/protocol.md). What those leave open is decided here and said at the place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import radians
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from scapo.geometry.camera import Intrinsics
from sim_assets.options import PresetName, Protocol, Sampling

Order = Literal["yxz", "zyx"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleSequence:
    """Published joint angles of samples k = 0 .. 99, start + step * k, as states of ours."""

    start: float
    """Degrees."""
    step: float
    zero: float = 0.0
    """Opening in degrees at theta = 0; a reading of ours, as the models' zero is not described."""

    def degrees(self) -> Float[np.ndarray, " 100"]:
        """As published."""
        return self.start + self.step * np.arange(100)


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleGrid:
    """Published angles of two joints on a grid: step * floor(k / 10) and step * (k mod 10)."""

    train: float
    """Step in degrees."""
    test: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewGrid:
    """Three angles, each uniform on a grid, turned about the axes in this order of factors."""

    order: Order
    start: float
    """Degrees."""
    step: float
    count: int = 100

    def degrees(self) -> Float[np.ndarray, " K"]:
        """The angles."""
        return self.start + self.step * np.arange(self.count)


@dataclass(frozen=True, slots=True, kw_only=True)
class Published:
    """Joint states and views of a published data generator."""

    full: dict[str, AngleSequence | AngleGrid]
    """Of complete clouds, by category; joints of other categories move as in `sim-art`."""
    partial: dict[str, AngleSequence | AngleGrid]
    """Of partial clouds."""
    views: dict[str, ViewGrid]
    """Of partial clouds, by category."""
    other_views: ViewGrid
    """Of other categories."""
    full_views: ViewGrid | None
    """Of complete clouds; None: uniform over all rotations."""
    least: tuple[int, ...]
    """Of 1,024 points, those that parts 0, 1, ... need in a partial cloud."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """Camera, protocol, and where joint states and views come from."""

    camera: Intrinsics
    protocol: Protocol = "joint"
    sampling: Sampling = "random"
    distance: bool = False
    """The camera's distance is drawn, not the object's size in the image."""
    paired: bool = False
    """Whole surfaces in the states and places of the views that `sim-art` keeps: each sample is
    that of `sim-art` with the same number, turned by a rotation uniform over all."""
    published: Published | None = None
    """None: states and views of the category (`scapo.categories`)."""


NEAR, FAR = (0.5, 0.9), (1.0, 1.6)
"""Distance from the camera to the object's origin in `sim-art-sensor`, m: of objects whose bounding
box at rest has a diagonal of up to LARGE, and of larger ones (docs/benchmark.md)."""
LARGE = 0.6
PUBLISHED_DISTANCE = 1.8
"""From the camera to the object's origin in diagonals of the object at rest, to which the published
generators scale it (docs/protocol.md)."""

_EYEGLASSES = AngleGrid(train=18 * 0.45, test=18 * 0.35)
_WIDE = ViewGrid(order="yxz", start=-90.0, step=1.8)
_NARROW = ViewGrid(order="zyx", start=-22.5, step=0.45)
_LAPTOP_ZERO, _SAFE_ZERO = 90.0, 45.0

OP_ALIGN = Published(
    full={
        "laptop": AngleSequence(start=-45, step=0.9, zero=_LAPTOP_ZERO),
        "safe": AngleSequence(start=-45, step=0.9, zero=_SAFE_ZERO),
        "eyeglasses": _EYEGLASSES,
        "oven": AngleSequence(start=45, step=0.8),
        "washer": AngleSequence(start=45, step=0.9),
    },
    partial={
        "laptop": AngleSequence(start=-45, step=0.75, zero=_LAPTOP_ZERO),
        "safe": AngleSequence(start=-45, step=0.75, zero=_SAFE_ZERO),
        "eyeglasses": _EYEGLASSES,
        "oven": AngleSequence(start=45, step=0.7),
        "washer": AngleSequence(start=60, step=0.6),
    },
    views={"laptop": _NARROW, "safe": _NARROW},
    other_views=_WIDE,
    full_views=ViewGrid(order="zyx", start=-90.0, step=1.8),
    least=(151, 51),
)
"""Laptop and safe from HOI4D, the others from Shape2Motion."""

EAP = Published(
    full={**OP_ALIGN.full, "laptop": AngleSequence(start=9, step=-0.9, zero=_LAPTOP_ZERO)},
    partial={**OP_ALIGN.partial, "laptop": AngleSequence(start=9, step=-0.9, zero=_LAPTOP_ZERO)},
    views={},
    other_views=_NARROW,
    full_views=None,
    least=(),
)
"""Laptop from Shape2Motion. EAP's view windows, narrower than OP-Align's and different for each
category, were never published: the narrow one of the HOI4D models stands for them."""

_PUBLISHED_CAMERA = Intrinsics.from_fov(radians(60), 640, 480)
PRESETS: dict[PresetName, Preset] = {
    "sim-art": Preset(camera=Intrinsics.from_fov(radians(60), 256, 256)),
    "sim-art-sensor": Preset(
        camera=Intrinsics(fx=600, fy=600, cx=320, cy=240, width=640, height=480), distance=True
    ),
    "sim-art-complete": Preset(
        camera=Intrinsics.from_fov(radians(60), 256, 256), protocol="full", paired=True
    ),
    "op-align": Preset(
        camera=_PUBLISHED_CAMERA, protocol="isolated", sampling="fps", published=OP_ALIGN
    ),
    "eap": Preset(camera=_PUBLISHED_CAMERA, protocol="isolated", sampling="fps", published=EAP),
}


def find_preset(name: str) -> Preset:
    """The preset of this name.

    Raises:
        ValueError: There is none.
    """
    if name not in get_args(PresetName):
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, found {name!r}")
    return next(value for key, value in PRESETS.items() if key == name)


def camera(name: str, image_size: int | None) -> Intrinsics:
    """The preset's camera, or one of its vertical field of view with a square image."""
    made = find_preset(name).camera
    if image_size is None:
        return made
    return Intrinsics.from_fov(2 * np.arctan(made.height / 2 / made.fy), image_size, image_size)


def least_points(name: str, protocol: Protocol, parts: int, points: int) -> tuple[int, ...]:
    """Points that a preset's published redraw rule asks of each part, for clouds of `points`.

    OP-Align draws a sample again that has 50 points or fewer of label 1, or 150 or fewer of label
    0. Zero for parts without a rule.
    """
    published = find_preset(name).published
    if published is None or protocol == "full":
        return (0,) * parts
    asked = [*published.least, *[0] * parts][:parts]
    return tuple(-(-least * points // 1024) for least in asked)


@cache
def windows(
    name: PresetName, category: str, protocol: Protocol
) -> tuple[AngleSequence | AngleGrid | None, ViewGrid | None]:
    """Articulation window (None: the category's travel) and view grid (None: all rotations)."""
    published = find_preset(name).published
    if published is None:
        raise ValueError(f"preset: expected a published one, found {name!r}")
    if protocol == "full":
        return published.full.get(category), published.full_views
    return published.partial.get(category), published.views.get(category, published.other_views)
