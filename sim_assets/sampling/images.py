# SPDX-License-Identifier: MIT
"""A sample's picture as a depth camera would save it: depth in millimetres, mask, colour."""

from __future__ import annotations

import numpy as np

from scapo.geometry.camera import Intrinsics
from sim_assets.rendering.base import BACKGROUND, Frame
from sim_assets.sensors.depth_camera import Sensor, measure

PREFIX = "image_"
"""Of the names of pictures among a sample's tensors: they go to files of their own."""
METRE = 1000
"""Units of the depth image."""


def image_rows(
    frame: Frame, camera: Intrinsics, rng: np.random.Generator, sensor: Sensor
) -> dict[str, np.ndarray]:
    """The pictures of a sample by name.

    The sensor is simulated for every pixel, from a generator of the picture's own, so that the
    sample's cloud stays what it is without pictures: with noise the two differ by their noise.

    Args:
        frame: As rendered.
        camera: Intrinsics.
        rng: Of the view; its stream is left as it is.
        sensor: What is simulated.

    Returns:
        `image_depth` u16 (H, W), mm, 0 where the object was not measured; `image_mask` u8 (H, W),
        0 there, else part index + 1, 255 what is wrongly taken for the object; `image_rgb` u8
        (H, W, 3) where the frame has colours.
    """
    seen = frame
    if (sensor.noise, sensor.mask) != ("none", "exact"):
        (own,) = rng.spawn(1)
        seen = measure(frame, camera, own, sensor)
    depth = np.rint(seen.depth * METRE).clip(0, np.iinfo(np.uint16).max).astype(np.uint16)
    label = np.where(seen.part == BACKGROUND, BACKGROUND, seen.part + np.uint8(1))
    images = {"depth": depth, "mask": np.where(depth > 0, label, 0).astype(np.uint8)}
    if seen.color is not None:
        images["rgb"] = seen.color
    return {f"{PREFIX}{name}": image for name, image in images.items()}
