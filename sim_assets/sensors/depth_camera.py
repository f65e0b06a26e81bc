# SPDX-License-Identifier: MIT
"""A rendered picture as a depth sensor and a segmentation would give it.

Depth models: `kinect`, `disparity`. Around them what every sensor does: a scene behind and beside
the object (`clutter`), flying pixels and holes (`surface`), a mask with errors (`mask`). Poses and
joints stay exact, and the part of a pixel is that whose surface the sensor measured there, 255
where it is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from scapo.geometry.camera import Intrinsics
from sim_assets.options import Mask, Noise
from sim_assets.rendering.base import BACKGROUND, Frame
from sim_assets.sensors.clutter import BESIDE, Clutter, put_behind, put_beside
from sim_assets.sensors.disparity import PUBLISHED as DISPARITY
from sim_assets.sensors.disparity import Disparity, disparity_at
from sim_assets.sensors.kinect import PUBLISHED as KINECT
from sim_assets.sensors.kinect import Kinect, kinect_at
from sim_assets.sensors.mask import CHOSEN as MASK
from sim_assets.sensors.mask import MaskErrors, wrong_mask
from sim_assets.sensors.surface import CHOSEN as EDGES
from sim_assets.sensors.surface import EdgeEffects, flying_pixels, holes, surface

Depth = Float[np.ndarray, "H W"]
Parts = UInt8[np.ndarray, "H W"]
MARGIN = {"exact": 0.0, "imperfect": 0.15}
"""Around the object's image, as a share of its longer side: what the sensor is simulated for."""
LEAST_MARGIN = 8
"""Pixels more."""
FOREIGN_COLOR = 128
"""Grey level of what is not the object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """What a depth sensor and its mask do to a picture."""

    noise: Noise
    mask: Mask
    kinect: Kinect = KINECT
    disparity: Disparity = DISPARITY
    edges: EdgeEffects = EDGES
    clutter: Clutter = BESIDE
    errors: MaskErrors = MASK


def measure_some(
    frames: list[Frame], camera: Intrinsics, rng: np.random.Generator, sensor: Sensor, enough: int
) -> list[Frame]:
    """All pictures of a sample by `measure`, with about `enough` pixels of all of them simulated.

    The same share of each, so that parts rendered alone keep their proportion.
    """
    if sensor.noise == "none" and sensor.mask == "exact":
        return frames
    pixels = sum(int(np.count_nonzero(frame.part != BACKGROUND)) for frame in frames)
    share = min(1.0, enough / max(pixels, 1))
    return [measure(frame, camera, rng, sensor, share) for frame in frames]


def measure(
    frame: Frame,
    camera: Intrinsics,
    rng: np.random.Generator,
    sensor: Sensor,
    share: float = 1.0,
) -> Frame:
    """The picture as the sensor and its mask give it.

    Args:
        frame: As rendered.
        camera: Intrinsics.
        rng: Of this picture.
        sensor: What is simulated.
        share: Of the mask's pixels that are simulated, drawn at random: a cloud of few points
            needs no more, and is drawn from these as it would be from all.

    Returns:
        Depth 0 outside the mask and where nothing was measured or simulated; part 255 there and
        where something else than the object was measured.
    """
    depth, part = corrupt(frame.depth, frame.part, camera, rng, sensor, share)
    color = frame.color
    if color is not None:
        foreign = (part == BACKGROUND) & (depth > 0)
        color = np.where(foreign[..., None], np.uint8(FOREIGN_COLOR), color)
    return replace(frame, depth=depth, part=part, color=color)


def corrupt(
    depth: Depth,
    part: Parts,
    camera: Intrinsics,
    rng: np.random.Generator,
    sensor: Sensor,
    share: float = 1.0,
) -> tuple[Depth, Parts]:
    """See `measure`; pictures that do not show the object stay as they are."""
    if sensor.noise == "none" and sensor.mask == "exact":
        return depth, part
    window = _window(part != BACKGROUND, MARGIN[sensor.mask])
    if window is None:
        return depth, part
    rows, columns = window
    cropped = replace(
        camera,
        cx=camera.cx - columns.start,
        cy=camera.cy - rows.start,
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
    )
    clean, label = np.ascontiguousarray(depth[window], np.float32), part[window].copy()
    scene, mask = _surroundings(clean, label, cropped, rng, sensor)
    at = np.flatnonzero(mask)
    if share < 1:
        at = np.sort(rng.choice(at, math.ceil(share * len(at)), replace=False, shuffle=False))
    measured, label = _sense(scene, label, cropped, rng, sensor, at)
    made_depth, made_part = np.zeros_like(depth), np.full_like(part, BACKGROUND)
    place = (rows.start + at // cropped.width, columns.start + at % cropped.width)
    made_depth[place], made_part[place] = measured, label
    return made_depth, made_part


def _surroundings(
    depth: Depth, part: Parts, camera: Intrinsics, rng: np.random.Generator, sensor: Sensor
) -> tuple[Depth, Bool[np.ndarray, "H W"]]:
    """The object's picture with a scene around it, and which pixels are taken for the object."""
    seen = part != BACKGROUND
    scene = put_behind(depth, camera, rng)
    if sensor.mask == "exact":
        return scene, seen
    scene, beside = put_beside(scene, seen, rng, sensor.clutter)
    return scene, wrong_mask(seen, camera, rng, sensor.errors) | beside


def _sense(
    scene: Depth,
    part: Parts,
    camera: Intrinsics,
    rng: np.random.Generator,
    sensor: Sensor,
    at: Int[np.ndarray, " K"],
) -> tuple[Float[np.ndarray, " K"], UInt8[np.ndarray, " K"]]:
    """Depth and part measured at these pixels; 0 and 255 where there is nothing to keep."""
    measured, label = scene.take(at), part.take(at)
    if sensor.noise != "none":
        shown = surface(scene, at)
        if sensor.noise == "kinect":
            measured, label = kinect_at(scene, part, camera, rng, shown, sensor.kinect)
        else:
            measured, label = disparity_at(scene, part, camera, rng, at, sensor.disparity)
        measured = flying_pixels(measured, shown, rng, sensor.edges)
        measured = np.where(holes(shown, camera, rng, sensor.edges), 0, measured)
    kept = measured > 0
    if sensor.mask == "exact":
        kept &= label != BACKGROUND
    return np.where(kept, measured, 0), np.where(kept, label, np.uint8(BACKGROUND))


def _window(seen: Bool[np.ndarray, "H W"], share: float) -> tuple[slice, slice] | None:
    """Rows and columns of the object's image with a margin, inside the image."""
    places = [np.flatnonzero(seen.any(axis)) for axis in (1, 0)]
    if not len(places[0]):
        return None
    margin = LEAST_MARGIN + int(share * max(int(np.ptp(place)) for place in places))
    rows, columns = (
        slice(max(int(place[0]) - margin, 0), min(int(place[-1]) + margin + 1, size))
        for place, size in zip(places, seen.shape, strict=True)
    )
    return rows, columns
